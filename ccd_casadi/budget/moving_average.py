"""Moving average (MA) and moving standard deviation (MSD) over a window τ, as of lithography.

    MA = (1/τ)∫ e dt,   σ²_MA = ∫ S_e sinc²(fτ) df,   σ²_MSD = ∫ S_e (1 - sinc²(fτ)) df

with sinc x = sin(πx)/(πx): what of the error is an offset during an exposure, and what blurs it.
In state space, R(t) = C e^{At} P C',

    σ²_MA = (2/τ²) ∫₀^τ (τ - t) R(t) dt = C F P C',    F = 2 (e^{Aτ} - 1 - Aτ)/(Aτ)²

and sampled over N = round(τ/T) samples

    F = (N + 2 Σ_{j=1}^{N-1} (N - j) (1 + A)^j)/N²,    |sin(πfNT)/(N sin(πfT))|² for sinc².

Both F are computed from a block matrix, without an inverse.
"""

import numpy as np
from scipy.linalg import expm

from ccd_casadi.support.arrays import Array


def samples_of(window: float, period: float) -> int:
    """N of a window in a sampled loop, at least 1."""
    return max(1, round(window / period))


def average_gain(hz: Array, window: float, period: float | None) -> Array:
    """|MA|² at frequencies in Hz; MSD has what is left to 1."""
    if period is None:
        return np.asarray(np.sinc(hz * window) ** 2)
    N = samples_of(window, period)
    x = np.pi * hz * period
    bottom = N * np.sin(x)
    near = np.abs(bottom) < 1e-8 * N
    return np.where(near, 1.0, np.sin(N * x) / np.where(near, 1.0, bottom)) ** 2


def average_matrix(A: Array, window: float, period: float | None) -> Array:
    """F of σ²_MA = C F P C'; of a sampled process A is the change over a period."""
    n, one = len(A), np.eye(len(A))
    A = A if period is None else A + one
    none = np.zeros((n, n))
    if period is None:
        joint = np.block([[A * window, one, none], [none, none, one], [none, none, none]])
        return 2.0 * expm(joint)[:n, 2 * n :]
    N = samples_of(window, period)
    joint = np.block([[A, one, none], [none, one, one], [none, none, one]])
    # Σ_{j=0}^{N-2} (N - 1 - j) A^j: the block of a path of two steps right in N steps.
    power = np.linalg.matrix_power(joint, N)[:n, 2 * n :]
    return (N * one + 2.0 * A @ power) / N**2
