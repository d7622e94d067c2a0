"""`tune`: the fastest PID with notches for plants that exist, measured or modelled.

A model becomes lines, hold and delay exact, and is designed on as a measured response is. At the
end it is a model again: the poles of the sampled loop and ‖S‖∞ by a Hamiltonian matrix decide.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.cases.measured_case import MeasuredCase
from ccd_casadi.deployment.realisation import realise_blocks
from ccd_casadi.extensions.measured.measured_design import NEGATIVE, MeasuredDesign, design_on_data
from ccd_casadi.extensions.measured.measured_loop import bandwidth_within
from ccd_casadi.extensions.measured.tuned_plants import (
    LineOptions,
    Plant,
    as_lines,
    read_plant,
    with_lines_near,
)
from ccd_casadi.fixed_structure import judgement
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.judgement import Judgement
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.kernels.sections import HALF_POWER
from ccd_casadi.lti.frequency_grid import frequency_grid, local_maxima, root_flanks, zoom
from ccd_casadi.lti.loop import Sampling, tustin
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace, closed_loop, sigma_max
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import HZ, use_units
from ccd_casadi.support.worker_process import one_blas_thread


@dataclass(frozen=True)
class TuningOptions:
    """Numbers of `tune`."""

    most_notches: int = 3  # biquads where no structure is given
    inside: float = 2e-3  # share of S_max - 1 by which S_max is reduced on the lines of a model
    given_up: float = 0.03  # share of the bandwidth that is given up for integral gain
    rounds: int = 10  # of adding lines where the loop on the model is worse than on the lines
    most_starts: int = 48  # up to which starts are doubled after a search without usable controller
    slower: float = 1e-3  # loss of bandwidth between a model's lines from which lines are added
    per_decade: int = 200  # frequencies of a loop on a model
    about_crossing: int = 41  # frequencies about its crossing


NOT_JUDGED = Judgement(0, {}, None, "no usable controller was found to judge")


@dataclass(frozen=True, repr=False)
class Tuned:
    """A tuned controller and its judgement.

    Parameters
    ----------
    case, design : MeasuredCase, MeasuredDesign
        The lines, and the design on them.
    models, norms : tuple of StateSpace, tuple of float
        Plants in discrete time, and ‖S‖∞ of their loops, infinite where poles are not stable.
    judge : Judgement
        The deployed controller on the plants as they were given; the design is usable if it passes.
    """

    case: MeasuredCase
    design: MeasuredDesign
    models: tuple[StateSpace | None, ...]
    norms: tuple[float | None, ...]
    judge: Judgement = NOT_JUDGED

    def __repr__(self) -> str:
        made = self.design
        how = f"{made.bandwidth / HZ:.6g} Hz, {'usable' if made.usable else 'not usable'}"
        return f"<Tuned {self.case.file}: {how}; {made.words}>"

    @property
    def controller(self) -> StateSpace | None:
        """K(s) in SI, e = r - y to u; it runs by Tustin's rule."""
        return self.design.controller


