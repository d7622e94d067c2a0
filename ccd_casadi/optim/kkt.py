"""Optimality conditions of a smooth problem at a point, by its active constraints.

    min J(z)  s.t.  g(z) <= 0,  0 <= z <= 1:     ∇J + Aᵀμ = 0,  μ >= 0,  A: gradients of what binds

in the unit box, g in shares of its size. The residual is scaled to the gradient of J: r = ‖∇J +
Aᵀμ‖∞/‖∇J‖∞ with the best μ >= 0 (non-negative least squares). Nocedal and Wright, Numerical
Optimization, chapter 12.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.linalg import null_space

from ccd_casadi.support.arrays import Array

# A constraint closer than this to its bound, in shares of its size or of the box, is active: a
# polish stops where steps change J by no more than rounding.
ACTIVE = 1e-6
STEP = 1e-4  # of the box: differences of true gradients


@dataclass(frozen=True)
class Kink:
    """What is known of a design where J of θ has more than one gradient.

    one_gradient: the residual with that of one side alone. slopes: of J to the two sides of each of
    some orthogonal directions, all that the active bounds leave; differences of true values, per
    share of the box, over ‖∇J‖∞; NaN where there is no design. multipliers: of the bounds on the
    loop by kind, change of ln of the inner value per ln of a bound. first_order: the slopes are on
    plants as they are known nearby, climbed to from the design's controller.
    """

    one_gradient: float
    slopes: tuple[tuple[float, float], ...]
    multipliers: dict[str, float]
    first_order: bool = False

    @property
    def least_slope(self) -> float:
        """The least of the slopes that are known; NaN where none is."""
        known = [slope for pair in self.slopes for slope in pair if np.isfinite(slope)]
        return min(known, default=float("nan"))


@dataclass(frozen=True)
class KktCertificate:
    """Residuals of the true optimality conditions at a verified design.

    stationarity: scaled, see the module. primal: largest violation of g or a bound, in shares.
    complementarity: largest |μ g| over ‖∇J‖∞. multipliers: per name, change of J per unit of g, or
    per unit box of a bound. second_order: least eigenvalue of the reduced Hessian of the Lagrangian
    over ‖∇J‖∞, inf at a vertex, None where it was not computed. kink: where one gradient of J is
    not all that there are.
    """

    stationarity: float
    primal: float
    complementarity: float
    multipliers: dict[str, float]
    active: tuple[str, ...]
    second_order: float | None
    objective_gradient: tuple[float, ...]
    kink: Kink | None = None


@dataclass(frozen=True)
class FirstOrder:
    """∇J (n,), and values g (m,) and Jacobian (m, n) of constraints by name, at one z of the unit
    box; g in shares of `sizes` (m,)."""

    gradient: Array
    g: Array
    jacobian: Array
    sizes: Array
    names: tuple[str, ...]


@dataclass(frozen=True)
class ActiveSet:
    """∇J (n,) and what is within `ACTIVE` of its bound at one z of the unit box.

    rows (m, n) and slack (m,), <= 0 inside, are in shares of `sizes` (m,), one each per label; the
    first `constraints` are of g, the rest bounds. violation: the largest of all, 0 where none is.
    """

    gradient: Array
    rows: Array
    slack: Array
    sizes: Array
    labels: tuple[str, ...]
    constraints: int
    violation: float

    @property
    def size(self) -> float:
        """‖∇J‖∞."""
        return max(float(np.abs(self.gradient).max()), 1e-300)

    def multipliers(self) -> Array:
        """The best μ >= 0 (m,), per share."""
        return non_negative(self.rows, -self.gradient)[0]

    def residual(self, mu: Array) -> float:
        """‖∇J + Aᵀμ‖∞/‖∇J‖∞."""
        return float(np.abs(self.gradient + mu @ self.rows).max()) / self.size

    def free(self, mu: Array) -> Array:
        """Orthonormal directions (n, k) that leave what has a multiplier as it is."""
        return np.asarray(null_space(self.rows[mu > 0.0]))

    def certificate(
        self, mu: Array, residual: float, second: float | None, kink: Kink | None = None
    ) -> KktCertificate:
        """What was found, with multipliers per unit of g."""
        per_unit = zip(self.labels, mu / self.sizes, strict=True)
        return KktCertificate(
            stationarity=residual,
            primal=self.violation,
            complementarity=float(np.abs(mu * self.slack).max(initial=0.0)) / self.size,
            multipliers={name: float(value) for name, value in per_unit},
            active=self.labels,
            second_order=second,
            objective_gradient=tuple(map(float, self.gradient)),
            kink=kink,
        )


def non_negative(rows: Array, goal: Array) -> tuple[Array, float]:
    """μ >= 0 (m,) that brings rowsᵀ μ nearest to `goal` (n,), and what is missing over ‖goal‖∞."""
    mu = np.zeros(len(rows))
    if len(rows):
        mu = scipy.optimize.nnls(rows.T, goal, maxiter=100 * len(rows))[0]
    return mu, float(np.abs(goal - mu @ rows).max()) / max(float(np.abs(goal).max()), 1e-300)


def active_set(z: Array, here: FirstOrder, variables: Sequence[str]) -> ActiveSet:
    """What binds at z of the unit box: g <= 0, and the ends of `variables`."""
    at = np.flatnonzero(here.g >= -ACTIVE)
    rows, slack, units = ([*each[at]] for each in (here.jacobian, here.g, here.sizes))
    labels, count = [here.names[i] for i in at], len(at)
    for i, name in enumerate(variables):
        for end, value, sign in (("lower", -z[i], -1.0), ("upper", z[i] - 1.0, 1.0)):
            if value >= -ACTIVE:
                rows.append(sign * np.eye(z.size)[i])
                labels.append(f"{name} {end}")
                slack.append(value)
                units.append(1.0)
    violation = max(0.0, float((-z).max()), float((z - 1.0).max()), *here.g)
    matrix = np.array(rows).reshape(-1, z.size)
    return ActiveSet(
        here.gradient, matrix, np.array(slack), np.array(units), tuple(labels), count, violation
    )


def reduced_curvature(Z: Array, columns: Array | None, size: float) -> float | None:
    """Least eigenvalue of ZᵀHZ over `size`, columns (n, k) = HZ; inf at a vertex, None unknown."""
    if Z.shape[1] == 0:
        return np.inf
    if columns is None or not np.isfinite(columns).all():
        return None
    H = Z.T @ columns
    return float(np.linalg.eigvalsh(0.5 * (H + H.T)).min()) / size


def hessian_products(
    slopes: Callable[[Array], Sequence[Array | None]],
    z: Array,
    directions: Array,
    step: float = STEP,
) -> Array | None:
    """HZ (n, k) by differences of gradients, all at once: z (2 k, n) -> (n,) of each; one-sided at
    an end of the unit box.

    None where a gradient is not known, or the box leaves less than half of a step.
    """
    ends = np.clip(z + step * np.concatenate([directions.T, -directions.T]), 0.0, 1.0)
    found = [slope for slope in slopes(ends) if slope is not None]
    ups, downs = np.split(ends, 2)
    spans = np.linalg.norm(ups - downs, axis=1)
    if len(found) < len(ends) or (spans < 0.5 * step).any():
        return None
    above, below = np.split(np.array(found), 2)
    return np.asarray(((above - below) / spans[:, None]).T)
