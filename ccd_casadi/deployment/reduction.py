"""Controllers of lower order, the loop measured and certified stable with each of them.

Two ways, because neither is the best at every order. Each balances K, and sets the states at rest
that matter least (singular perturbation, so that K(0) is kept):

* its stable part (Moore 1981);
* closed-loop balancing (Enns 1984; Ceton, Wortelboer and Bosgra 1993): balanced are the
  controller's blocks of the loop's Gramians from r to y, that is K weighted by S on its input
  and by S G on its output.

Everything happens in the scaled units of the plant.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.linalg import block_diag, eigh, schur, solve_sylvester, svd
from scipy.linalg import solve_continuous_lyapunov as lyapunov

from ccd_casadi.analysis.loop_channels import LoopChannel
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import DesignFigures
from ccd_casadi.synthesis.weights import Weights


class Reduction(StrEnum):
    """How a controller was reduced."""

    PERTURBATION = "singular perturbation"
    CLOSED_LOOP = "closed-loop balancing"
    NONE = "as designed"


@dataclass(frozen=True)
class LoopLimits:
    """Most of ‖S‖∞, of σ_max(S) at ω_low and of the weighted norm, least of ω_b (rad/s)."""

    peak: float
    low: float
    norm: float
    bandwidth: float


@dataclass(frozen=True)
class ReducedController:
    """A controller in SI of some order, and its loop; figures of an unstable loop are NaN."""

    order: int
    method: Reduction
    controller: StateSpace
    figures: DesignFigures

    def meets(self, limits: LoopLimits) -> bool:
        """Whether the loop is stable and within the limits."""
        f = self.figures
        return (
            f.certified
            and f.sensitivity_peak <= limits.peak
            and f.sensitivity_low <= limits.low
            and f.bandwidth >= limits.bandwidth
            and f.gamma <= limits.norm
        )


def reductions(
    channel: LoopChannel, weights: Weights, omega_low: float, negligible: float = 1e-9
) -> list[ReducedController]:
    """Every method at every order from the minimal one down to 1, highest order first.

    A method that cannot give an order is left out there. ω_low in rad/s. A state whose closed-loop
    Hankel value is `negligible`, as a share of the largest, is not in the minimal one.
    """
    plant = channel.plant
    K = channel.controller.in_units(plant.omega_0, plant.force)
    loop = closed_loop(plant.system, K).T
    _, values = _balanced(K, loop, 0)
    order = int(np.sum(values > negligible * values[0]))
    K, _ = _balanced(K, loop, order)
    found = []
    for r in range(order, 0, -1):
        for method, reduce in _METHODS.items():
            if r == order and method is not Reduction.CLOSED_LOOP:
                continue  # nothing is reduced yet
            smaller = reduce(plant, K, r)
            if smaller is None:
                continue
            controller = smaller.in_units(1.0 / plant.omega_0, 1.0 / plant.force)
            figures = measure(plant, controller, weights, omega_low=omega_low)
            found.append(ReducedController(r, method, controller, figures))
    return found


def smallest(
    rows: list[ReducedController],
    limits: LoopLimits,
    holds: Callable[[ReducedController], bool] = lambda row: True,
) -> ReducedController:
    """The row of least order within the limits; of several, the one with the lowest peak.

    `holds`: what else it has to keep, on other plants. The minimal realisation where none does.
    """
    met = [row for row in rows if row.meets(limits)]
    met.sort(key=lambda row: (row.order, row.figures.sensitivity_peak))
    return next((row for row in met if holds(row)), rows[0])


def _perturbation(plant: ScaledPlant, K: StateSpace, r: int) -> StateSpace | None:
    S, Q, k = schur(K.A, sort="lhp")
    if r <= len(S) - k:
        return None
    stable, rest = slice(None, k), slice(k, None)
    apart = np.eye(len(S))
    apart[stable, rest] = solve_sylvester(S[stable, stable], -S[rest, rest], -S[stable, rest])
    B, C = np.linalg.solve(apart, Q.T @ K.B), K.C @ Q @ apart
    part = StateSpace(S[stable, stable], B[stable], C[:, stable], K.D)
    small = _without_fast(part, part, r - len(S) + k)
    return StateSpace(
        block_diag(small.A, S[rest, rest]),
        np.vstack([small.B, B[rest]]),
        np.hstack([small.C, C[:, rest]]),
        small.D,
    )


def _without_fast(K: StateSpace, whole: StateSpace, r: int) -> StateSpace:
    """K with r states, balanced as in `_balanced`, those of the smallest values at rest.

    ẋ₂ = 0 of these, so that K(0) is kept.
    """
    K, _ = _balanced(K, whole, len(K.A))
    rest = np.linalg.solve(K.A[r:, r:], np.hstack([K.A[r:, :r], K.B[r:]]))
    A2, B2 = rest[:, :r], rest[:, r:]
    return StateSpace(
        K.A[:r, :r] - K.A[:r, r:] @ A2,
        K.B[:r] - K.A[:r, r:] @ B2,
        K.C[:, :r] - K.C[:, r:] @ A2,
        K.D - K.C[:, r:] @ B2,
    )


def _balanced(K: StateSpace, whole: StateSpace, order: int) -> tuple[StateSpace, Array]:
    """K truncated to `order` in the coordinates in which its states, the last of a stable system
    `whole`, are as much driven as seen there; and the Hankel values."""
    A, B, C, n = whole.A, whole.B, whole.C, len(whole.A) - len(K.A)
    R = _root(lyapunov(A, -B @ B.T)[n:, n:])
    L = _root(lyapunov(A.T, -C.T @ C)[n:, n:])
    U, s, Vt = svd(L.T @ R)
    size = np.sqrt(s[:order])
    turned, inverse = R @ Vt[:order].T / size, (U[:, :order] / size).T @ L.T
    return StateSpace(inverse @ K.A @ turned, inverse @ K.B, K.C @ turned, K.D), s


_METHODS: dict[Reduction, Callable[[ScaledPlant, StateSpace, int], StateSpace | None]] = {
    Reduction.PERTURBATION: _perturbation,
    Reduction.CLOSED_LOOP: lambda plant, K, r: _without_fast(K, closed_loop(plant.system, K).T, r),
}


def _root(gramian: Array) -> Array:
    """R with R Rᵀ = the Gramian, which rounding may have left slightly indefinite."""
    values, vectors = eigh(0.5 * (gramian + gramian.T))
    return vectors * np.sqrt(np.maximum(values, 0.0))