@one_blas_thread
def tune(
    plants: Any,
    *,
    rate_hz: float | None = None,
    delay: float = 0.0,
    S_max: float = 1.8,
    shape: float = 1.1,
    effort: float | None = 20.0,
    structure: Structure | None = None,
    unstable_poles: int | None = None,
    poles_at_zero: int | None = None,
    least_damping: float | None = None,
    rotary: bool = False,
    spread: float = 1.0,
    starts: int = 24,
    seed: int = 0,
    progress: Log | None = None,
    workers: Pool | None = None,
    options: TuningOptions = TuningOptions(),
) -> Tuned:
    """The largest bandwidth of integrator, lead, notches and a second-order roll-off.

        max ω_b   s.t.  on each plant: stable, |S| <= S_max, |S(jω)| <= (ω/ω_b)/√2 for ω <= ω_b,
                        |S(jω)| within the shape above,   |KS| <= effort/|G| about ω_b

    Parameters
    ----------
    plants : path, MeasuredResponse or system of python-control, or a list of them
        A file as `read_frequency_response` takes it or .mat with A, B, C, D (and Ts), or an FRD, a
        TransferFunction, a StateSpace; of a list one controller for all.
    rate_hz, delay : float
        Of K, Hz (models, stable or not, are held; responses have the hold in them); besides, s.
    S_max, shape, effort : float
        The bounds; `effort` keeps noise and lead in bounds.
    structure : Structure, optional
        Left out, a biquad for each resonance, three at most.
    unstable_poles, poles_at_zero, least_damping : int, int, float
        Of measured plants: poles in the right half plane (0) and at 0 (by the slope of the first
        lines), and the least damping ratio of a resonance that lines may hide (0.0005).
    rotary : bool
        Outputs are in rad and inputs in N m, in words and on pages; else m and N.
    spread : float
        Factor on the spread of responses: every bound holds for all plants within it.
    starts, seed : int
        Of the multi-start search.
    progress, workers
        As for `synthesise_sections`; a pool of processes.
    options : TuningOptions
        Numbers of the method.

    Returns
    -------
    Tuned
        The design, and its loops on the models.

    Raises
    ------
    UserError
        Something is no such plant, is not understood, or a model comes without a rate.

    Examples
    --------
    >>> import ccd_casadi as ccd, control
    >>> found = ccd.tune(control.tf([1.0], [1.0, 3.0, 3.0, 1.0]), rate_hz=10.0, starts=2)
    >>> found.design.usable, found.design.structure.biquads
    (True, 0)
    """
    use_units(*(("rad", "N m") if rotary else ("m", "N")))
    given = list(plants) if isinstance(plants, list | tuple) else [plants]
    _require_numbers(given, S_max, shape, {"rate_hz": rate_hz, "effort": effort})
    log = progress or silent
    stated = {"unstable_poles": unstable_poles, "poles_at_zero": poles_at_zero,
              "least_damping": least_damping}  # fmt: skip
    known = _read_plants(given, delay, stated, spread, log)
    names = [Path(item).name if isinstance(item, str | Path) else "" for item in given]
    responses, models = _place_on_lines(known, names, rate_hz)
    if structure is None:
        biquads = min(options.most_notches, len(responses[0].resonances))
        structure = Structure(biquads=biquads, least_damping=0.1)
    periods = [model.period for model in models if model is not None]
    period = 1.0 / rate_hz if rate_hz else periods[0] if periods else None
    bounds = Bounds(S_max, S_max, HZ * max(one.hz[0] for one in responses), shape)
    search = partial(
        design_on_data, structure=structure, period=period, seed=seed, effort=effort,
        given_up=options.given_up, progress=log, workers=workers,
    )  # fmt: skip
    inside = options.inside * (S_max - 1.0) if periods else 0.0
    trial = _Trial(responses, inside, starts)
    for _ in range(options.rounds):
        design = trial.design(search, bounds)
        loops = _loops_on(models, design.controller, bounds, structure.integrator, options)
        following = trial.follow(design, models, loops, S_max, options)
        if following is None:
            break
        trial = following
    norms: tuple[float | None, ...] = tuple(None for _ in models)
    if periods and design.controller is not None:
        design = _on_models(design, loops, S_max)
        norms = tuple(None if loop is None else loop.norm for loop in loops)
    name = ", ".join(n or f"plant {i}" for i, n in enumerate(names, 1))
    case = MeasuredCase(Path(name), name, trial.responses, structure, bounds, period, trial.starts)
    design, judge = _confirm(design, known, case)
    return Tuned(case, design, models, norms, judge)


def _require_numbers(
    given: Sequence[Any], S_max: float, shape: float, positive: Mapping[str, float | None]
) -> None:
    """Raise UserError where an argument has no meaning."""
    if not given:
        raise UserError("there is no plant to tune for; give one")
    if not 1.0 < S_max < np.inf:
        raise UserError(f"S_max: is {S_max:.6g}; no loop has less than 1, so give more")
    if not 1.0 <= shape < np.inf:
        raise UserError(f"shape: is {shape:.6g}; give 1 or more")
    for key, value in positive.items():
        if value is not None and not 0.0 < value < np.inf:
            raise UserError(f"{key}: is {value:.6g}; give a number above 0")


def _read_plants(
    given: Sequence[Any], delay: float, stated: Mapping[str, Any], spread: float, log: Log
) -> list[tuple[Plant, float]]:
    """Read each plant and its delay in s, with what is stated of the measured ones."""
    known = [read_plant(item, delay, log) for item in given]
    names = [name for name, value in stated.items() if value is not None]
    if names and all(isinstance(item, StateSpace) for item, _ in known):
        words = f"{', '.join(names)}: is of measured plants, and of a model its poles are known"
        raise UserError(f"{words}; drop it")

    def complete(item: Plant) -> Plant:
        if isinstance(item, StateSpace):
            return item
        at_zero = stated["poles_at_zero"]
        return replace(
            item, unstable_poles=stated["unstable_poles"] or item.unstable_poles,
            poles_at_zero=item.poles_at_zero if at_zero is None else at_zero,
            least_damping=stated["least_damping"] or item.least_damping,
            spread=None if item.spread is None or not spread else spread * item.spread,
        )  # fmt: skip

    return [(complete(item), late) for item, late in known]


