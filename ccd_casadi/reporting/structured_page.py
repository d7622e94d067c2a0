"""Parts of a page of a controller of fixed structure."""

from collections.abc import Mapping, Sequence
from typing import Any

from ccd_casadi.codesign.verified_structured import VerifiedStructured
from ccd_casadi.drawing.content import Block, Table, Words
from ccd_casadi.fixed_structure.bounds import kind_and_channel
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.inner_problem.sections_words import SectionWords
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.reporting.facts import binding, gain_words, paragraph
from ccd_casadi.support.text import HZ, counted, number
from ccd_casadi.synthesis.closed_loop import measure

MOST_TOLERANCES, LEAST_HZ = 5, 1e-6  # that are named; with less in Hz a tolerance costs nothing


def bandwidths_table(verified: VerifiedStructured) -> Table:
    """Every ω_b of the one controller: which plant, and whether sampled."""
    design, problem = verified.design, verified.problem
    assert design.certificate is not None
    assert design.controller is not None
    sampling, plants = structured_of(problem).sampling, design.certificate.plants
    as_run = "continuous" if sampling is None else f"as sampled at {number(sampling.rate_hz)} Hz"
    least = f"the least of {counted(len(plants), 'plant')} of the set, which J counts"
    rows = [(least, as_run, design.certificate.bandwidth),
            ("the model", as_run, plants[0].crossing)]  # fmt: skip
    if sampling is not None:
        found = measure(
            scaled_plant(problem, verified.theta), design.controller, problem.weights,
            omega_low=problem.inner.omega_low,
        )  # fmt: skip
        rows.append(("the model", "continuous", found.bandwidth))
    head = ("-3 dB of S with this controller, on", "loop", "Hz")
    return Table(head, tuple((on, loop, number(omega / HZ, 5)) for on, loop, omega in rows))


def binding_words(problem: CoDesignProblem, result: Mapping[str, Any]) -> list[str]:
    """What holds θ, and what the controller, with what loosening it would gain."""
    over_theta = binding(problem, {**result, "active": []})
    mu, kink = result["controller"]["multipliers"], result["kkt"].get("kink")
    if kink is not None:  # at this θ they are not unique; with θ, which follows the kink, they are
        mu = kink["multipliers"]
    v = problem.figure
    most = HZ * result["bandwidth_hz"] if v is BANDWIDTH else result[f"{v.entry}_of_set"]
    names = {"S_MAX": "The peak of S", "SHAPE": "The shape of S", "LEVEL": "|S| below ω_b",
             "S_LOW": "|S| at ω_low",
             "KS": "|W_KS KS|", "T": "|W_T T|", "GS": "The compliance"}  # fmt: skip
    over_kappa = []
    for kind, words in names.items():
        for name in (name for name, value in mu.items() if value > 1e-6):
            own, channel = kind_and_channel(name)
            if own == kind:
                of = f" of channel {channel}" if channel else ""
                worth = v.shown(0.01 * mu[name] * most, 3)
                more = f"1 % more of it gives {worth} on this hardware"
                over_kappa.append(f"{words}{of} binds; {more}.")
    ranges = [key.rpartition(" ") for key in result["controller"]["at_range"]]
    ends = [f"{name if ': ' in name else name[:1].upper() + name[1:]} is at the {end} end of its "
            "range." for name, _, end in ranges]  # fmt: skip
    return [*over_theta, *over_kappa, *ends]


def limits_blocks(problem: CoDesignProblem, result: Mapping[str, Any]) -> tuple[Block, ...]:
    """What bounds every controller at θ, and what the set, hold and delay cost this structure."""
    costs, gap = result["costs"], result["gap"] or {}
    sampled = structured_of(problem).sampling is not None

    def hz(value: float | None) -> str:
        return "not known" if value is None else f"{number(value, 4)} Hz"

    loop, v = "sampled" if sampled else "continuous", problem.figure
    least = "" if v.larger_is_better else f", of the least {v.words}"
    whole = f"{counted(result['certificate']['plants'], 'plant')} of the set"
    bound = hz(gap.get("bandwidth_bound_hz"))
    rows = [
        ("no controller of any order exceeds", gap.get("plants", "the model"), loop, bound),
        ("sections", "the model alone", loop, hz(costs["on_model_hz"])),
        *([("sections", whole, "continuous", hz(costs["continuous_hz"]))] if sampled else []),
        (f"sections: the design{least}", whole, loop, hz(result["bandwidth_hz"])),
    ]
    most = sorted(costs.get("tolerances_hz", {}).items(), key=lambda item: item[1])
    shown = [item for item in most[:MOST_TOLERANCES] if item[1] < -LEAST_HZ]
    words = Words(paragraph("report.costs", shown))
    return Table(("", "designed for", "loop", "ω_b"), tuple(rows)), words


def controller_blocks(result: Mapping[str, Any]) -> tuple[Words, Table]:
    """Write gain and sections of a controller in Hz and damping.

    Parameters
    ----------
    result : mapping
        Only `controller` is read.

    Returns
    -------
    Words, Table
    """
    controller = result["controller"]
    found = [SectionWords(**item) for item in controller["sections"]]
    words = paragraph("report.sections", controller, gain_words(controller))
    return Words(words), structured_table(found)


def structured_table(found: Sequence[SectionWords]) -> Table:
    """Zeros and poles of a controller's sections."""
    head = ("section", "zero Hz", "zero ζ", "pole Hz", "pole ζ")
    rows = ((s.kind, s.zero_hz, s.zero_damping, s.pole_hz, s.pole_damping) for s in found)
    return Table(head, tuple(rows))
