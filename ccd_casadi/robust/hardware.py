"""The controller on other hardware: random θ within tolerances, and the worst that is found."""

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import numpy as np

from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.plants.plant import Evaluate, mechanics
from ccd_casadi.robust.perturbed import SEARCH, Judged, judge, search
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.process_pool import Pool, Workers
from ccd_casadi.support.progress import Progress

T = TypeVar("T")
R = TypeVar("R")

CORNERS = 5  # parameters up to which all corners of the tolerances are tried
STARTS = 2
REDUCED = 30  # plants below which no reduced model is made: about what one costs
NEARBY = 1e-4  # relative: how well a reduced model has to give ‖S‖∞ and ω_b, to be used
CHECKED = 6  # random plants on which it is compared with the true one


@dataclass(frozen=True)
class Tolerances:
    """Random hardware and the worst found within the tolerances; places are θ.

    `difference`: by how much (relative) the reduced model that these come from was off in ‖S‖∞ and
    ω_b where it was checked; None where every plant is the model's own. The worst one always is.
    """

    tolerance: float
    judged: tuple[Judged, ...]
    failed: int
    worst: Judged
    difference: float | None = None

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
    run: FinishedRun,
    tolerance: float,
    samples: int,
    seed: int,
    quiet: bool,
    workers: Pool | None = None,
) -> Tolerances:
    """Uniformly random θ within ± `tolerance` (relative) of the design's, and the worst θ found.

    The controller stays. θ may leave its bounds by the tolerance. `failed` counts hardware of
    which the model makes no plant. Where the plant has a reduced model of its neighbourhood, that
    one is asked, if it agrees with the true one to `NEARBY` at some of the random θ and at the
    worst; `workers` share the true ones.
    """
    pool, plant = workers or Workers(1), plant_of(run.problem)
    if plant.nearby is not None and samples + SEARCH > REDUCED:
        with Progress(REDUCED, "reduced model", quiet=quiet) as progress:
            evaluate = plant.nearby(run.theta, tolerance, _Counting(pool, progress))
        found = _tolerances(run, tolerance, samples, seed, quiet, pool, evaluate)
        asked = [*found.judged[:: max(1, len(found.judged) // CHECKED)][:CHECKED], found.worst]
        true = dict(_true(run, [item.place for item in asked], pool, "checking", quiet))
        pairs = [(true[i], item) for i, item in enumerate(asked)]
        difference = max(_difference(one, item) for one, item in pairs)
        last = true[len(asked) - 1]
        if difference <= NEARBY and last is not None:
            return replace(found, worst=last, difference=difference)
    return _tolerances(run, tolerance, samples, seed, quiet, pool, None)


def _tolerances(
    run: FinishedRun,
    tolerance: float,
    samples: int,
    seed: int,
    quiet: bool,
    pool: Pool,
    evaluate: Evaluate | None,
) -> Tolerances:
    theta = np.array(run.theta)
    rng = np.random.default_rng(seed)
    unit = rng.uniform(-1.0, 1.0, (samples, theta.size))
    if theta.size <= CORNERS:
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * theta.size)).reshape(theta.size, -1).T
    else:
        signs = np.empty((0, theta.size))

    def place(x: Array) -> tuple[float, ...]:
        return tuple(float(v) for v in theta * (1.0 + tolerance * x))

    def at(x: Array) -> Judged | None:
        return _hardware(run, place(x), evaluate)

    label = "hardware tolerances"
    if evaluate is None:
        made = dict(_true(run, [place(x) for x in unit], pool, label, quiet))
        drawn = [made[i] for i in range(samples)]
    else:
        with Progress(samples, label, quiet=quiet) as progress:
            drawn = []
            for x in unit:
                drawn.append(at(x))
                progress.advance()
    failed = sum(item is None for item in drawn)
    one = np.ones(theta.size)
    order = np.argsort([-1.0 if item is None else -item.badness for item in drawn])
    starts = [*signs, *unit[order[:STARTS]]]
    worst = search(at, starts, -one, one, "worst hardware", quiet)
    kept = tuple(item for item in drawn if item is not None)
    worst = max((worst, *kept), key=lambda item: item.badness)
    return Tolerances(tolerance, kept, failed, worst)


def _hardware(
    run: FinishedRun, theta: tuple[float, ...], evaluate: Evaluate | None = None
) -> Judged | None:
    """The controller on the hardware θ; None where the model makes no plant of it."""
    plant = plant_of(run.problem)
    if evaluate is not None:
        plant = replace(plant, values=evaluate)
    try:
        system = mechanics(plant, theta, derivatives=False)
        return judge(run, modal_plant(system, run.problem.suspension), theta)
    except PlantError:
        return None


def _hardware_unit(task: tuple[int, FinishedRun, tuple[float, ...]]) -> tuple[int, Judged | None]:
    index, run, theta = task
    return index, _hardware(run, theta)


def _true(
    run: FinishedRun, places: Sequence[tuple[float, ...]], pool: Pool, label: str, quiet: bool
) -> Iterator[tuple[int, Judged | None]]:
    """The model's own plants at places, with their numbers, as the pool makes them."""
    light = replace(run, result={})
    with Progress(len(places), label, quiet=quiet) as progress:
        tasks = [(i, light, theta) for i, theta in enumerate(places)]
        for item in pool.map_unordered(_hardware_unit, tasks):
            progress.advance()
            yield item


def _difference(one: Judged | None, other: Judged) -> float:
    """Relative, of ‖S‖∞ and ω_b; infinite where one is stable and the other is not."""
    if one is None or one.stable != other.stable:
        return np.inf
    if not one.stable:
        return abs(one.max_real_pole - other.max_real_pole) / max(abs(one.max_real_pole), 1.0)
    return max(abs(one.peak / other.peak - 1.0), abs(one.bandwidth / other.bandwidth - 1.0))


class _Counting:
    """A pool that tells a progress bar of every task done."""

    def __init__(self, pool: Pool, progress: Progress) -> None:
        self._pool, self._progress, self.count = pool, progress, pool.count

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """The pool is its owner's."""

    def map_unordered(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Generator[R, None, None]:
        self._progress.total = len(tasks)
        for item in self._pool.map_unordered(function, tasks):
            self._progress.advance()
            yield item
