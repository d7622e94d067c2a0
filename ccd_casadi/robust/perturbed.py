"""Plants off the model: perturbed resonances, damping and hardware, and the figures of a loop on
them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from ccd_casadi.analysis.loop_channels import loop_figures
from ccd_casadi.analysis.yield_bound import Yield
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.survival import (
    PEAK,
    LoopsOffModel,
    damping_range,
    growth_of,
    loops_off_model,
    range_within,
    shift_range,
)
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import free_modal, plant_of
from ccd_casadi.lti.frequency_grid import frequency_grid, root_flanks
from ccd_casadi.lti.loop import Loop, zoh
from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.state_space import StateSpace, closed_loop, sensitivity, sigma_max
from ccd_casadi.plants.modal import ModalPlant, Perturbation
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.robust.margins import highest
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.process_pool import Pool, Workers, results
from ccd_casadi.support.terminal import Progress
from ccd_casadi.support.text import HZ


def sampled_compliance(
    plant: StateSpace, held: StateSpace, K: StateSpace, places: Sequence[BreakPoint] = (), *,
    delay: float = 0.0, decades: int = 6, per_decade: int = 60,
) -> float:  # fmt: skip
    """Find the compliance of a sampled loop, max over ω <= π/T of σ_max(S(e^{jωT}) G(jω)).

    A sinusoidal force f beside the held one acts continuously: the outputs at the instants are
    S G f. The aliased effect of faster forces is not included. S is (1 + L)⁻¹ of the responses:
    beside free bodies G is large and S small, and 1 - T would lose its digits. Of a `ForcedPlant`
    G is what disturbing forces move; where something else counts it moves by G_z f - G_u K S G f.

    Parameters
    ----------
    plant : StateSpace
        G in SI without hold and delay.
    held, K : StateSpace
        The plant with both, and the controller, in discrete time; their loop is stable.
    places : sequence of BreakPoint
        Of several sensors on one actuator: the first is whose error counts.
    delay : float
        s.
    decades, per_decade : int
        Of the grid below π/T, and its points in each.

    Returns
    -------
    float
        m/N.
    """
    end, S = np.pi / held.period, closed_loop(held, K).S
    near = root_flanks(np.concatenate([S.rates, plant.poles]))
    forced, counted = getattr(plant, "mechanics", plant), getattr(plant, "counted", None)
    driven = None if counted is None else zoh(counted, held.period, delay)
    grid = frequency_grid(end * 10.0**-decades, end, decades * per_decade, near)

    def gain(at: Array) -> Array:
        k, p = K.response(at), len(held.C)
        errors, free = sensitivity(held.response(at) @ k), forced.response(at)
        moved = errors @ free[:, :p]
        if driven is not None:
            moved = free[:, p:] - driven.response(at)[:, p:] @ k @ moved
        return sigma_max(np.array([places[0].output]) @ moved if places else moved)[None]

    return highest(gain, grid)[0][0]


Figure = Callable[[Loop], float]
Ends = tuple[float, float]


@dataclass(frozen=True)
class PerturbedLoop:
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

    `stable` and `within` are the ends, as far as the line goes, between which it does; within
    S_max, or `slack` more (relative).
    """

    judged: tuple[PerturbedLoop, ...]
    stable: tuple[float, float]
    within: tuple[float, float]
    slack: float


def judge(run: FinishedRun, modal: ModalPlant, place: tuple[float, ...]) -> PerturbedLoop:
    """The run's controller on a plant."""
    plant = scale_plant(modal, run.problem.weights.M_K)
    if run.sampling is not None:
        loop = run.loop_on(plant.plant_si())
        f = loop_figures(closed_loop(*loop.as_run), loop.at)
        height, growth = f.sensitivity_peak if f.stable else np.inf, float(loop.poles.real.max())
        return PerturbedLoop(place, f.stable, f.bandwidth, height, growth)
    figures = run.measure(plant, run.controller)
    stable = figures.certificate.stable
    peak = figures.sensitivity_peak if stable else np.inf
    return PerturbedLoop(place, stable, figures.bandwidth, peak, figures.certificate.max_real_pole)


def shift_line(run: FinishedRun, reach: float, count: int = 41) -> Line:
    """All flexible frequencies times 1 + s, |s| <= reach."""
    shifts = np.unique(np.append(np.linspace(-reach, reach, count), 0.0))
    held = kind_of(run.problem).common_shifts()
    marks = [abs(end) for end in held]
    places = {float(s): Perturbation(float(s)) for s in shifts}
    return _line(run, places, 0.0, held, partial(shift_range, limit=reach, marks=marks),
                 Progress(len(places), "resonance shifts"))  # fmt: skip


def damping_line(run: FinishedRun, low: float, high: float, count: int = 41) -> Line:
    """Damping times d, low <= d <= high; evenly in its logarithm."""
    factors = np.exp(np.unique(np.append(np.linspace(np.log(low), np.log(high), count), 0.0)))
    places = {float(d): Perturbation(0.0, float(d)) for d in factors}
    own = (1.0, *kind_of(run.problem).other_factors()[0])
    return _line(run, places, 1.0, (min(own), max(own)), partial(damping_range, limits=(low, high)),
                 Progress(len(places), "damping"))  # fmt: skip


