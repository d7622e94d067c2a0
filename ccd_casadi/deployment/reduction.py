"""Controllers of lower order, the loop measured and certified stable with each of them.

Four ways, because none is the best at every order:

* balanced truncation of K's stable part (SLICOT's AB09MD);
* the same with singular perturbation, K(0) kept (AB09ND);
* normalised left coprime factors K = M⁻¹N, the stable [N M] reduced by AB09ND: also the unstable
  poles of K may go;
* closed-loop balancing (Enns 1984; Ceton, Wortelboer and Bosgra 1993): balanced are the
  controller's blocks of the loop's Gramians from r to y, that is K weighted by S on its input
  and by S G on its output, then singular perturbation.

Everything happens in the scaled units of the plant. SLICOT is called with job = 'B' only: with
'N', and in AB09BD, slycot 0.7's wrappers give it too little workspace.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, eigh, solve_continuous_are, svd
from scipy.linalg import solve_continuous_lyapunov as lyapunov

from ccd_casadi.deployment.channels import Channel
from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import require
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import UNBOUNDED, DesignFigures
from ccd_casadi.synthesis.weights import Weights

NEGLIGIBLE = 1e-9  # of the largest closed-loop Hankel value: a state under it is none


class Reduction(StrEnum):
    """How a controller was reduced."""

    TRUNCATION = "balanced truncation"
    PERTURBATION = "singular perturbation"
    COPRIME = "coprime factors"
    CLOSED_LOOP = "closed-loop balancing"
    NONE = "as designed"


@dataclass(frozen=True)
class Limits:
    """Most of ‖S‖∞, of σ_max(S) at ω_low and of the weighted norm, least of ω_b (rad/s)."""

    peak: float
    low: float
    norm: float
    bandwidth: float


@dataclass(frozen=True)
class Reduced:
    """A controller in SI of some order, and its loop; figures of an unstable loop are NaN."""

    order: int
    method: Reduction
    controller: StateSpace
    figures: DesignFigures

    def meets(self, limits: Limits) -> bool:
        """Whether the loop is stable and within the limits."""
        f = self.figures
        return (
            f.certified
            and f.sensitivity_peak <= limits.peak
            and f.sensitivity_low <= limits.low
            and f.bandwidth >= limits.bandwidth
            and f.gamma <= limits.norm
        )


def reductions(channel: Channel, weights: Weights, omega_low: float) -> list[Reduced]:
    """Every method at every order from the minimal one down to 1, highest order first.

    A method that cannot give an order is left out there. ω_low in rad/s.
    """
    plant = channel.plant
    K = channel.controller.in_units(plant.omega_0, plant.force)
    _, values = _loop_balanced(plant, K, 0)
    order = int(np.sum(values > NEGLIGIBLE * values[0]))
    K, _ = _loop_balanced(plant, K, order)
    found = []
    for r in range(order, 0, -1):
        for method, reduce in _METHODS.items():
            if r == order and method is not Reduction.CLOSED_LOOP:
                continue  # nothing is reduced yet
            smaller = reduce(plant, K, r)
            if smaller is None:
                continue
            controller = smaller.in_units(1.0 / plant.omega_0, 1.0 / plant.force)
            figures = measure(plant, controller, weights, gamma=UNBOUNDED, omega_low=omega_low)
            found.append(Reduced(r, method, controller, figures))
    return found


def smallest(
    rows: list[Reduced], limits: Limits, holds: Callable[[Reduced], bool] = lambda row: True
) -> Reduced:
    """The row of least order within the limits; of several, the one with the lowest peak.

    `holds`: what else is asked of it, on other plants. The minimal realisation where none does.
    """
    met = [row for row in rows if row.meets(limits)]
    met.sort(key=lambda row: (row.order, row.figures.sensitivity_peak))
    return next((row for row in met if holds(row)), rows[0])


def _truncation(plant: ScaledPlant, K: StateSpace, r: int) -> StateSpace | None:
    n, m, p = _sizes(K)
    out = _slicot(lambda slycot: slycot.ab09md("C", "B", "S", n, m, p, K.A, K.B, K.C, nr=r))
    return None if out is None else StateSpace(out[1], out[2], out[3], K.D)


def _perturbation(plant: ScaledPlant, K: StateSpace, r: int) -> StateSpace | None:
    n, m, p = _sizes(K)
    out = _slicot(lambda slycot: slycot.ab09nd("C", "B", "S", n, m, p, K.A, K.B, K.C, K.D, nr=r))
    return None if out is None else StateSpace(*out[1:5])


def _coprime(plant: ScaledPlant, K: StateSpace, r: int) -> StateSpace | None:
    """K = M⁻¹N with [N M] = (A + HC, [B + HD, H], C, [D, I]), normalised up to a constant."""
    m, p = K.B.shape[1], K.C.shape[0]
    R = np.eye(p) + K.D @ K.D.T
    try:
        Z = solve_continuous_are(K.A.T, K.C.T, K.B @ K.B.T, R, s=K.B @ K.D.T)
    except (LinAlgError, ValueError):
        return None
    H = -(Z @ K.C.T + K.B @ K.D.T) @ np.linalg.inv(R)
    factors = StateSpace(
        K.A + H @ K.C, np.hstack([K.B + H @ K.D, H]), K.C, np.hstack([K.D, np.eye(p)])
    )
    small = _perturbation(plant, factors, r)
    if small is None or abs(np.linalg.det(small.D[:, m:])) < NEGLIGIBLE:
        return None
    inverse = np.linalg.inv(small.D[:, m:])
    back = small.B[:, m:] @ inverse
    return StateSpace(
        small.A - back @ small.C,
        small.B[:, :m] - back @ small.D[:, :m],
        inverse @ small.C,
        inverse @ small.D[:, :m],
    )


def _closed_loop(plant: ScaledPlant, K: StateSpace, r: int) -> StateSpace | None:
    n = len(K.A)
    balanced, _ = _loop_balanced(plant, K, n)
    return balanced if r == n else _residual(balanced, r)


def _loop_balanced(plant: ScaledPlant, K: StateSpace, order: int) -> tuple[StateSpace, Array]:
    """K truncated to `order` in the coordinates that balance it in the loop, and its values."""
    n, T = len(plant.A), closed_loop(plant.system, K).T
    A, B, C = T.A, T.B, T.C
    R = _root(lyapunov(A, -B @ B.T)[n:, n:])
    L = _root(lyapunov(A.T, -C.T @ C)[n:, n:])
    U, s, Vt = svd(L.T @ R)
    size = np.sqrt(s[:order])
    turned, inverse = R @ Vt[:order].T / size, (U[:, :order] / size).T @ L.T
    return StateSpace(inverse @ K.A @ turned, inverse @ K.B, K.C @ turned, K.D), s


def _residual(K: StateSpace, r: int) -> StateSpace:
    """The last states at rest: ẋ₂ = 0, so that K(0) is kept."""
    rest = np.linalg.solve(K.A[r:, r:], np.hstack([K.A[r:, :r], K.B[r:]]))
    A2, B2 = rest[:, :r], rest[:, r:]
    return StateSpace(
        K.A[:r, :r] - K.A[:r, r:] @ A2,
        K.B[:r] - K.A[:r, r:] @ B2,
        K.C[:, :r] - K.C[:, r:] @ A2,
        K.D - K.C[:, r:] @ B2,
    )


_METHODS: dict[Reduction, Callable[[ScaledPlant, StateSpace, int], StateSpace | None]] = {
    Reduction.TRUNCATION: _truncation,
    Reduction.PERTURBATION: _perturbation,
    Reduction.COPRIME: _coprime,
    Reduction.CLOSED_LOOP: _closed_loop,
}


def _slicot(call: Callable[[Any], tuple]) -> tuple | None:
    """What SLICOT returns; None where it fails or warns that the order cannot be had."""
    slycot = require("slycot", "slicot")
    with warnings.catch_warnings():
        warnings.simplefilter("error", slycot.exceptions.SlycotResultWarning)
        try:
            return call(slycot)
        except (slycot.exceptions.SlycotError, slycot.exceptions.SlycotResultWarning):
            return None


def _root(gramian: Array) -> Array:
    """R with R Rᵀ = the Gramian, which rounding may have left slightly indefinite."""
    values, vectors = eigh(0.5 * (gramian + gramian.T))
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _sizes(K: StateSpace) -> tuple[int, int, int]:
    return len(K.A), K.B.shape[1], K.C.shape[0]
