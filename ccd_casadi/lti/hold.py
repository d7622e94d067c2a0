"""A zero-order hold and a delay in front of a plant, exact; a controller by Tustin's rule.

Sampled with period T behind a delay τ the plant is z⁻ᵈ C f(A) B at the instants. With
w = (2/T)(z - 1)/(z + 1) the inside of the unit circle becomes the left half plane.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.support.arrays import Array

INSTANT = 1e-9  # share of a period that counts as none


@dataclass(frozen=True)
class Sampling:
    """How the loop runs.

    Parameters
    ----------
    rate_hz, delay_us : float
        Of K, Hz; from measurement to force beside the hold, µs.
    """

    rate_hz: float
    delay_us: float = 0.0

    def __post_init__(self) -> None:
        if not self.rate_hz > 0.0:
            raise ValueError(f"rate_hz is {self.rate_hz}; give a rate above 0")
        if not self.delay_us >= 0.0:
            raise ValueError(f"delay_us is {self.delay_us}; give 0 or more")

    @property
    def period(self) -> float:
        """T in s."""
        return 1.0 / self.rate_hz

    @property
    def delay(self) -> float:
        """τ in s."""
        return 1e-6 * self.delay_us


def delay_parts(period: float, delay: float) -> tuple[int, float]:
    """Whole periods of a delay (s), and the rest in s."""
    whole = int(np.floor(delay / period + INSTANT))
    return whole, max(delay - whole * period, 0.0)


def transfer(p: np.ndarray, omega: Array, period: float, delay: float) -> np.ndarray:
    """f(p), (len(ω), len(p)), with which the plant's response is C f(A) B."""
    s = 1j * omega[:, None]
    d, late, early = moments(p, period, delay)
    gap = np.exp(p * period) * np.expm1((s - p) * period)
    return (late + early * np.exp(-s * period)) / gap * np.exp(-s * period * d)


def moments(p: np.ndarray, T: float, delay: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Whole periods d of delay, and what u_{k-d} and u_{k-d-1} give a mode in one period."""
    d, rest = delay_parts(T, delay)
    h, free = T - rest, p == 0.0
    over = np.where(free, 1.0, p)
    late = np.where(free, h, np.expm1(p * h) / over)
    early = np.where(free, rest, np.exp(p * h) * np.expm1(p * rest) / over)
    return float(d), late, early


def moment_slopes(p: np.ndarray, T: float, delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of `moments` to p."""
    _, late, early = moments(p, T, delay)
    rest = delay_parts(T, delay)[1]
    h, free = T - rest, p == 0.0
    over = np.where(free, 1.0, p)
    d_late = np.where(free, 0.5 * h**2, (h * np.exp(p * h) - late) / over)
    first = (rest * np.exp(p * rest) - np.expm1(p * rest) / over) / over
    d_early = h * early + np.exp(p * h) * np.where(free, 0.5 * rest**2, first)
    return d_late, d_early


def sampled(G: StateSpace, period: float, delay: float) -> StateSpace:
    """u_k to y_k of a plant without feedthrough behind hold and delay (s); states [x; u_{k-1}; …].

    One exponential over each part of a period: before and after the delayed force changes. Analytic
    in the plant's matrices.
    """
    n, m = G.B.shape
    whole, rest = delay_parts(period, delay)
    joint = np.zeros((n + m, n + m), np.result_type(G.A, G.B))
    joint[:n, :n], joint[:n, n:] = G.A, G.B
    late = expm(joint * (period - rest))[:n]
    gains = [np.zeros((n, m))] * whole + [late[:, n:]]
    A = late[:, :n]
    if rest > 0.0:
        early = expm(joint * rest)[:n]
        gains.append(A @ early[:, n:])
        A = A @ early[:, :n]
    return delayed(A, gains, G.C, period)


def delayed(A: np.ndarray, gains: Sequence[np.ndarray], C: np.ndarray, T: float) -> StateSpace:
    """x_{k+1} = A x_k + Σ gains_i u_{k-i}, y = C x as one state space, [x; u_{k-1}; …]."""
    n, m = gains[0].shape
    kept = m * (len(gains) - 1)
    older = np.hstack([np.zeros((n, 0)), *gains[1:]])
    return strictly_proper(
        np.block([[A, older], [np.zeros((kept, n)), np.eye(kept, k=-m)]]),
        np.vstack([gains[0], np.eye(kept, m)]),
        np.hstack([C, np.zeros((len(C), kept))]),
        T,
    )


def tustin(K: StateSpace, period: float) -> StateSpace:
    """K(z) = K(s) at s = (2/T)(z - 1)/(z + 1), without prewarping; analytic in its matrices."""
    one, half = np.eye(len(K.A)), 0.5 * period
    inverse = np.linalg.inv(one - half * K.A)
    C = K.C @ inverse
    A, B = inverse @ (one + half * K.A), period * inverse @ K.B
    return StateSpace(A, B, C, K.D + half * C @ K.B, period=period)


def in_w(G: StateSpace) -> StateSpace:
    """A system in discrete time over w, z = (1 + wT/2)/(1 - wT/2): stable left of the axis."""
    T = G.period
    inverse = np.linalg.inv(G.A + np.eye(len(G.A)))
    root = 2.0 / np.sqrt(T)
    return StateSpace(
        2.0 / T * inverse @ (G.A - np.eye(len(G.A))),
        root * inverse @ G.B,
        root * G.C @ inverse,
        G.D - G.C @ inverse @ G.B,
    )
