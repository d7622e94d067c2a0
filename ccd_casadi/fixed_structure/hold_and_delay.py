"""A zero-order hold and a delay in front of a plant, exact: in modal form and as a state space.

Sampled with period T behind a delay τ the plant is z⁻ᵈ C f(A) B at the instants. With
w = (2/T)(z - 1)/(z + 1) the inside of the unit circle becomes the left half plane.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from ccd_casadi.support.arrays import Array

INSTANT = 1e-9  # share of a period that counts as none


@dataclass(frozen=True)
class Sampling:
    """How the loop runs: rate in Hz, delay from measurement to force in µs."""

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


def transfer(
    p: np.ndarray, omega: Array, period: float | None, delay: float
) -> tuple[np.ndarray, np.ndarray]:
    """f(p) and f'(p), (len(ω), len(p)), with which the plant's response is C f(A) B."""
    s = 1j * omega[:, None]
    if period is None:
        f = 1.0 / (s - p)
        return f, f * f
    T = period
    d, late, early = moments(p, T, delay)
    h = T * (np.floor(delay / T + INSTANT) + 1.0) - delay  # (1 - f)T
    z = np.exp(s * T)
    lam = np.exp(p * T)
    gap = lam * np.expm1((s - p) * T)
    d_late = (h * np.exp(p * h) - late) / p
    rest = T - h
    phi = np.expm1(p * rest) / p
    d_early = h * early + np.exp(p * h) * (rest * np.exp(p * rest) - phi) / p
    top = late + early / z
    shift = np.exp(-s * T * d)
    f = top / gap
    return f * shift, ((d_late + d_early / z) / gap + f * T * lam / gap) * shift


def moments(p: np.ndarray, T: float, delay: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Whole periods d of delay, and what u_{k-d} and u_{k-d-1} give a mode in one period."""
    d = float(np.floor(delay / T + INSTANT))
    rest = max(delay - d * T, 0.0)
    h = T - rest
    late = np.expm1(p * h) / p
    early = np.exp(p * h) * np.expm1(p * rest) / p
    return d, late, early


def sampled(A: Array, B: Array, C: Array, T: float, delay: float) -> tuple[Array, Array, Array]:
    """x_{k+1} = A x_k + B u_k behind hold and delay; states [x; u_{k-1}; …]."""
    n, m = B.shape
    d = int(np.floor(delay / T + INSTANT))
    rest = max(delay - d * T, 0.0)
    joint = np.zeros((n + m, n + m))
    joint[:n] = np.hstack([A, B])
    early, late = expm(joint * rest), expm(joint * (T - rest))
    kept = m * (d + (rest > 0.0))
    Ad, Bd = np.zeros((n + kept, n + kept)), np.zeros((n + kept, m))
    Ad[:n, :n] = late[:n, :n] @ early[:n, :n]
    for age, gain in ((d, late[:n, n:]), (d + 1, late[:n, :n] @ early[:n, n:])):
        if age == 0:
            Bd[:n] = gain
        elif m * age <= kept:
            Ad[:n, n + m * (age - 1) : n + m * age] = gain
    if kept:
        Bd[n : n + m] = np.eye(m)
        Ad[n + m :, n : n + kept - m] = np.eye(kept - m)
    return Ad, Bd, np.hstack([C, np.zeros((len(C), kept))])


def in_w(A: Array, B: Array, C: Array, T: float) -> tuple[Array, Array, Array, Array]:
    """z = (1 + wT/2)/(1 - wT/2) in a discrete state space."""
    inverse = np.linalg.inv(A + np.eye(len(A)))
    root = 2.0 / np.sqrt(T)
    return (
        2.0 / T * inverse @ (A - np.eye(len(A))),
        root * inverse @ B,
        root * C @ inverse,
        -C @ inverse @ B,
    )
