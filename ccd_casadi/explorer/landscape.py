"""ω_b* over two parameters: the run's surrogate where it still answers, and every sample known."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ccd_casadi.drawing.content import Landscape
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.landscape import bandwidth_process, landscape_data, read_truths
from surrogates import GaussianProcess, SurrogateFileError, load


def run_surrogate(folder: Path) -> GaussianProcess | None:
    """The newest surrogate of ω_b*(θ) in a run folder; None where there is none to be read."""
    try:
        return bandwidth_process(load(folder / "surrogate.json")[0])
    except (OSError, SurrogateFileError):
        return None


def steepest_axes(
    known: Mapping[tuple[float, ...], float], lower: Sequence[float], upper: Sequence[float]
) -> tuple[int, ...]:
    """The two parameters over whose ranges the samples θ -> ω_b* rise or fall most, in their order.

    By the plane of least squares; of no samples the first two. NaN: infeasible.
    """
    rows = [(1.0, *np.subtract(theta, lower), hz) for theta, hz in known.items() if hz == hz]
    table = np.array(rows).reshape(-1, len(lower) + 2)
    plane = np.linalg.lstsq(table[:, :-1], table[:, -1])[0]
    changes = np.abs(plane[1:] * np.subtract(upper, lower))
    return tuple(sorted(np.argsort(-changes)[:2].tolist()))


def landscape_of(
    problem: CoDesignProblem,
    theta: Sequence[float],
    made_for: CoDesignProblem | None,
    process: GaussianProcess | None,
    store: Path,
    axes: tuple[int, int],
) -> tuple[Landscape, str]:
    """The landscape over the parameters `axes`, the others as at θ, and what it shows.

    `made_for`: the problem that the surrogate is of; of another one it says nothing.
    """
    if process is None or made_for is None:
        process, words = None, "no surrogate: the dots are the best designs looked at"
    elif (made_for.identity(), made_for.inner_identity()) == (
        problem.identity(), problem.inner_identity()
    ):  # fmt: skip
        words = (
            f"colours: ω_b*(θ) by the run's surrogate of {len(process.X)} samples; large "
            "dots: the true ω_b*(θ); small ones: single designs"
        )
    else:
        process = None
        words = "the run's surrogate is of another S_max, range or plant set: not shown"
    truths = read_truths(store, problem)
    return landscape_data(problem, process, truths, theta=theta, axes=axes), words