def _place_on_lines(
    known: Sequence[tuple[Plant, float]], names: Sequence[str], rate_hz: float | None
) -> tuple[tuple[MeasuredResponse, ...], tuple[StateSpace | None, ...]]:
    """Find each plant's lines, and its model in discrete time where it is one."""
    read = []
    for i, ((item, late), name) in enumerate(zip(known, names, strict=True), 1):
        try:
            read.append(as_lines(item, rate_hz, late))
        except UserError as error:
            raise UserError(f"{name or f'plant {i}'}: {error}" if known[1:] else error) from None
    return tuple(one for one, _ in read), tuple(model for _, model in read)


@dataclass(frozen=True)
class _Trial:
    """What a design on lines is searched with: `inside`, by how much S_max is less there, and where
    the search starts, None: from `starts` alone."""

    responses: tuple[MeasuredResponse, ...]
    inside: float
    starts: int
    initial: Array | None = None

    def design(self, search: Callable[..., MeasuredDesign], bounds: Bounds) -> MeasuredDesign:
        """Search the design on the lines."""
        aim = replace(bounds, S_max=bounds.S_max - self.inside)
        return search(self.responses, bounds=aim, starts=self.starts, initial=self.initial)

    def follow(
        self, design: MeasuredDesign, models: Sequence[StateSpace | None],
        loops: "Sequence[LoopOnModel | None]", S_max: float, options: TuningOptions,
    ) -> "_Trial | None":  # fmt: skip
        """Find the next trial; None where the design is as good on the models as on their lines."""
        found = [loop for loop in loops if loop is not None]
        worse = [loop for loop in found if not loop.norm <= S_max]
        least = (1.0 - options.slower) * design.bandwidth
        slower = [loop for loop in found if loop.bandwidth < least]
        if all(G is None for G in models) or (design.usable and not worse and not slower):
            return None
        near = [place for loop in worse for place in loop.peaks]
        near += [place for loop in slower for place in loop.limits]
        responses = tuple(one if G is None else with_lines_near(one, G, near)
                          for one, G in zip(self.responses, models, strict=True))  # fmt: skip
        if design.usable:
            return _Trial(responses, (2.0 if worse else 1.0) * self.inside, self.starts,
                          design.kappa)  # fmt: skip
        # A local search that ends outside its bounds is begun anew, with more starts.
        more = min(2 * self.starts, max(self.starts, options.most_starts))
        return _Trial(responses, self.inside, more)


def _confirm(
    design: MeasuredDesign, known: Sequence[tuple[Plant, float]], case: MeasuredCase
) -> tuple[MeasuredDesign, Judgement]:
    """Judge a usable design on the plants as they were given, which may refute that it is."""
    K = design.controller
    if not design.usable or K is None:
        return design, NOT_JUDGED
    coded = K if case.period is None else realise_blocks(tustin(K, case.period)).as_coded
    judge = judgement.together([
        judgement.attempt_judgement(_judge, plant, late, K, coded, case.bounds, design.bandwidth,
                                    case.structure.integrator)
        for plant, late in known
    ])  # fmt: skip
    if judge.passed:
        return design, judge
    words = f"as it was given the plant does not confirm it: {judge.words}; {design.words}"
    return replace(design, usable=False, words=words), judge


def _judge(
    plant: Plant, delay: float, K: StateSpace, coded: StateSpace, bounds: Bounds, bandwidth: float,
    integrator: bool,
) -> Judgement:  # fmt: skip
    """Judge the code that runs on a plant as it was read."""
    if isinstance(plant, StateSpace):
        hold = Sampling(1.0 / coded.period, 1e6 * delay)
        return judgement.judge_loops([plant], K, coded, bounds, hold, bandwidth, integrator)
    return judgement.judge_lines(plant, coded, bounds, delay, bandwidth, integrator)


@dataclass(frozen=True)
class LoopOnModel:
    """‖S‖∞ and its ω, the bandwidth at any frequency, the ω that limit it, and the ω of all maxima
    of |S| that exceed S_max, or of unstable poles; rad/s."""

    norm: float
    peak: float
    bandwidth: float
    limits: tuple[float, ...]
    peaks: tuple[float, ...]


