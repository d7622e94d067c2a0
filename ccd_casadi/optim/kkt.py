"""First- and second-order optimality conditions.

Of min J(z) over g(z) <= 0, 0 <= z <= 1 (z: shares of the box of the variables), where A has the
gradients of the active constraints and bounds as rows:

    ∇J + Aᵀμ = 0,   μ >= 0,   μᵢ gᵢ = 0,   ZᵀHZ >= 0 on the null space Z of rows with μᵢ > 0,

with H the Hessian of L = J + μᵀg (Nocedal and Wright, Numerical Optimization, theorems 12.1 and
12.5). Of rows with μᵢ = 0 theirs holds on a half-space, so that this is no weaker.

g is in shares of a size of each constraint, so that one tolerance serves all.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.linalg import null_space

from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class KktOptions:
    """Numbers of the conditions of optimality.

    Attributes
    ----------
    active : float
        g >= -active (in shares of its size, bounds of the box) is active. A polish ends this close
        to a constraint, as shorter steps change J by rounding only.
    step : float
        Of central differences of true gradients, in shares of the box.
    """

    active: float = 1e-6
    step: float = 1e-4


@dataclass(frozen=True)
class Kink:
    """A design at which J(θ) is continuous but not differentiable (its subdifferential is a set).

    Attributes
    ----------
    one_gradient : float
        KKT residual with the gradient of one side alone; with the whole subdifferential it is that
        of the certificate.
    slopes : tuple of pairs
        Directional derivatives of J along ±d over ‖∇J‖∞, of orthonormal d that span the null space
        of the active bounds: differences of true values per share of the box. NaN where there is no
        design at a side.
    multipliers : dict
        Of the bounds on the loop by kind: change of ln of the inner value per ln of a bound.
    first_order : bool
        True: the values at the sides are those of plants to first order in θ and of local searches
        from the design's controller.
    """

    one_gradient: float
    slopes: tuple[tuple[float, float], ...]
    multipliers: dict[str, float]
    first_order: bool = False

    @property
    def least_slope(self) -> float:
        """The least finite directional derivative, negative where J falls; NaN without any."""
        finite = [slope for pair in self.slopes for slope in pair if np.isfinite(slope)]
        return min(finite, default=float("nan"))


@dataclass(frozen=True)
class KktCertificate:
    """Residuals of the true optimality conditions at a verified design.

    Attributes
    ----------
    stationarity : float
        ‖∇J + Aᵀμ‖∞ over ‖∇J‖∞.
    primal : float
        The largest violation of g or a bound, in shares; 0 where none is violated.
    complementarity : float
        max |μᵢ gᵢ| over ‖∇J‖∞.
    multipliers : dict
        By name: decrease of J per unit by which a constraint is relaxed, per box width of a bound.
    active : tuple of str
        Names of active constraints and bounds.
    second_order : float or None
        Least eigenvalue of the reduced Hessian ZᵀHZ of the Lagrangian over ‖∇J‖∞; inf at a vertex,
        where Z has no columns, None where it was not computed.
    objective_gradient : tuple of float (n,)
        ∇J per box width.
    kink : Kink or None
        Where J is not differentiable.
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
    """Constraints g <= 0 and first derivatives of J and g at one z of the unit box.

    Attributes
    ----------
    gradient : array (n,)
        ∇J.
    g, jacobian : array (m,), (m, n)
        In shares of `sizes`.
    sizes : array (m,)
        One share of each constraint, in its unit.
    names : tuple of str
    """

    gradient: Array
    g: Array
    jacobian: Array
    sizes: Array
    names: tuple[str, ...]


@dataclass(frozen=True)
class ActiveSet:
    """The active constraints and bounds at one z of the unit box.

    Attributes
    ----------
    gradient : array (n,)
        ∇J.
    rows, values, sizes : array (m, n), (m,), (m,)
        A and g, <= 0 where feasible, in shares of the sizes; 1 is the size of a bound.
    labels : tuple of str
    constraints : int
        The number of rows of g; those of bounds follow.
    violation : float
        max(g, 0) over all constraints and bounds, active or not; NaN where one is unknown.
    """

    gradient: Array
    rows: Array
    values: Array
    sizes: Array
    labels: tuple[str, ...]
    constraints: int
    violation: float

    @property
    def scale(self) -> float:
        """‖∇J‖∞, by which residuals and curvatures are divided; never 0."""
        return max(float(np.abs(self.gradient).max()), 1e-300)

    def multipliers(self) -> Array:
        """Least-squares multipliers μ >= 0 (m,) of ∇J + Aᵀμ = 0, per share."""
        return non_negative(self.rows, -self.gradient)[0]

    def residual(self, mu: Array) -> float:
        """Compute ‖∇J + Aᵀμ‖∞/‖∇J‖∞."""
        return float(np.abs(self.gradient + mu @ self.rows).max()) / self.scale

    def null_space(self, mu: Array) -> Array:
        """Z (n, k), an orthonormal basis of the directions in which no row with μ > 0 changes."""
        return np.asarray(null_space(self.rows[mu > 0.0]))

    def certificate(
        self, mu: Array, residual: float, second: float | None, kink: Kink | None = None
    ) -> KktCertificate:
        """The certificate, with multipliers per unit of g instead of per share."""
        per_unit = zip(self.labels, mu / self.sizes, strict=True)
        return KktCertificate(
            stationarity=residual,
            primal=self.violation,
            complementarity=float(np.abs(mu * self.values).max(initial=0.0)) / self.scale,
            multipliers={name: float(value) for name, value in per_unit},
            active=self.labels,
            second_order=second,
            objective_gradient=tuple(map(float, self.gradient)),
            kink=kink,
        )


