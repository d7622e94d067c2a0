"""Hold, delay and noise over a sampling period, exactly.

The plant runs behind a hold and a delay with what disturbs it in continuous time; its share of the
noise of a period is

    ∫₀ᵀ e^{As} W W' e^{A's}/2 ds      (Van Loan 1978, of T/2ᵏ, then doubled k times).

Changes over a period are kept, not transitions: slow poles would lose their digits next to 1.
Everything is analytic in the matrices, so that a step along the imaginary axis gives derivatives to
rounding (Squire and Trapp 1998).
"""

from typing import Any

import numpy as np
from scipy.linalg import expm

from ccd_casadi.lti.hold import Sampling, parts
from ccd_casadi.lti.state_space import StateSpace

Matrix = np.ndarray[Any, Any]  # real, or complex with a step along the imaginary axis


def held(A: Matrix, B: Matrix, hold: Sampling) -> tuple[Matrix, list[Matrix]]:
    """x_{k+1} = Φ x_k + Σ Γ_i u_{k-i} behind hold and delay: Φ - 1, and all Γ_i."""
    n, m = B.shape
    whole, rest = parts(hold.period, hold.delay)
    late, late_in = over(A, hold.period - rest)
    gains = [np.zeros((n, m))] * whole + [late_in @ B]
    if rest == 0.0:
        return late, gains
    early, early_in = over(A, rest)
    moved = early_in + late @ early_in
    return late + early + late @ early, [*gains, moved @ B]


def over(A: Matrix, h: float) -> tuple[Matrix, Matrix]:
    """e^{Ah} - 1 = A∫ and ∫₀ʰ e^{As} ds, to the digits of A h."""
    n = len(A)
    joint = stacked([[A * h, h * np.eye(n)], [np.zeros((n, 2 * n))]])
    integral = expm(joint)[:n, n:] if n else A
    return A @ integral, integral


def noise_of_a_period(A: Matrix, W: Matrix, T: float) -> Matrix:
    """∫₀ᵀ e^{As} W W'/2 e^{A's} ds by Van Loan's exponential of a short step and doublings.

    The exponential holds e^{-Ah}, so the step is short; Q(2h) = Q(h) + Φ(h) Q(h) Φ(h)' adds no
    error of cancellation.
    """
    n = len(A)
    if n == 0:
        return np.zeros((0, 0))
    doublings = max(0, int(np.ceil(np.log2(max(np.abs(A).sum(0).max() * T, 1e-300)))))
    h = T / 2.0**doublings
    whole = expm(h * stacked([[-A, 0.5 * W @ W.T], [np.zeros((n, n)), A.T]]))
    moved = whole[n:, n:].T
    Q = moved @ whole[:n, n:]
    for _ in range(doublings):
        Q, moved = Q + moved @ Q @ moved.T, moved @ moved
    return 0.5 * (Q + Q.T)


def tustin_change(K: StateSpace, T: float) -> Matrix:
    """A of `tustin` less 1."""
    return T * np.linalg.solve(np.eye(len(K.A)) - 0.5 * T * K.A, K.A)


def stacked(blocks: list[list[Matrix]]) -> Matrix:
    """A block matrix."""
    return np.vstack([np.hstack(row) for row in blocks])
