"""`tune`: the fastest PID with notches for plants that exist, measured or modelled.

A model becomes lines, hold and delay exact, and is designed on as a measured response is. At the
end it is a model again: the poles of the sampled loop and ‖S‖∞ by a Hamiltonian matrix decide.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from ccd_casadi.cases.measured_case import MeasuredCase
from ccd_casadi.deployment.realisation import realised
from ccd_casadi.fixed_structure import judgement
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.judgement import Judgement
from ccd_casadi.fixed_structure.measured_design import NEGATIVE, MeasuredDesign, design_on_data
from ccd_casadi.fixed_structure.measured_loop import bandwidth_within
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.kernels.sections import HALF_POWER
from ccd_casadi.lti.loop import Sampling, delay_parts, delayed, sampled, tustin
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import (
    FLANKS,
    StateSpace,
    balanced,
    closed_loop,
    frequency_grid,
    local_maxima,
    root_flanks,
    sigma_max,
    zoomed,
)
from ccd_casadi.plants.measured import MeasuredResponse, from_control, read_frequency_response
from ccd_casadi.plants.response_table import holds_lines
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import Tell, silent
from ccd_casadi.support.text import HZ
from ccd_casadi.support.worker_process import one_blas_thread
from ccd_casadi.synthesis import interchange

NOTCHES = 3  # at most, where none are asked for
INSIDE = 2e-3  # of S_max - 1: so far inside it the lines of a model are kept
PER_DECADE = 60
BELOW, ABOVE = 3e-3, 0.98  # first line over the slowest root, last line over half the rate
GIVEN_UP = 0.03  # of the bandwidth, for integral gain
ROUNDS = 5  # of adding lines where the loop on the model is worse than on the lines
SLOWER = 1e-3  # relative: of the bandwidth between the lines of a model, then more are added there
FINE, CLOSER = 200, 41  # frequencies a decade, and about a crossing, of a loop on a model
ON_AXIS = 1e-8  # |Re p| over |p| up to which a pole has no damping
BESIDE = 1e-3  # half width that it is taken to have for its lines
HIDDEN = 1e-12  # relative: how near a mode is to one that is not driven or not seen
NEARBY = np.linspace(0.98, 1.02, 9)
APART = 1e-6  # relative, of lines
AT_REST = 1e-7  # of the largest root: below, it lies at 0


Plant = MeasuredResponse | StateSpace
NOT_JUDGED = Judgement(0, {}, None, "no usable controller was found to judge")


@dataclass(frozen=True, repr=False)
class Tuned:
    """A tuned controller.

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
    starts: int = 24,
    seed: int = 0,
    progress: Tell | None = None,
    workers: Pool | None = None,
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
    starts, seed : int
        Of the multi-start search.
    progress, workers
        As for `synthesise_sections`; a pool of processes.

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
    given = list(plants) if isinstance(plants, list | tuple) else [plants]
    if not given:
        raise UserError("there is no plant to tune for; give one")
    tell = progress or silent
    own = {"unstable_poles": unstable_poles, "poles_at_zero": poles_at_zero,
           "least_damping": least_damping}  # fmt: skip
    stated = [name for name, value in own.items() if value is not None]
    known = [_read(item, delay, tell) for item in given]
    read = [_plant(item, rate_hz, late) for item, late in known]
    models = tuple(model for _, model in read)
    if stated and None not in models:
        words = f"{', '.join(stated)}: is of measured plants, and of a model its poles are known"
        raise UserError(f"{words}; drop it")
    responses = tuple(
        one if G is not None else replace(
            one, unstable_poles=unstable_poles or one.unstable_poles,
            poles_at_zero=one.poles_at_zero if poles_at_zero is None else poles_at_zero,
            least_damping=least_damping or one.least_damping)
        for one, G in read
    )  # fmt: skip
    if structure is None:
        biquads = min(NOTCHES, len(responses[0].resonances))
        structure = Structure(biquads=biquads, least_damping=0.1)
    periods = [model.period for model in models if model is not None]
    period = 1.0 / rate_hz if rate_hz else periods[0] if periods else None
    bounds = Bounds(S_max, S_max, HZ * max(one.hz[0] for one in responses), shape)
    names = [Path(item).name if isinstance(item, str | Path) else "" for item in given]
    name = ", ".join(n or f"plant {i}" for i, n in enumerate(names, 1))
    inside, initial = INSIDE * (S_max - 1.0) if periods else 0.0, None
    for _ in range(ROUNDS):
        aim = replace(bounds, S_max=S_max - inside)
        design = design_on_data(responses, structure, aim, period=period, starts=starts, seed=seed,
                                effort=effort, given_up=GIVEN_UP, initial=initial, progress=tell,
                                workers=workers)  # fmt: skip
        if not design.usable or not periods:
            break
        loops = _loops_on(models, design.controller, bounds, structure.integrator)
        found = [loop for loop in loops if loop is not None]
        worse = [loop for loop in found if not loop.norm <= S_max]
        slower = [loop for loop in found if loop.bandwidth < (1.0 - SLOWER) * design.bandwidth]
        if not worse and not slower:
            break
        inside, initial = inside * (2.0 if worse else 1.0), design.kappa
        near = [loop.peak for loop in worse] + [place for loop in slower for place in loop.limits]
        responses = tuple(one if G is None else _finer(one, G, near)
                          for one, G in zip(responses, models, strict=True))  # fmt: skip
    norms: tuple[float | None, ...] = tuple(None for _ in models)
    if periods and design.controller is not None:
        loops = _loops_on(models, design.controller, bounds, structure.integrator)
        design = _on_models(design, loops, S_max)
        norms = tuple(None if loop is None else loop.norm for loop in loops)
    case = MeasuredCase(Path(name), name, responses, structure, bounds, period, starts)
    judge, K = NOT_JUDGED, design.controller
    if design.usable and K is not None:
        coded = K if period is None else realised(tustin(K, period)).as_coded
        judge = judgement.together([
            judgement.attempted(_judged, plant, late, one, K, coded, bounds, design.bandwidth,
                                structure.integrator)
            for (plant, late), one in zip(known, responses, strict=True)
        ])  # fmt: skip
        words = f"as it was given the plant does not confirm it: {judge.words}; {design.words}"
        design = design if judge.passed else replace(design, usable=False, words=words)
    return Tuned(case, design, models, norms, judge)