def _line(
    run: FinishedRun, places: Mapping[float, Perturbation], model: float, held: Ends,
    search: Callable[[LoopsOffModel, Figure], Ends], progress: Progress,
) -> Line:  # fmt: skip
    """The plants at these places, and between what the loop is stable, and within S_max, by the
    search that the verdict of a solve makes; `model`: its place, where not even there; `held`: the
    ends of the set's own part of the line."""
    problem = run.problem
    loops = loops_off_model(run.system, run.controller, run.sampling, problem.suspension.free,
                            kind_of(problem).bounds().places)  # fmt: skip
    nominal, stable, within, slack = loops.at(Perturbation()), (model, model), (model, model), PEAK
    held = (max(held[0], min(places)), min(held[1], max(places)))
    if nominal.stable:
        stable = search(loops, growth_of)
        within, slack = range_within(
            loops, partial(search, loops), run.problem.inner.S_max, kind_of(run.problem).slack, held
        )
    judged = [judge(run, run.modal(off), (place,))
              for place, off in progress.over(places.items())]  # fmt: skip
    return Line(tuple(judged), stable, within, slack)


def single_modes(run: FinishedRun, reach: float) -> tuple[PerturbedLoop, ...]:
    """Every flexible mode that the loop drives and sees, alone, shifted by ±reach.

    Places are (frequency in Hz, shift).
    """
    modal = run.modal()
    residue = np.linalg.norm(modal.B, axis=1) * np.linalg.norm(modal.C, axis=0)
    found = []
    for number, i in enumerate(modal.numbered):
        for shift in (-reach, reach) if residue[i] > 1e-9 * residue.max() else ():
            off = Perturbation(modes=(*[0.0] * number, shift))
            found.append(judge(run, run.modal(off), (float(modal.natural[i]) / HZ, shift)))
    return tuple(found)


def worst_in_box(run: FinishedRun, reach: float, damping: tuple[float, float]) -> PerturbedLoop:
    """The worst (shift, damping factor) of the box: a grid, then a local search from its worst."""
    low, high = np.array([-reach, np.log(damping[0])]), np.array([reach, np.log(damping[1])])

    def at(x: Array) -> PerturbedLoop:
        s, d = float(x[0]), float(np.exp(x[1]))
        return judge(run, run.modal(Perturbation(s, d)), (s, d))

    grid = [np.array([s, d]) for s in np.linspace(low[0], high[0], 9)
            for d in np.linspace(low[1], high[1], 5)]  # fmt: skip
    return search(at, grid, low, high, "shift and damping")


def search(
    at: Callable[[Array], PerturbedLoop | None],
    starts: list[Array],
    low: Array,
    high: Array,
    label: str,
    *,
    steps: int = 120,
) -> PerturbedLoop:
    """The worst of the starts, and of a bounded Nelder and Mead search from the worst of them."""
    found: list[tuple[Array, PerturbedLoop]] = []

    progress = Progress(len(starts) + steps, label)

    def cost(x: Array) -> float:
        item = at(x)
        progress.advance()
        if item is None:
            return 0.0
        found.append((np.array(x), item))
        return -item.badness

    with progress:
        for start in starts:
            cost(start)
        begin = max(found, key=lambda item: item[1].badness)[0]
        options = {"maxfev": steps, "xatol": 1e-4, "fatol": 1e-6}
        bounds = list(zip(low, high, strict=True))
        scipy.optimize.minimize(cost, begin, method="Nelder-Mead", bounds=bounds, options=options)
    return max((item for _, item in found), key=lambda item: item.badness)


@dataclass(frozen=True)
class Tolerances:
    """Random hardware and the worst found within the tolerances; places are θ."""

    tolerance: float
    judged: tuple[PerturbedLoop, ...]
    failed: int
    worst: PerturbedLoop

    @property
    def unstable(self) -> int:
        """The number of the random plants that are unstable."""
        return sum(not item.stable for item in self.judged)

    def above(self, peak: float) -> int:
        """Count the stable ones that have a larger peak of S."""
        return sum(item.stable and item.peak > peak for item in self.judged)

    def within(self, S_max: float) -> Yield:
        """Return the yield of the random plants that are stable with a peak of S up to S_max."""
        return Yield(sum(one.stable and one.peak <= S_max for one in self.judged), len(self.judged))


def tolerances(
    run: FinishedRun, tolerance: float, samples: int, seed: int, workers: Pool | None = None,
    *, few: int = 5, starts_of_search: int = 2,
) -> Tolerances:  # fmt: skip
    """Uniformly random θ within ± `tolerance` (relative) of the design's, and the worst θ found.

    The controller stays. θ may leave its bounds by the tolerance. `failed` counts hardware of
    which the model makes no plant. `workers` share the random ones. Of up to `few` parameters all
    corners are tried; the search starts from these and the worst random ones.
    """
    pool = workers or Workers(1)
    theta = np.array(run.theta)
    rng = np.random.default_rng(seed)
    unit = rng.uniform(-1.0, 1.0, (samples, theta.size))
    if theta.size <= few:
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
    starts = [*signs, *unit[order[:starts_of_search]]]
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
