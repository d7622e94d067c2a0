"""The sampled loop run sample by sample, and S measured from what it does.

Plant and controller are advanced one after the other, as they are on the machine: nothing of the
closed loop's matrices is used, so the measurement confirms them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from ccd_casadi.kernels.sensitivity import HALF_POWER
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array

LINES = 128  # frequency lines up to ω_b
PERIODS = 10  # most periods of the multisine
SETTLED = 1e-6  # relative change from one period to the next that counts as steady


@dataclass(frozen=True)
class MeasuredSensitivity:
    """σ_max(S) at frequencies in rad/s, its peak and ω_b, and how steady the measurement was.

    `leftover`: relative change of the errors from the last period but one to the last.
    """

    omega: Array
    gain: Array
    sensitivity_peak: float
    sensitivity_peak_frequency: float
    bandwidth: float
    periods: int
    leftover: float


def simulate(
    plant: StateSpace,
    controller: StateSpace,
    references: Array,
    state: tuple[Array, Array] | None = None,
) -> tuple[Array, tuple[Array, Array]]:
    """Errors e_k (k, p, q) for references r_k (k, p, q), q experiments at once, and the state.

    From rest where no state (of plant and controller) is given.
    """
    q = references.shape[2]
    x, z = state or (np.zeros((len(plant.A), q)), np.zeros((len(controller.A), q)))
    errors = np.empty_like(references)
    for k, r in enumerate(references):
        e = r - plant.C @ x
        u = controller.C @ z + controller.D @ e
        z = controller.A @ z + controller.B @ e
        x = plant.A @ x + plant.B @ u
        errors[k] = e
    return errors, (x, z)


def measure_set(
    plants: Sequence[StateSpace], controller: StateSpace, bandwidth: float, seed: int
) -> tuple[MeasuredSensitivity, ...]:
    """S from a random-phase multisine on one reference after the other; ω_b to expect in rad/s.

    All lines up to half the sampling rate, `LINES` of them up to ω_b, repeated until steady, on
    each plant with a copy of the controller, all run side by side.
    """
    count, p, T = len(plants), len(plants[0].C), plants[0].period
    plant = _beside(plants)
    controller = _beside([controller] * count)
    samples = round(2.0 * np.pi * LINES / (bandwidth * T))
    lines = np.arange(1, (samples + 1) // 2)
    spectrum = np.zeros(samples // 2 + 1, complex)
    spectrum[lines] = np.exp(2j * np.pi * np.random.default_rng(seed).random(len(lines)))
    signal = np.fft.irfft(spectrum, samples)
    references = signal[:, None, None] * np.tile(np.eye(p), (count, 1))
    state, before, periods, leftover = None, None, 0, np.inf
    while periods < PERIODS and leftover > SETTLED:
        errors, state = simulate(plant, controller, references, state)
        if before is not None:
            leftover = float(np.abs(errors - before).max() / np.abs(errors).max())
        before, periods = errors, periods + 1
    omega = np.asarray(2.0 * np.pi * lines / (samples * T), dtype=float)
    found = []
    for i in range(count):
        own = errors[:, i * p : (i + 1) * p]
        S = np.fft.rfft(own, axis=0)[lines] / spectrum[lines, None, None]
        gain = np.asarray(np.linalg.norm(S, 2, axis=(1, 2)), dtype=float)
        top = int(gain.argmax())
        found.append(
            MeasuredSensitivity(
                omega, gain, float(gain[top]), float(omega[top]), _crossing(omega, gain),
                periods, leftover,
            )
        )  # fmt: skip
    return tuple(found)


def _beside(systems: Sequence[StateSpace]) -> StateSpace:
    A, B, C, D = (block_diag(*(getattr(s, name) for s in systems)) for name in "ABCD")
    return StateSpace(A, B, C, D, period=systems[0].period)


def _crossing(omega: Array, gain: Array) -> float:
    """Where the gain first passes 1/√2, straight between two lines in logarithms; NaN if never."""
    above = np.flatnonzero(gain > HALF_POWER)
    if not len(above) or above[0] == 0:
        return np.nan
    x, y = np.log(omega), np.log(gain / HALF_POWER)
    i = above[0] - 1
    return float(np.exp(x[i] - y[i] * (x[i + 1] - x[i]) / (y[i + 1] - y[i])))
