"""The controller on plants off the model: shifted resonances, other damping, other hardware."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.plants.modal import ModalPlant, Perturbation, modal_plant
from ccd_casadi.plants.plant import Mechanics, mechanics
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.progress import Progress
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import UNBOUNDED, DesignFigures

BISECTIONS = 30
SEARCH = 120  # measurements of a search for the worst plant
CORNERS = 5  # parameters up to which all corners of the tolerances are tried
STARTS = 2


@dataclass(frozen=True)
class Judged:
    """A plant's place among the perturbed ones, and what the loop does on it (rad/s)."""

    place: tuple[float, ...]
    stable: bool
    bandwidth: float
    peak: float
    max_real_pole: float

    @property
    def badness(self) -> float:
        """‖S‖∞, and beyond any where unstable, more so the faster it grows."""
        return self.peak if self.stable else 1e6 * (1.0 + max(self.max_real_pole, 0.0))


@dataclass(frozen=True)
class Line:
    """Plants along one perturbation, and the range around the model where the loop holds.

    `stable` and `within` (S_max) are the ends, as far as the line goes, between which it does.
    """

    judged: tuple[Judged, ...]
    stable: tuple[float, float]
    within: tuple[float, float]


@dataclass(frozen=True)
class Tolerances:
    """Random hardware and the worst found within the tolerances; places are θ."""

    tolerance: float
    judged: tuple[Judged, ...]
    failed: int
    worst: Judged


def judge(run: FinishedRun, modal: ModalPlant, place: tuple[float, ...]) -> Judged:
    """The run's controller on a plant."""
    if run.sampled_judge is not None:
        good, omega, height, growth = run.sampled_judge(scale_plant(modal, run.problem.weights.M_K))
        return Judged(place, good, omega, height if good else np.inf, growth)
    figures: DesignFigures = measure(
        scale_plant(modal, run.problem.weights.M_K),
        run.controller,
        run.weights,
        gamma=UNBOUNDED,
        omega_low=run.problem.inner.omega_low,
    )
    stable = figures.certificate.stable
    peak = figures.sensitivity_peak if stable else np.inf
    return Judged(place, stable, figures.bandwidth, peak, figures.certificate.max_real_pole)


def system_of(run: FinishedRun) -> Mechanics:
    """The plant's matrices at the run's θ."""
    return mechanics(plant_of(run.problem), run.theta)


def shift_line(run: FinishedRun, system: Mechanics, reach: float, count: int = 41) -> Line:
    """All flexible frequencies times 1 + s, |s| <= reach."""
    return _line(run, lambda s: _modal(run, system, Perturbation(shift=s)), -reach, reach, count)


def damping_line(
    run: FinishedRun, system: Mechanics, low: float, high: float, count: int = 41
) -> Line:
    """Damping times d, low <= d <= high; evenly in its logarithm."""
    return _line(
        run, lambda x: _modal(run, system, Perturbation(damping=float(np.exp(x)))),
        float(np.log(low)), float(np.log(high)), count, np.exp,
    )  # fmt: skip


def single_modes(run: FinishedRun, system: Mechanics, reach: float) -> tuple[Judged, ...]:
    """Every flexible mode that the loop drives and sees, alone, shifted by ±reach.

    Places are (frequency in Hz, shift).
    """
    modal = modal_plant(system, run.problem.suspension)
    residue = np.linalg.norm(modal.B, axis=1) * np.linalg.norm(modal.C, axis=0)
    found = []
    for i in np.flatnonzero(~modal.rigid & (residue > 1e-9 * residue.max())):
        for shift in (-reach, reach):
            K = modal.K.copy()
            K[i, i] *= (1.0 + shift) ** 2
            place = (float(modal.natural[i]) / (2.0 * np.pi), shift)
            found.append(judge(run, replace(modal, K=K), place))
    return tuple(found)


def worst_in_box(
    run: FinishedRun, system: Mechanics, reach: float, damping: tuple[float, float]
) -> Judged:
    """The worst (shift, damping factor) of the box: a grid, then a local search from its worst."""
    low, high = np.array([-reach, np.log(damping[0])]), np.array([reach, np.log(damping[1])])

    def at(x: Array) -> Judged:
        s, d = float(x[0]), float(np.exp(x[1]))
        return judge(run, _modal(run, system, Perturbation(s, d)), (s, d))

    grid = [np.array([s, d]) for s in np.linspace(low[0], high[0], 9)
            for d in np.linspace(low[1], high[1], 5)]  # fmt: skip
    return _search(at, grid, low, high)


