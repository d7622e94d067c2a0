"""What the surrogates of a run say about themselves (`surrogates.quality`), and what follows."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ccd_casadi.codesign.verified import Verified
from ccd_casadi.support.progress import Progress
from surrogates import GaussianProcess, Quality, quality_of
from surrogates.quality import Roughness

# Name, unit of its errors, the number that turns the surrogate's unit into it, whether what is
# fitted is a logarithm.
BOUNDED = (
    ("sensitivity_peak", "%", 100.0, True),
    ("sensitivity_low", "%", 100.0, True),
    ("compliance", "%", 100.0, True),
)
ROUGH = (Roughness.KINKED, Roughness.JUMPS)  # as `Quality.samples_look` has it


def surrogate_quality(
    processes: Sequence[GaussianProcess], at: Verified, seed: int = 0, *, quiet: bool = True
) -> tuple[Quality, ...]:
    """Judge the processes of what J counts, and of ln of each bounded figure, at a design."""
    figure = at.problem.figure
    outputs = ((figure.key, figure.unit, figure.factor, False), *BOUNDED)
    found = []
    with Progress(len(processes), "judging the surrogates", quiet) as bar:
        for process, (name, unit, factor, logarithm) in zip(processes, outputs, strict=False):
            quality = quality_of(
                process,
                at.point[: process.lower.size],
                name=name,
                unit=unit,
                factor=factor,
                logarithm=logarithm,
                seed=seed,
            )
            found.append(quality)
            bar.advance()
    return tuple(found)


def recommendation(qualities: Sequence[Quality]) -> str:
    """What follows from them, in one or two sentences; nothing where there is no surrogate."""
    if not qualities:
        return ""
    said = []
    poor = [q for q in qualities if q.poor]
    if poor:
        which = ", ".join(f"{q.name.replace('_', ' ')} (Q² {q.kfold.q2:.2g})" for q in poor)
        said.append(
            f"Left-out samples of {which} are predicted poorly: more samples are needed before the "
            "surrogate says anything away from the design."
        )
    looks = {q.name.replace("_", " "): q.samples_look for q in qualities}
    rough = [f"{name} ({look})" for name, look in looks.items() if look in ROUGH]
    if rough:
        what = ", ".join(rough)
        said.append(
            f"The samples of {what} are rough: one smooth surrogate follows them only near the "
            "design. "
            + (
                "Solve with --formulation lifted, whose outputs are smooth where the best "
                "bandwidth is not."
                if len(qualities) == 1
                else "The larger of two local peaks is kinked where they are equal; the rounds "
                "refit by the design, where one of them is the larger."
            )
        )
    beyond = [q.name.replace("_", " ") for q in qualities if q.extrapolates]
    if beyond:
        said.append(
            f"At the design the surrogate of {', '.join(beyond)} extrapolates: trust the "
            "verification, and retrain before moving bounds or weights."
        )
    for q in qualities:
        if q.unsupported and not q.extrapolates and not q.poor:
            said.append(f"{q.name.replace('_', ' ').capitalize()}: {q.unsupported}.")
    return " ".join(said) or "The surrogates follow their samples, and support the design."


def quality_dict(qualities: Sequence[Quality]) -> dict[str, Any]:
    """`surrogate_quality` of result.json; errors in the unit that is named."""
    if not qualities:
        return {}
    return {
        "outputs": {
            q.name: {
                "unit": q.unit,
                "samples": len(q.true),
                "leave_one_out": asdict(q.loo),
                "k_fold": asdict(q.kfold),
                "coverage_95": q.coverage,
                "roughness": q.roughness.value,
                "extrapolates": list(q.extrapolates),
                "left_out_at_design": None
                if q.at_point is None
                else {"error": q.at_point[0], "deviations": q.at_point[1]},
            }
            for q in qualities
        },
        "recommendation": recommendation(qualities),
    }