def _judged(
    plant: Plant, delay: float, stated: MeasuredResponse, K: StateSpace, coded: StateSpace,
    bounds: Bounds, bandwidth: float, integrator: bool,
) -> Judgement:  # fmt: skip
    """What runs on a plant as it was read; its poles as they are `stated`."""
    if isinstance(plant, StateSpace):
        hold = Sampling(1.0 / coded.period, 1e6 * delay)
        return judgement.judge_loops([plant], K, coded, bounds, hold, bandwidth, integrator)
    plant = replace(plant, unstable_poles=stated.unstable_poles, poles_at_zero=stated.poles_at_zero)
    return judgement.judge_lines(plant, coded, bounds, delay, bandwidth, integrator)


@dataclass(frozen=True)
class LoopOnModel:
    """‖S‖∞ and its ω, the bandwidth at any frequency, and the ω that limit it; rad/s."""

    norm: float
    peak: float
    bandwidth: float
    limits: tuple[float, ...]


def _loops_on(
    models: Sequence[StateSpace | None], K: StateSpace | None, bounds: Bounds, integrator: bool
) -> list[LoopOnModel | None]:
    """The loop with each model; None with a response, or without a controller."""
    return [None if G is None or K is None else _loop_on(G, K, bounds, integrator) for G in models]