def tolerances(
    run: FinishedRun, tolerance: float, samples: int, seed: int, quiet: bool
) -> Tolerances:
    """Uniformly random θ within ± `tolerance` (relative) of the design's, and the worst θ found.

    The controller stays. θ may leave its bounds by the tolerance. `failed` counts hardware of
    which the model makes no plant.
    """
    theta = np.array(run.theta)
    rng = np.random.default_rng(seed)
    unit = rng.uniform(-1.0, 1.0, (samples, theta.size))
    if theta.size <= CORNERS:
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * theta.size)).reshape(theta.size, -1).T
    else:
        signs = np.empty((0, theta.size))
    failed = 0

    def at(x: Array) -> Judged | None:
        values = tuple(float(v) for v in theta * (1.0 + tolerance * x))
        try:
            modal = modal_plant(mechanics(plant_of(run.problem), values), run.problem.suspension)
        except PlantError:
            return None
        return judge(run, modal, values)

    with Progress(samples, "hardware tolerances", quiet=quiet) as progress:
        drawn = []
        for x in unit:
            drawn.append(at(x))
            progress.advance()
    failed = sum(item is None for item in drawn)
    one = np.ones(theta.size)
    order = np.argsort([-1.0 if item is None else -item.badness for item in drawn])
    starts = [*signs, *unit[order[:STARTS]]]
    worst = _search(at, starts, -one, one)
    kept = tuple(item for item in drawn if item is not None)
    worst = max((worst, *kept), key=lambda item: item.badness)
    return Tolerances(tolerance, kept, failed, worst)


def _modal(run: FinishedRun, system: Mechanics, perturbation: Perturbation) -> ModalPlant:
    return modal_plant(system, run.problem.suspension, perturbation)


def _line(
    run: FinishedRun,
    modal_at: Callable[[float], ModalPlant],
    low: float,
    high: float,
    count: int,
    shown: Callable[[float], float] = float,
) -> Line:
    def at(x: float) -> Judged:
        return judge(run, modal_at(x), (float(shown(x)),))

    S_max = run.problem.inner.S_max * (1.0 + 1e-6)
    places = np.unique(np.append(np.linspace(low, high, count), 0.0))
    judged = [at(float(x)) for x in places]

    def end(good: Callable[[Judged], bool], sign: int) -> float:
        """The last place from the model outwards that is good, to bisection."""
        side = [(x, j) for x, j in zip(places, judged, strict=True) if sign * x >= 0.0]
        side.sort(key=lambda item: abs(item[0]))
        if not good(side[0][1]):
            return float(shown(0.0))
        inside = side[0][0]
        for x, item in side[1:]:
            if not good(item):
                a, b = inside, x
                for _ in range(BISECTIONS):
                    middle = 0.5 * (a + b)
                    a, b = (middle, b) if good(at(middle)) else (a, middle)
                return float(shown(a))
            inside = x
        return float(shown(inside))

    def ends(good: Callable[[Judged], bool]) -> tuple[float, float]:
        return end(good, -1), end(good, 1)

    return Line(tuple(judged), ends(lambda j: j.stable), ends(lambda j: j.peak <= S_max))


def _search(
    at: Callable[[Array], Judged | None], starts: list[Array], low: Array, high: Array
) -> Judged:
    """The worst of the starts, and of a bounded Nelder and Mead search from the worst of them."""
    found: list[tuple[Array, Judged]] = []

    def cost(x: Array) -> float:
        item = at(x)
        if item is None:
            return 0.0
        found.append((np.array(x), item))
        return -item.badness

    for start in starts:
        cost(start)
    begin = max(found, key=lambda item: item[1].badness)[0]
    options = {"maxfev": SEARCH, "xatol": 1e-4, "fatol": 1e-6}
    bounds = list(zip(low, high, strict=True))
    minimize(cost, begin, method="Nelder-Mead", bounds=bounds, options=options)
    return max((item for _, item in found), key=lambda item: item.badness)
