"""The controller on plants off the model: shifted resonances and other damping."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.loops_off_model import LoopsOffModel, loops_off_model
from ccd_casadi.codesign.survival import damping_range, excess_of, growth_of, shift_range
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.lti.loop import Loop
from ccd_casadi.plants.modal import ModalPlant, Perturbation
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.robust.sampled import sampled_figures
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.progress import Progress

SEARCH = 120  # measurements of a search for the worst plant
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

    `stable` and `within` (S_max) are the ends, as far as the line goes, between which it does.
    """

    judged: tuple[PerturbedLoop, ...]
    stable: tuple[float, float]
    within: tuple[float, float]


def judge(run: FinishedRun, modal: ModalPlant, place: tuple[float, ...]) -> PerturbedLoop:
    """The run's controller on a plant."""
    plant = scale_plant(modal, run.problem.weights.M_K)
    if run.sampling is not None:
        loop = run.loop_on(plant.plant_si()).closed.S
        f = sampled_figures(loop)
        height, growth = f.sensitivity_peak if f.stable else np.inf, float(loop.rates.real.max())
        return PerturbedLoop(place, f.stable, f.bandwidth, height, growth)
    figures = run.measured(plant, run.controller)
    stable = figures.certificate.stable
    peak = figures.sensitivity_peak if stable else np.inf
    return PerturbedLoop(place, stable, figures.bandwidth, peak, figures.certificate.max_real_pole)


def shift_line(run: FinishedRun, reach: float, count: int = 41) -> Line:
    """All flexible frequencies times 1 + s, |s| <= reach."""
    shifts = np.unique(np.append(np.linspace(-reach, reach, count), 0.0))
    marks = [abs(end) for end in kind_of(run.problem).common_shifts()]
    places = {float(s): Perturbation(float(s)) for s in shifts}
    return _line(run, places, 0.0, partial(shift_range, limit=reach, marks=marks),
                 Progress(len(places), "resonance shifts"))  # fmt: skip


def damping_line(run: FinishedRun, low: float, high: float, count: int = 41) -> Line:
    """Damping times d, low <= d <= high; evenly in its logarithm."""
    factors = np.exp(np.unique(np.append(np.linspace(np.log(low), np.log(high), count), 0.0)))
    places = {float(d): Perturbation(0.0, float(d)) for d in factors}
    return _line(run, places, 1.0, partial(damping_range, limits=(low, high)),
                 Progress(len(places), "damping"))  # fmt: skip


def _line(
    run: FinishedRun, places: Mapping[float, Perturbation], model: float,
    search: Callable[[LoopsOffModel, Figure], Ends], progress: Progress,
) -> Line:  # fmt: skip
    """The plants at these places, and between what the loop is stable, and within S_max, by the
    search that the verdict of a solve makes; `model`: its place, where not even there."""
    loops = loops_off_model(run.system, run.controller, run.sampling, run.problem.suspension.free)
    nominal, stable, within = loops.at(Perturbation()), (model, model), (model, model)
    excess = partial(excess_of, level=run.problem.inner.S_max * (1.0 + kind_of(run.problem).slack))
    if nominal.stable:
        stable = search(loops, growth_of)
        within = search(loops, excess) if excess(nominal) <= 0.0 else within
    judged = [judge(run, run.modal(off), (place,))
              for place, off in progress.over(places.items())]  # fmt: skip
    return Line(tuple(judged), stable, within)


def single_modes(run: FinishedRun, reach: float) -> tuple[PerturbedLoop, ...]:
    """Every flexible mode that the loop drives and sees, alone, shifted by ±reach.

    Places are (frequency in Hz, shift).
    """
    modal = run.modal()
    residue = np.linalg.norm(modal.B, axis=1) * np.linalg.norm(modal.C, axis=0)
    found = []
    for i in np.flatnonzero(~modal.rigid & (residue > 1e-9 * residue.max())):
        for shift in (-reach, reach):
            K = modal.K.copy()
            K[i, i] *= (1.0 + shift) ** 2
            place = (float(modal.natural[i]) / (2.0 * np.pi), shift)
            found.append(judge(run, replace(modal, K=K), place))
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
) -> PerturbedLoop:
    """The worst of the starts, and of a bounded Nelder and Mead search from the worst of them."""
    found: list[tuple[Array, PerturbedLoop]] = []

    progress = Progress(len(starts) + SEARCH, label)

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
        options = {"maxfev": SEARCH, "xatol": 1e-4, "fatol": 1e-6}
        bounds = list(zip(low, high, strict=True))
        scipy.optimize.minimize(cost, begin, method="Nelder-Mead", bounds=bounds, options=options)
    return max((item for _, item in found), key=lambda item: item.badness)
