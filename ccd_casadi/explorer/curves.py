"""What is drawn of one design: gains, Nyquist, poles, a step and a move; pure functions of it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ccd_casadi.analysis.loop_figures import step_response
from ccd_casadi.analysis.loop_view import LoopView, loop_view
from ccd_casadi.analysis.move import Move, mass_feedforward, moves
from ccd_casadi.analysis.move_limits import LIMITS, WINDOW
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.explorer.designs import Look, Standing
from ccd_casadi.fixed_structure import Sampling
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.sweep import missed_by
from ccd_casadi.lti.closed_loop import sigma_max
from ccd_casadi.lti.grid import frequency_grid
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.robust.sampled import sampled_figures
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ

POINTS = 180  # of the frequency grid, besides those around resonances
STEP_POINTS = 240
STEP_PERIODS = 5.0  # of the bandwidth
SAME = 1e-3  # relative: the peak of S on the model is that of the design
WATCHED = 2.0  # durations of the move that are shown
NONE = np.zeros(0)
AT_REST = Move(NONE, NONE, NONE, NONE, np.zeros((0, 1)), False, 0.0, WINDOW)


@dataclass(frozen=True)
class Curves:
    """Of one design: its loop on the plant looked at, over frequency and over time.

    `step`: y of the first output (s) after a step of its reference. An unstable loop has no step
    and no move (`AT_REST`).
    """

    view: LoopView
    step_time: Array
    step: Array
    move: Move

    @cached_property
    def poles(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the plant, of K and of the loop (of a sampled one ln(z)/T): complex, Hz."""
        loop = self.view.loop
        return loop.plant.poles / HZ, loop.controller.poles / HZ, loop.poles / HZ

    @property
    def unstable(self) -> bool:
        """Of the loop: it has no step, no move and no margins."""
        return not self.poles[2].real.max() < 0.0

    @property
    def unstable_controller_hz(self) -> list[float]:
        """Unstable poles of K by itself, a pair once, ascending."""
        K = self.poles[1]
        return sorted(np.abs(K[(K.real > 1e-9 * np.abs(K)) & (K.imag >= 0.0)]).tolist())


@dataclass(frozen=True)
class AsSampled:
    """The same controller by Tustin's rule at a rate, hold and delay exact: judged, not designed.

    `stable`, ω_b in Hz and ‖S‖∞ are of the sampled loop; σ_max(S) over Hz up to half the rate.
    """

    stable: bool
    bandwidth_hz: float
    peak: float
    hz: Array
    gain: Array


def curves_of(look: Look) -> Curves | None:
    """The curves of a design; None where its synthesis ended without a controller."""
    if look.controller is None:
        return None
    plant, K, problem = look.plant, look.controller, look.problem
    loop = Loop(plant.plant_si(), K, problem.sampling)
    bandwidth = look.bandwidth_hz if np.isfinite(look.bandwidth_hz) else plant.omega_0 / HZ
    gamma = float(np.nan_to_num(look.figures.certificate.norm_bound))
    bounded = kind_of(problem).bounded(look.weights, gamma, look.bandwidth_hz)
    f = look.figures
    top, at = f.sensitivity_peak, f.sensitivity_peak_frequency
    own = float(sigma_max(loop.sensitivity(np.array([at])))[0]) if at > 0.0 else np.nan
    peaks = ((at / HZ, top),) if abs(own / top - 1.0) < SAME else None  # else another plant's
    view = loop_view([loop], bounded, bandwidth_hz=bandwidth, points=POINTS, peaks=peaks)
    time, step, move = NONE, NONE, AT_REST
    if loop.stable:
        first = np.eye(len(loop.plant.C))[0]
        time, y = step_response(loop, first, STEP_PERIODS / bandwidth, STEP_POINTS)
        step, move = y[:, 0], _move(look, loop, bandwidth)
    return Curves(view, time, step, move)


def _move(look: Look, loop: Loop, bandwidth_hz: float) -> Move:
    """The default one of robustness."""
    ((made,),) = moves(
        [loop], [mass_feedforward(look.modal, 0)], setpoint(LIMITS), axis=0, window=WINDOW,
        bandwidth_hz=bandwidth_hz, doublings=1,
    )  # fmt: skip
    return made.until(WATCHED * made.duration)


def sampled_of(look: Look) -> AsSampled | None:
    """A certified design at the rate and delay of its sliders; None where it is designed for it."""
    refused = look.standing is Standing.REFUSED
    if look.controller is None or refused or kind_of(look.problem).as_designed:
        return None
    return as_sampled(look.plant, look.controller, look.knobs.rate_hz, look.knobs.delay_us)


def with_sampled(look: Look, found: AsSampled | None) -> Look:
    """The look with the standing that its sampled loop leaves it."""
    k, S_max = look.knobs, look.problem.inner.S_max
    if found is None or (found.stable and found.peak <= S_max):
        return look
    at = f"as sampled at {k.rate_hz:.4g} Hz with a delay of {k.delay_us:.4g} µs"
    if not found.stable:
        return replace(look, standing=Standing.REFUSED, reason=f"the loop is unstable {at}")
    if look.standing is not Standing.KEPT:
        return look  # it is no better already
    over = missed_by(found.peak, S_max)
    return replace(look, standing=Standing.MISSED, reason=f"{at} the peak of S is {over}")


def as_sampled(
    plant: ScaledPlant, controller: StateSpace, rate_hz: float, delay_us: float
) -> AsSampled:
    """A controller in discrete time on a plant: stability, ω_b and ‖S‖∞, hold and delay exact."""
    loop = Loop(plant.plant_si(), controller, Sampling(rate_hz, delay_us))
    f = sampled_figures(loop.closed.S)
    near = plant.grid * plant.omega_0 / HZ
    hz = frequency_grid(1e-4 * rate_hz, 0.499 * rate_hz, POINTS, near)
    gain = sigma_max(loop.sensitivity(HZ * hz))
    return AsSampled(f.stable, f.bandwidth / HZ, f.sensitivity_peak, hz, gain)
