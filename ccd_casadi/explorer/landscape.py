"""ω_b* over two parameters: the run's surrogate where it still answers, and every sample known."""

from collections.abc import Sequence
from pathlib import Path

from ccd_casadi.drawing.content import Landscape
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.landscape import landscape_data
from ccd_casadi.reporting.true_samples import read_truths
from surrogates import GaussianProcess, SurrogateFileError, load


def run_surrogate(folder: Path) -> tuple[GaussianProcess, ...]:
    """The newest surrogate of a run folder; none where there is none, or it cannot be read."""
    try:
        found, _ = load(folder / "surrogate.json")
    except (OSError, SurrogateFileError):
        return ()
    return tuple(item for item in found if isinstance(item, GaussianProcess))


def landscape_of(
    problem: CoDesignProblem,
    theta: Sequence[float],
    made_for: CoDesignProblem | None,
    processes: tuple[GaussianProcess, ...],
    store: Path,
    axes: tuple[int, int],
) -> tuple[Landscape, str]:
    """The landscape over the parameters `axes`, the others as at θ, and what it shows.

    `made_for`: the problem that the surrogates are of; of another one they say nothing.
    """
    words = "no surrogate: the dots are the best designs looked at"
    if processes and made_for is not None:
        same = made_for.identity() == problem.identity()
        if same and made_for.inner_identity() == problem.inner_identity():
            words = (
                f"colours: ω_b*(θ) by the run's surrogate of {len(processes[0].X)} samples; large "
                "dots: the true ω_b*(θ); small ones: single designs"
            )
        else:
            processes = ()
            words = "the run's surrogate is of another S_max, range or plant set: not shown"
    else:
        processes = ()
    truths = read_truths(store, problem)
    return landscape_data(problem, processes, truths, theta=theta, axes=axes), words
