"""What is drawn of one design: gains, Nyquist, poles, a step and a move; pure functions of it."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.optimize import linear_sum_assignment

from ccd_casadi.deployment.discretise import Conversion, discretise
from ccd_casadi.deployment.given_controller import Sampled
from ccd_casadi.deployment.timing import Discretisation
from ccd_casadi.explorer.designs import Look
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.scaling import ScaledPlant, StateSpace
from ccd_casadi.robust.demands import Demands
from ccd_casadi.robust.move import mass_feedforward, simulate
from ccd_casadi.robust.setpoint import setpoint
from ccd_casadi.robust.signals import ClosedLoop, closed_loop
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.closed_loop import responses

POINTS = 180  # of the frequency grid, besides those around resonances
STEP_POINTS = 240
STEP_PERIODS = 5.0  # of the bandwidth
WATCHED = 2.0  # durations of the move that are shown
LIGHT = 0.3  # damping ratio below which a pole is a resonance
FLANKS = np.tan(np.radians(np.linspace(-86.0, 86.0, 27)))  # in multiples of its width
FAR = 30.0  # |L| beyond which a locus leaves the drawing


@dataclass(frozen=True)
class Curves:
    """Of one design. Gains are largest singular values of S, KS (N/m) and T, rows (3, k) over Hz.

    `bounds` are γ/|W1|, γ/|W2|, γ/|W3| (3, k). `loci` (k, p): eigenvalues of L = GK, NaN where one
    is too large to be drawn. `poles` of the closed loop, of K and of G in Hz, complex. `step`: y of
    the first output after a step of its reference, over s.
    """

    hz: Array
    gains: Array
    bounds: Array
    loci: np.ndarray
    poles: np.ndarray
    controller_poles: np.ndarray
    plant_poles: np.ndarray
    step_time: Array
    step: Array
    move: "Moved"


@dataclass(frozen=True)
class Moved:
    """Error in m of the first output over s in the default move of `robustness`, ending at `end`.

    With mass feedforward where a rigid body can be moved; `free`: on the plant without suspension.
    """

    time: Array
    error: Array
    end: float
    feedforward: bool
    free: bool


_AT_REST = Moved(np.zeros(0), np.zeros(0), 0.0, False, False)


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
    plant, K = look.plant, look.controller
    hz = grid_of(look)
    G, k, S = responses(plant, K, HZ * hz)
    KS = k @ S
    gains = np.array([np.linalg.norm(part, 2, axis=(1, 2)) for part in (S, KS, G @ KS)])
    gamma = float(np.nan_to_num(look.figures.certificate.norm_bound))
    loop = closed_loop(plant.plant_si(), K)
    poles = np.linalg.eigvals(loop.A)
    stable = bool(poles.real.max() < 0.0)
    bandwidth = look.bandwidth_hz if np.isfinite(look.bandwidth_hz) else plant.omega_0 / HZ
    step_time, step = _step(loop, bandwidth) if stable else (np.zeros(0), np.zeros(0))
    move = _move(look, K, bandwidth) if stable else _AT_REST
    return Curves(
        hz=hz,
        gains=gains,
        bounds=gamma / np.abs(look.weights.responses(HZ * hz)),
        loci=loci_of(G @ k),
        poles=poles / HZ,
        controller_poles=np.linalg.eigvals(K.A) / HZ,
        plant_poles=np.linalg.eigvals(plant.A) * plant.omega_0 / HZ,
        step_time=step_time,
        step=step,
        move=move,
    )


def grid_of(look: Look) -> Array:
    """Frequencies in Hz from ω_low/5 to far beyond ω_b and the modes, fine where either needs it.

    It holds the peak of S and ω_b themselves.
    """
    plant, figures = look.plant, look.figures
    low = look.problem.inner.omega_low / HZ / 5.0
    natural = plant.natural[plant.natural > 0.0] / HZ
    bandwidth = look.bandwidth_hz if np.isfinite(look.bandwidth_hz) else plant.omega_0 / HZ
    high = max(30.0 * bandwidth, 3.0 * float(natural.max(initial=0.0)))
    poles = np.linalg.eigvals(plant.A) * plant.omega_0 / HZ
    if look.controller is not None:
        poles = np.concatenate([poles, np.linalg.eigvals(look.controller.A) / HZ])
    light = poles[(poles.imag > 0.0) & (np.abs(poles.real) < LIGHT * np.abs(poles))]
    # even steps of the phase around a resonance, so that its circle in the Nyquist plot is round
    around = (np.abs(light.imag)[:, None] + np.abs(light.real)[:, None] * FLANKS).ravel()
    special = [figures.sensitivity_peak_frequency / HZ, look.bandwidth_hz]
    grid = np.concatenate([np.geomspace(low, high, POINTS), around, special])
    return np.unique(grid[(grid >= low) & (grid <= high)])  # NaN compares false


def loci_of(L: np.ndarray) -> np.ndarray:
    """Eigenvalues of L (k, p, p) as p continuous curves (k, p), NaN where |λ| > FAR."""
    values = np.linalg.eigvals(L)
    if values.shape[1] > 1:
        for i in range(1, len(values)):
            away = np.abs(values[i - 1][:, None] - values[i][None, :])
            values[i] = values[i][linear_sum_assignment(away)[1]]
    return np.where(np.abs(values) <= FAR, values, np.nan)


def _step(loop: ClosedLoop, bandwidth_hz: float) -> tuple[Array, Array]:
    time = np.linspace(0.0, STEP_PERIODS / bandwidth_hz, STEP_POINTS)
    n = len(loop.A)
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n], joint[:n, n] = loop.A, loop.B_r[:, 0]
    Phi = expm(joint * time[1])
    x, y = np.zeros(n + 1), np.zeros(len(time))
    x[n] = 1.0
    for i in range(1, len(time)):
        x = Phi @ x
        y[i] = loop.C_y[0] @ x[:n]
    return time, y


def _move(look: Look, K: StateSpace, bandwidth_hz: float) -> Moved:
    """On the plant with free rigid bodies, or on the suspended one where that is not stable."""
    demands = Demands()
    profile = setpoint(demands.limits)
    modal = modal_plant(look.elements.system, Suspension(0.0, 0.0))
    n, m, p = len(modal.K), modal.B.shape[1], len(modal.C)
    released = StateSpace(
        np.block([[np.zeros((n, n)), np.eye(n)], [-modal.K, -modal.D]]),
        np.vstack([np.zeros((n, m)), modal.B]),
        np.hstack([modal.C, np.zeros((p, n))]),
        np.zeros((p, m)),
    )
    loop = closed_loop(released, K)
    free = bool(np.linalg.eigvals(loop.A).real.max() < 0.0)
    if not free:
        loop = closed_loop(look.plant.plant_si(), K)
    ahead = mass_feedforward(modal, demands.axis)
    found = simulate(
        loop, profile, axis=demands.axis, forces=ahead, window=demands.window,
        bandwidth_hz=bandwidth_hz, doublings=1,
    )  # fmt: skip
    shown = found.time <= WATCHED * found.duration
    return Moved(found.time[shown], found.error[shown], found.duration, ahead is not None, free)


def as_sampled(
    plant: ScaledPlant, controller: StateSpace, rate_hz: float, delay_us: float
) -> AsSampled:
    """A controller in discrete time on a plant: stability, ω_b and ‖S‖∞, hold and delay exact."""
    period, delay = 1.0 / rate_hz, 1e-6 * delay_us
    tustin = Conversion(Discretisation.TUSTIN, False, 1.0)
    sampled = Sampled(discretise(controller, tustin, period, delay), delay)
    stable, bandwidth, peak, _ = sampled.judge(plant)
    near = plant.grid * plant.omega_0 / HZ
    hz = np.unique(np.concatenate([np.geomspace(1e-4 * rate_hz, 0.499 * rate_hz, POINTS), near]))
    hz = hz[(hz >= 1e-4 * rate_hz) & (hz <= 0.499 * rate_hz)]
    G, K = sampled.responses(plant, HZ * hz)
    S = np.linalg.inv(np.eye(G.shape[1]) + G @ K)
    return AsSampled(stable, bandwidth / HZ, peak, hz, np.linalg.norm(S, 2, axis=(1, 2)))
