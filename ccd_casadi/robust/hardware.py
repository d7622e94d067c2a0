"""The controller on other hardware: random θ within tolerances, and the worst that is found."""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.inner_problem.problem import free_modal, plant_of
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.robust.perturbed import PerturbedLoop, judge, search
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.process_pool import Pool, Workers, results
from ccd_casadi.support.progress import Progress

CORNERS = 5  # parameters up to which all corners of the tolerances are tried
STARTS = 2


@dataclass(frozen=True)
class Tolerances:
    """Random hardware and the worst found within the tolerances; places are θ."""

    tolerance: float
    judged: tuple[PerturbedLoop, ...]
    failed: int
    worst: PerturbedLoop

    @property
    def unstable(self) -> int:
        """How many of the random plants are."""
        return sum(not item.stable for item in self.judged)

    def above(self, peak: float) -> int:
        """How many of the stable ones have a larger peak of S."""
        return sum(item.stable and item.peak > peak for item in self.judged)

    def within(self, S_max: float) -> Yield:
        """How many of the random plants are stable with a peak of S up to S_max."""
        return Yield(sum(one.stable and one.peak <= S_max for one in self.judged), len(self.judged))


def tolerances(
    run: FinishedRun, tolerance: float, samples: int, seed: int, workers: Pool | None = None
) -> Tolerances:
    """Uniformly random θ within ± `tolerance` (relative) of the design's, and the worst θ found.

    The controller stays. θ may leave its bounds by the tolerance. `failed` counts hardware of
    which the model makes no plant. `workers` share the random ones.
    """
    pool = workers or Workers(1)
    theta = np.array(run.theta)
    rng = np.random.default_rng(seed)
    unit = rng.uniform(-1.0, 1.0, (samples, theta.size))
    if theta.size <= CORNERS:
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * theta.size)).reshape(theta.size, -1).T
    else:
        signs = np.empty((0, theta.size))

    def place(x: Array) -> tuple[float, ...]:
        return tuple(float(v) for v in theta * (1.0 + tolerance * x))

    def at(x: Array) -> PerturbedLoop | None:
        return _hardware(run, place(x))

    light = replace(run, result={})
    drawn: list[PerturbedLoop | None] = [None] * samples
    tasks = {i: (light, place(x)) for i, x in enumerate(unit)}
    bar = Progress(samples, "hardware tolerances")
    for i, item in bar.over(results(pool, _hardware, tasks)):
        drawn[i] = item
    failed = sum(item is None for item in drawn)
    one = np.ones(theta.size)
    order = np.argsort([-1.0 if item is None else -item.badness for item in drawn])
    starts = [*signs, *unit[order[:STARTS]]]
    worst = search(at, starts, -one, one, "worst hardware")
    kept = tuple(item for item in drawn if item is not None)
    worst = max((worst, *kept), key=lambda item: item.badness)
    return Tolerances(tolerance, kept, failed, worst)


def _hardware(run: FinishedRun, theta: tuple[float, ...]) -> PerturbedLoop | None:
    """The controller on the hardware θ; None where the model makes no plant of it."""
    try:
        system = mechanics(plant_of(run.problem), theta, derivatives=False)
        return judge(run, free_modal(run.problem, system), theta)
    except PlantError:
        return None