def non_negative(rows: Array, goal: Array) -> tuple[Array, float]:
    """Find the multipliers μ >= 0 with the least ‖rowsᵀ μ - goal‖₂, by non-negative least squares.

    Parameters
    ----------
    rows, goal : array (m, n), (n,)

    Returns
    -------
    mu : array (m,)
    residual : float
        ‖rowsᵀ μ - goal‖∞ over ‖goal‖∞.
    """
    mu = np.zeros(len(rows))
    if len(rows):
        mu = scipy.optimize.nnls(rows.T, goal, maxiter=100 * len(rows))[0]
    return mu, float(np.abs(goal - mu @ rows).max()) / max(float(np.abs(goal).max()), 1e-300)


def active_set(
    z: Array, first: FirstOrder, variables: Sequence[str], *, active: float = KktOptions.active
) -> ActiveSet:
    """Collect the active constraints and bounds at a point of the unit box.

    Parameters
    ----------
    z, first : array (n,), FirstOrder
        The point, and its first derivatives.
    variables : sequence of str (n,)
        Names of the components of z, by which their bounds are labelled.
    active : float
        As in `KktOptions`.

    Returns
    -------
    ActiveSet
    """
    chosen = np.flatnonzero(first.g >= -active)
    rows, values, sizes = ([*each[chosen]] for each in (first.jacobian, first.g, first.sizes))
    labels, count = [first.names[i] for i in chosen], len(chosen)
    for i, name in enumerate(variables):
        for end, value, sign in (("lower", -z[i], -1.0), ("upper", z[i] - 1.0, 1.0)):
            if value >= -active:
                rows.append(sign * np.eye(z.size)[i])
                labels.append(f"{name} {end}")
                values.append(value)
                sizes.append(1.0)
    # NumPy's maximum is NaN where one of them is: an unknown constraint is not a met one.
    violation = float(np.concatenate([[0.0], -z, z - 1.0, first.g]).max())
    A = np.array(rows).reshape(-1, z.size)
    return ActiveSet(
        first.gradient, A, np.array(values), np.array(sizes), tuple(labels), count, violation
    )


def reduced_curvature(Z: Array, columns: Array | None, scale: float) -> float | None:
    """Find the least eigenvalue of the reduced Hessian ZᵀHZ.

    Parameters
    ----------
    Z, columns : array (n, k), (n, k) or None
        Z, a basis of the null space of the active constraints, and HZ.
    scale : float
        ‖∇J‖∞, by which the eigenvalue is divided.

    Returns
    -------
    float or None
        inf at a vertex (k = 0), None where HZ is None or has NaN.
    """
    if Z.shape[1] == 0:
        return np.inf
    if columns is None or not np.isfinite(columns).all():
        return None
    H = Z.T @ columns  # symmetric but for the error of the differences
    return float(np.linalg.eigvalsh(0.5 * (H + H.T)).min()) / scale


def hessian_products(
    gradients: Callable[[Array], Sequence[Array | None]],
    z: Array,
    directions: Array,
    step: float = KktOptions.step,
) -> Array | None:
    """Multiply a Hessian by directions d: (∇J(z + a d) - ∇J(z - b d))/(a + b).

    a and b are h, or what the box leaves of it along the line, so that the quotient is along d
    itself beside a bound too: a side that was clipped by itself would turn the line.

    Parameters
    ----------
    gradients : callable
        Of J at many points: z (2k, n) to 2k arrays (n,), None where there is none.
    z, directions : array (n,), (n, k)
        In the unit box; orthonormal columns d.
    step : float
        h, in shares of the box.

    Returns
    -------
    array (n, k) or None
        None where a gradient is missing, or the box leaves less than h/2 of a line.
    """
    rays, rounding = np.concatenate([directions.T, -directions.T]), 1e-8 * step
    with np.errstate(divide="ignore"):  # the larger is the face that the ray runs towards
        faces = np.maximum((1.0 - z + rounding) / rays, (-z - rounding) / rays)
    steps = np.clip(faces.min(axis=1), 0.0, step)
    points = np.clip(z + steps[:, None] * rays, 0.0, 1.0)
    distance = steps.reshape(2, -1).sum(axis=0)
    if (distance < 0.5 * step).any():
        return None
    values = [gradient for gradient in gradients(points) if gradient is not None]
    if len(values) < len(points):
        return None
    forward, backward = np.split(np.array(values), 2)
    return np.asarray(((forward - backward) / distance[:, None]).T)
