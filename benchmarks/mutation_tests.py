"""Which tests judge the mutants of which file, and whether the kernels run as plain Python.

What is left out of an interpreted group takes minutes there and does what another test of the
group does too, on more examples.
"""

from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Group:
    """Tests of some files: pytest's arguments, words for -k, and plain Python or compiled."""

    files: tuple[str, ...]
    tests: tuple[str, ...]
    words: str
    interpreted: bool


def _kernels(*names: str) -> tuple[str, ...]:
    return tuple(f"ccd_casadi/kernels/{name}.py" for name in names)


def _tests(*names: str) -> tuple[str, ...]:
    return tuple(
        str(next((ROOT / "tests").rglob(f"test_{name}.py")).relative_to(ROOT)) for name in names
    )


DESIGN_TESTS = _tests(
    "weights",
    "kernel_parts",
    "loop_gains",
    "gamma_search",
    "gamma_error",
    "certificate",
    "balance",
    "synthesis",
    "sensitivity",
    "channels",
)
DIFFERENCES = "two_mass_plant or both_limits or both_sides_agree"  # many syntheses each
GROUPS = (
    Group(
        _kernels(
            "certificate", "closed_loop", "generalized_plant", "frequency", "sensitivity",
            "design", "refine", "small", "blocks", "riccati", "gamma", "synthesis", "balance",
            "figures",
        ),
        DESIGN_TESTS + _tests("derivatives"),
        f"not every_two_mass and not flexible_plants_are_certified and not ({DIFFERENCES})",
        interpreted=True,
    ),
    Group(
        _kernels("gradients", "pullback", "bound_peak"),
        _tests("gradient_parts", "derivatives", "channels", "gamma_error"),
        "not both_limits",
        interpreted=True,
    ),
    Group(
        _kernels("limits", "sections", "modes", "loop_point", "loop_rows", "loop_curvature"),
        _tests("fixed_structure_loops", "fixed_structure_channels"),
        "derivatives or closed_in_on or crossing or moves_with or hessian_of_the_whole",
        interpreted=True,
    ),
    Group(
        tuple(
            f"ccd_casadi/{name}.py"
            for name in (
                "plants/modal", "plants/scaling", "synthesis/synthesis", "synthesis/closed_loop",
                "synthesis/weights", "synthesis/derivatives",
            )
        ),
        DESIGN_TESTS
        + _tests("closed_loop", "plant", "derivatives", "backends", "robust_design", "compliance"),
        "not robust_co_design",
        interpreted=False,
    ),
    Group(
        tuple(
            f"ccd_casadi/sampling/{n}.py"
            for n in ("keys", "rows", "store", "samples", "units", "sampler")
        ),
        _tests("samples", "damaged_stores", "sampling"),
        "",
        interpreted=False,
    ),
)  # fmt: skip