def _loops_on(
    models: Sequence[StateSpace | None],
    K: StateSpace | None,
    bounds: Bounds,
    integrator: bool,
    options: TuningOptions,
) -> list[LoopOnModel | None]:
    """The loop with each model; None with a response, or without a controller."""
    return [
        None if G is None or K is None else _loop_on(G, K, bounds, integrator, options)
        for G in models
    ]


def _loop_on(
    G: StateSpace, K: StateSpace, bounds: Bounds, integrator: bool, options: TuningOptions
) -> LoopOnModel:
    """The loop with a model in discrete time; infinite and 0 where it is not stable."""
    S = closed_loop(G, tustin(K, G.period)).S
    norm, peak = hinf_norm(S)
    if not np.isfinite(norm):  # the lines about the unstable poles missed a turn
        rates = S.rates[S.rates.real >= 0.0]
        near = np.abs(rates.imag[rates.imag > 0.0])
        return LoopOnModel(norm, peak, 0.0, (), tuple(near.tolist()))
    top = np.pi / G.period
    roots = S.rates
    low = LineOptions.lowest * float(np.abs(roots).min())
    count = int(options.per_decade * np.log10(top / low))
    omega = frequency_grid(low, top, count, root_flanks(roots), apart=LineOptions.apart)

    def level(omega: np.ndarray) -> np.ndarray:
        return np.log(sigma_max(S.sweep(omega.ravel()))).reshape(omega.shape)

    def held(omega: np.ndarray) -> np.ndarray:
        """-ln of the ω_b that the shape allows."""
        if bounds.shape is None:
            return level(omega)
        return np.log(bounds.reached(np.exp(level(omega) + HALF_POWER)) / omega)

    for curve in (level, held):
        top_at = local_maxima(curve(omega))
        ends = omega[top_at - 1], omega[top_at + 1]
        omega = np.union1d(omega, zoom(curve, *ends)[0])
    curve_S = level(omega)
    tops = local_maxima(curve_S)
    over = omega[tops[curve_S[tops] > np.log(bounds.S_max)]]
    peaks = tuple(np.unique([peak, *over]).tolist()) if norm > bounds.S_max else ()
    found = bandwidth_within(omega, curve_S, bounds, integrator)
    for _ in range(2):  # it lies at a crossing, or by the shape at a maximum that is there already
        i = int(np.clip(np.searchsorted(omega, found), 1, len(omega) - 1))
        omega = np.union1d(omega, np.linspace(omega[i - 1], omega[i], options.about_crossing))
        found = bandwidth_within(omega, level(omega), bounds, integrator)
    limits = found, float(omega[np.argmax(held(omega))])
    return LoopOnModel(norm, peak, found, limits, peaks)


def _on_models(
    design: MeasuredDesign, loops: Sequence[LoopOnModel | None], S_max: float
) -> MeasuredDesign:
    """The design with the figures of its loops on the models, which hold between lines too."""
    known = [loop for loop in loops if loop is not None]
    over = [(i, loop) for i, loop in enumerate(loops, 1) if loop and not loop.norm <= S_max]
    if over:
        i, loop = over[0]
        words = f"the closed loop with plant {i} has ‖S‖∞ = {loop.norm:.4g}; {design.words}"
        if not np.isfinite(loop.norm):  # whatever the winding on lines of frequency says
            words = (
                f"the sampled loop with model {i} is not stable by its poles; more starts may find "
                "a controller that stabilises it"
            )
        return replace(design, usable=False, words=words)
    if not design.usable or design.figures is None:
        return design
    only = len(known) == len(loops)
    worst, figures = max(known, key=lambda loop: loop.norm), design.figures
    bandwidth = min(loop.bandwidth for loop in known)
    if only or worst.norm >= figures.S_peak:
        figures = replace(figures, S_peak=worst.norm, S_peak_frequency=worst.peak)
    if only:
        figures = replace(figures, S_between=worst.norm, S_between_frequency=worst.peak)
    bandwidth = bandwidth if only else min(bandwidth, design.bandwidth)
    words = (
        f"stable by the poles of the sampled loop, ‖S‖∞ = {worst.norm:.4g} by a Hamiltonian matrix"
    )
    words = words if design.sign > 0.0 else f"{words}; {NEGATIVE}"
    words = words if only else f"{words} on the models; on the lines {design.words}"
    return replace(design, bandwidth=bandwidth, figures=replace(figures, bandwidth=bandwidth),
                   words=words)  # fmt: skip
