"""Everything that a finished design is put through, and its figures for robustness.json."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView, loop_view
from ccd_casadi.analysis.move import Move, moves
from ccd_casadi.analysis.setpoint import Setpoint, setpoint
from ccd_casadi.analysis.setpoint_feedforward import feedforward_of
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.result import at_solve
from ccd_casadi.codesign.verdict import Check, State
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import sigma_max
from ccd_casadi.robust import Demands
from ccd_casadi.robust.margins import (
    DiskMargin,
    Margins,
    Noise,
    StructuredBound,
    gains,
    highest,
    margins,
    noise,
    norms,
    structured_bound,
)
from ccd_casadi.robust.perturbed import (
    Line,
    PerturbedLoop,
    Tolerances,
    damping_line,
    shift_line,
    single_modes,
    tolerances,
    worst_in_box,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import keep_quiet
from ccd_casadi.support.text import HZ
from ccd_casadi.support.worker_process import one_blas_thread
from ccd_casadi.synthesis.statics import Statics, statics_of


@dataclass(frozen=True)
class Study:
    """The results of a robustness study.

    Attributes
    ----------
    demands, view : Demands, LoopView
    peaks : tuple of (value, rad/s)
        The largest σ_max of S, T, GS and KS (0 rad/s: at rest), independent of the view's grid.
    margins, noise, statics : Margins, Noise, Statics
    shift, damping, modes, box : Line, Line, tuple of PerturbedLoop, PerturbedLoop
        Plants off the model: all resonances, damping, each mode, the worst of both.
    tolerances : Tolerances
        Of hardware.
    structured : StructuredBound or None
        None where no flexible mode is in the loop, and of a controller in discrete time.
    setpoint, moves : Setpoint, tuple of Move
        The move without and with feedforward.
    """

    demands: Demands
    view: LoopView
    peaks: tuple[tuple[float, float], ...]
    margins: Margins
    noise: Noise
    statics: Statics
    shift: Line
    damping: Line
    modes: tuple[PerturbedLoop, ...]
    box: PerturbedLoop
    tolerances: Tolerances
    structured: StructuredBound | None
    setpoint: Setpoint
    moves: tuple[Move, ...]

    @property
    def survives(self) -> bool:
        """Stable on every plant that was tried."""
        lines = (*self.shift.judged, *self.damping.judged, *self.modes, self.box)
        return all(item.stable for item in (*lines, self.tolerances.worst))


@one_blas_thread
def robustness(
    run: FinishedRun,
    demands: Demands | None = None,
    seed: int = 0,
    quiet: bool = True,
    workers: Pool | None = None,
) -> Study:
    """Study a run's controller on all demands; nothing is designed.

    Parameters
    ----------
    run : FinishedRun
        As `read_run` gives it.
    demands : Demands, optional
        Shifts, tolerances, noise and move; left out, the defaults.
    seed, quiet, workers : int, bool, Pool
        Of random hardware; whether without progress on stderr; processes.

    Returns
    -------
    Study
        The content of robustness.json.
    """
    with keep_quiet(quiet):
        return _study(run, demands or Demands(), seed, workers)


def _study(run: FinishedRun, d: Demands, seed: int, workers: Pool | None) -> Study:
    loop = run.loop  # as it runs
    sampled, modal = loop.sampling is not None, run.modal()
    profile = setpoint(d.limits)
    omega_b, low = run.figures.bandwidth, run.problem.inner.omega_low
    bounded = kind_of(run.problem).gain_bounds(run.weights, run.figures.gamma, np.nan)
    view = loop_view([loop], bounded, bandwidth_hz=omega_b / HZ)
    # a grid ends just below half the rate
    ends = [] if loop.sampling is None else [0.999 * 0.5 / loop.sampling.period]
    hz = np.append(view.hz, ends)

    def sizes(omega: Array) -> Array:
        if not (loop.at or loop.ported):
            return gains(*loop.responses(omega))
        S, found = [sigma_max(one.sensitivity(omega)) for one in loop.places], loop.curves(omega)
        return np.array([np.max(S, 0), *(sigma_max(found[name]) for name in ("T", "GS", "KS"))])

    def peaks() -> tuple[tuple[float, float], ...]:
        if sampled:
            return highest(sizes, HZ * hz)
        S = max((norms(one.closed)[0] for one in loop.places), key=lambda top: top[0])
        return S, *norms(loop.closed)[1:]

    return Study(
        demands=d,
        view=view,
        peaks=peaks(),
        margins=margins(replace(loop, at=()).responses, hz),  # broken at every sensor and input
        noise=noise(loop, d.sensor, d.disturbance),
        statics=statics_of(loop, bandwidth=omega_b, omega_low=low),
        shift=shift_line(run, d.shift),
        damping=damping_line(run, *d.damping),
        modes=single_modes(run, d.shift),
        box=worst_in_box(run, d.shift, d.damping),
        tolerances=tolerances(run, d.tolerance, d.samples, seed, workers),
        structured=None if sampled else structured_bound(run.plant, modal, run.controller, hz),
        setpoint=profile,
        moves=_moves(loop, profile, d, omega_b / HZ),
    )


def _moves(
    loop: Loop, profile: Setpoint, demands: Demands, bandwidth_hz: float
) -> tuple[Move, ...]:
    ahead = feedforward_of(loop, demands.axis)
    found = moves(
        [loop], (None,) if ahead is None else (None, ahead), profile, axis=demands.axis,
        window=demands.window, bandwidth_hz=bandwidth_hz,
    )  # fmt: skip
    return tuple(made for (made,) in found)


def study_dict(run: FinishedRun, study: Study) -> dict[str, Any]:
    """Make the content of robustness.json.

    Parameters
    ----------
    run, study : FinishedRun, Study

    Returns
    -------
    dict
        SI, and Hz where the name says so; shifts and tolerances are relative.
    """
    bound, hard, d = study.structured, study.tolerances, study.demands
    peaks = [item.peak for item in hard.judged if item.stable]
    quantiles = np.quantile(peaks, [0.5, 0.95, 1.0]) if peaks else ()
    margins, at, S_max = study.margins, study.statics, run.problem.inner.S_max
    noise = {
        "sensor_density": d.sensor, "force_density": d.disturbance,
        **{f"rms_{key}": value.tolist() for key, value in vars(study.noise).items()},
    }  # fmt: skip
    structured = None if bound is None else {
        "modes": bound.modes, "mu": 1.0 / bound.stiffness, "mu_complex": float(bound.mu.max()),
        "hz": bound.worst_hz, "stiffness": bound.stiffness, "shift": bound.shift,
    }  # fmt: skip
    return {
        "survives": study.survives,
        "S_max": S_max,
        "bandwidth_hz": run.figures.bandwidth / HZ,
        "sensitivity_peak": run.figures.sensitivity_peak,
        "margins": {
            "loops": [vars(item) | {"disk": _disk(item.disk)} for item in margins.loops],
            "all_outputs": _disk(margins.outputs),
            "all_inputs": _disk(margins.inputs),
        },
        "gains": {
            name: {"peak": peak, "peak_hz": omega / HZ}
            for name, (peak, omega) in zip(("S", "T", "GS", "KS"), study.peaks, strict=True)
        },
        "static_stiffness": at.stiffness,
        "static_compliance": at.compliance,
        "static_share": at.share,
        "period": None if run.sampling is None else run.sampling.period,
        "noise": noise,
        "resonance_shift": _line(study.shift, "shift"),
        "damping": _line(study.damping, "factor"),
        "single_modes": [_figures_of(item, "hz", "shift") for item in study.modes],
        "worst_shift_and_damping": _figures_of(study.box, "shift", "damping"),
        "tolerances": {
            "tolerance": hard.tolerance,
            "samples": len(hard.judged) + hard.failed,
            "no_plant": hard.failed,
            "unstable": hard.unstable,
            "stable_above_S_max": hard.above(S_max),
            "yield": hard.within(S_max).entry,
            "peak_quantiles": dict(zip(("50", "95", "100"), quantiles, strict=False)),
            "worst": {"theta": dict(zip(run.problem.names, hard.worst.place, strict=True))}
            | _figures_of(hard.worst),
        },
        "structured": structured,
        "move": {
            "limits": vars(d.limits) | {"window": d.window, "axis": d.axis + 1},
            "duration": study.setpoint.duration,
            "reached": {
                key: getattr(study.setpoint, key) for key in ("velocity", "acceleration", "jerk")
            },
            "without_suspension": True,  # moves, as all loops, have free bodies free
            "runs": [_move(move) for move in study.moves],
        },
    }


def survival_line(run: FinishedRun, study: Study) -> Check:
    """Update the line `survives` of a run's verdict by a study.

    Parameters
    ----------
    run, study : FinishedRun, Study

    Returns
    -------
    Check
        The solve's line and figures, with those of the study.
    """
    before = Check.read("survives", at_solve(run.result, "survives"))
    hard, d, (low, high) = study.tolerances, study.demands, study.shift.stable
    demanded = {"shift": d.shift, "damping": list(d.damping), "tolerance": d.tolerance}
    machines = {"plants": len(hard.judged), "unstable": hard.unstable}
    found = [] if study.survives else [Reason.ROBUSTNESS_UNSTABLE()]
    if low > -d.shift or high < d.shift:
        found = [Reason.SHIFTS_UNSTABLE(stable_between=[low, high], **demanded)]
    if hard.unstable or not hard.worst.stable:
        why = Reason.HARDWARE_UNSTABLE if hard.unstable else Reason.WORST_HARDWARE_UNSTABLE
        shifts = [one for one in found if one.reason is Reason.SHIFTS_UNSTABLE]
        found = [why(**machines, **demanded), *shifts]
    found = [Reason.ROBUSTNESS_STABLE()] if study.survives else found
    state = before.state
    if not study.survives and state is not State.FAILED:
        state = State.WARNED
    elif state is State.UNKNOWN:
        state = State.PASSED
    own = {"tolerance": hard.tolerance, **machines, "worst_stable": hard.worst.stable}
    robustness = {"stable_on_all": study.survives, "stable_between": [low, high], "hardware": own}
    findings = (*found, *before.findings)
    if run.case.robust.share is not None:  # what it is for comes first
        findings = (*before.findings, *found)
    findings = (*findings, Reason.ROBUSTNESS_TRIED(**demanded))
    return Check("survives", state, findings, {**before.figures, "robustness": robustness})


def _disk(margin: DiskMargin) -> dict[str, float]:
    return vars(margin) | {"gain": margin.gain, "phase_deg": margin.phase_deg}


def _figures_of(item: PerturbedLoop, *places: str) -> dict[str, Any]:
    """Write its figures, after the first of its places by these names."""
    return dict(zip(places, item.place, strict=False)) | {
        "stable": item.stable,
        "bandwidth_hz": item.bandwidth / HZ,
        "sensitivity_peak": item.peak,
    }


def _line(line: Line, name: str) -> dict[str, Any]:
    return {
        "stable_between": list(line.stable),
        "S_max_between": list(line.within),
        "plants": [_figures_of(item, name) for item in line.judged],
    }


def _move(move: Move) -> dict[str, Any]:
    shown = ("feedforward", "settling", "rms_error", "peak_error", "final_error")
    return {key: getattr(move, key) for key in shown} | {
        "peak_force": move.peak_force.tolist(),
        "peak_command": move.peak_command.tolist(),
        "rms_force": move.rms_force.tolist(),
    }