def _loop_on(G: StateSpace, K: StateSpace, bounds: Bounds, integrator: bool) -> LoopOnModel:
    """The loop with a model in discrete time; infinite and 0 where it is not stable."""
    S = closed_loop(G, tustin(K, G.period)).S
    norm, peak = hinf_norm(S)
    if not np.isfinite(norm):
        return LoopOnModel(norm, peak, 0.0, ())
    top = np.pi / G.period
    roots = S.rates
    low = BELOW * float(np.abs(roots).min())
    omega = frequency_grid(
        low, top, int(FINE * np.log10(top / low)), root_flanks(roots), apart=APART
    )

    def level(omega: np.ndarray) -> np.ndarray:
        return np.log(sigma_max(S.swept(omega.ravel()))).reshape(omega.shape)

    def held(omega: np.ndarray) -> np.ndarray:
        """-ln of the ω_b that the shape allows."""
        if bounds.shape is None:
            return level(omega)
        return np.log(bounds.reached(np.exp(level(omega) + HALF_POWER)) / omega)

    for curve in (level, held):
        top_at = local_maxima(curve(omega))
        ends = omega[top_at - 1], omega[top_at + 1]
        omega = np.union1d(omega, zoomed(curve, *ends)[0])
    found = bandwidth_within(omega, level(omega), bounds, integrator)
    for _ in range(2):  # it lies at a crossing, or by the shape at a maximum that is there already
        i = int(np.clip(np.searchsorted(omega, found), 1, len(omega) - 1))
        omega = np.union1d(omega, np.linspace(omega[i - 1], omega[i], CLOSER))
        found = bandwidth_within(omega, level(omega), bounds, integrator)
    return LoopOnModel(norm, peak, found, (found, float(omega[np.argmax(held(omega))])))


def _on_models(
    design: MeasuredDesign, loops: Sequence[LoopOnModel | None], S_max: float
) -> MeasuredDesign:
    """The design with the figures of its loops on the models, which hold between lines too."""
    known = [loop for loop in loops if loop is not None]
    over = [(i, loop) for i, loop in enumerate(loops, 1) if loop and not loop.norm <= S_max]
    if over:
        i, loop = over[0]
        words = f"the closed loop with plant {i} has ‖S‖∞ = {loop.norm:.4g}; {design.words}"
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


def _read(item: Any, delay: float, tell: Tell) -> tuple[Plant, float]:
    """A plant as it was given, and what it is behind in s."""
    if isinstance(item, str | Path):
        name, item = Path(item).name, _of_file(Path(item))
        tell(f"{name}: {item.words}")
    elif hasattr(item, "frdata"):
        item = from_control(item)
    if isinstance(item, MeasuredResponse):
        return item, delay
    if isinstance(item, interchange.NamedSystem):
        return item.system, delay + item.delay
    return interchange.from_control(item), delay


def _plant(
    item: Plant, rate_hz: float | None, delay: float
) -> tuple[MeasuredResponse, StateSpace | None]:
    """The response as the controller sees it; of a model also itself in discrete time."""
    if isinstance(item, MeasuredResponse):
        kept = item.hz < (np.inf if rate_hz is None else 0.5 * rate_hz)
        lag = np.exp(-1j * HZ * item.hz * delay)[:, None, None]
        G = (item.matrix * lag).reshape(item.G.shape)
        spread = item.spread if item.spread is None else item.spread[kept]
        return replace(item, hz=item.hz[kept], G=G[kept], spread=spread), None
    system = item
    own = system.period
    if own and rate_hz is None:
        rate_hz = 1.0 / own
    if rate_hz is None:
        words = "rate_hz is missing: nothing else limits the bandwidth of a controller for a model"
        raise UserError(f"{words}; give the controller's rate (--rate-hz) and its delay (--delay)")
    if system.D.any():
        raise UserError("the plant has feedthrough; give it the lag of its sensor or actuator")
    T = 1.0 / rate_hz
    if not own:
        model = sampled(system, T, delay)
    elif not np.isclose(own, T) or not np.isclose(delay_parts(T, delay)[1], 0.0, atol=1e-6 * T):
        raise UserError("a plant in discrete time runs at its rate, and a delay of whole periods")
    else:
        whole = delay_parts(T, delay)[0]
        model = delayed(system.A, [0.0 * system.B] * whole + [system.B], system.C, T)
    _require_seen(system)
    top, rates = np.pi / T, system.rates
    rest = np.abs(rates) <= AT_REST * np.abs(rates).max(initial=0.0)
    zeros = system.rates_of(system.zeros(1.0 if own else top))
    if (np.abs(zeros) <= AT_REST * top).any():
        raise UserError("the plant has a zero at 0: no controller holds its output at rest")
    roots = np.concatenate([rates[~rest], zeros, [top]])
    low = BELOW * np.abs(roots[np.abs(roots) > 1e-9 * top]).min()
    roots = _folded(roots, T)
    undamped = np.abs(rates.real) <= ON_AXIS * np.abs(rates)
    axis = _folded(rates[undamped & ~rest & (rates.imag > 0.0)], T).imag
    narrow = np.abs(roots.real) <= ON_AXIS * np.abs(roots)
    beside = root_flanks(
        BESIDE * np.abs(roots[narrow]) + 1j * roots[narrow].imag, FLANKS[FLANKS != 0.0]
    )
    omega = frequency_grid(low, ABOVE * top, int(PER_DECADE * np.log10(top / low)),
                           root_flanks(roots[~narrow]), beside, apart=APART)  # fmt: skip
    close = np.abs(omega[:, None] - axis) <= 0.1 * BESIDE * axis
    omega = omega[~close.any(axis=1)]
    unstable = int((rates[~rest & ~undamped].real > 0.0).sum())
    G = model.response(omega)
    one = G.shape[1:] == (1, 1)
    found = MeasuredResponse(omega / HZ, G[:, 0, 0] if one else G, unstable, modelled=True,
                             undamped_hz=tuple((axis / HZ).tolist()))  # fmt: skip
    return found, model


def _folded(rates: np.ndarray, T: float) -> np.ndarray:
    """Rates in 1/s with their frequencies where a sampled system has them, up to half the rate."""
    turns = np.abs(rates.imag) * T
    return np.asarray(
        rates.real + 1j * np.abs(turns - 2.0 * np.pi * np.round(turns / (2.0 * np.pi))) / T
    )


def _require_seen(system: StateSpace) -> None:
    """Raises UserError where a mode that is not stable is not driven or not measured: Hautus."""
    if not system.B.any() or not system.C.any():
        raise UserError("the plant is 0: no input moves what is measured")
    A, B, C = balanced(system.A, system.B, system.C)
    size = np.linalg.norm(A, 2) or 1.0
    parts = {"driven by no input": (B * (size / np.linalg.norm(B, 2)), 1),
             "seen at no output": (C * (size / np.linalg.norm(C, 2)), 0)}  # fmt: skip
    rates = np.log(system.poles.astype(complex) + 0j) if system.period else system.poles
    for root, rate in zip(system.poles, rates, strict=True):
        if not rate.real >= -ON_AXIS * max(abs(rate), AT_REST * size):
            continue
        for words, (beside, axis) in parts.items():
            joined = np.concatenate([root * np.eye(len(A)) - A, beside], axis=axis)
            if np.linalg.svd(joined, compute_uv=False)[-1] <= HIDDEN * size:
                at = f"{abs(rate) / (system.period or 1.0) / HZ:.4g} Hz"
                raise UserError(f"a mode of the plant at {at} is not stable and {words}: no "
                                "controller changes it; leave it out")  # fmt: skip


def _of_file(path: Path) -> MeasuredResponse | interchange.NamedSystem:
    """A measured response, or the one model of a .mat file."""
    try:
        variables = scipy.io.whosmat(path) if path.suffix.lower() == ".mat" else []
    except Exception:  # a damaged file: what reads it says so
        variables = []
    names = {name for name, _, _ in variables}
    if holds_lines(sorted(names)) or not (
        {"A", "B", "C"} <= names or any(kind == "struct" for _, _, kind in variables)
    ):
        return read_frequency_response(path)
    systems = interchange.read_mat(path).systems
    if len(systems) != 1:
        raise UserError(f"{path}: holds the systems {', '.join(systems)}; save one plant a file")
    return next(iter(systems.values()))


def _finer(response: MeasuredResponse, G: StateSpace, omega: list[float]) -> MeasuredResponse:
    """With lines where |S| was too large between two, or the bandwidth ends, and nearby."""
    more = (np.array(omega)[:, None] * NEARBY).ravel() / HZ
    known = response.hz
    hz = frequency_grid(float(known[0]), float(known[-1]), 2, known, more, apart=APART)
    axis = np.array(response.undamped_hz)
    hz = hz[~(np.abs(hz[:, None] - axis) <= 0.1 * BESIDE * axis).any(axis=1)]
    return replace(response, hz=hz, G=G.response(HZ * hz).reshape(len(hz), *response.G.shape[1:]))
