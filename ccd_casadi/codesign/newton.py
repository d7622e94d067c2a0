"""Newton's step on the optimality conditions, for what J's rounding hides from a descent.

    min ∇Jᵀd + ½ dᵀ∇²L d   s.t.  Ad = -(g + ε) on active constraints, d = 0 on active bounds

in unit-box variables. J is good to some 1e-9 of its terms, so that a method which watches it
fall ends where the residual of its gradient is 1e-6; the gradients themselves are good to 1e-10.
"""

import numpy as np
from scipy.linalg import null_space

from ccd_casadi.codesign.kinked import INSIDE
from ccd_casadi.codesign.kkt import active_at, lagrangian_hessian
from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.true_function import TrueQuantities
from ccd_casadi.optim.kkt import KktCertificate
from ccd_casadi.support.arrays import Array

NEAR = 1e-3  # of the box: a longer step is not of the basin that the residual spoke of


def newton_step(
    problem: CoDesignProblem, quantities: TrueQuantities, x: Array, kkt: KktCertificate
) -> Array | None:
    """Where the step from x ends; None without a positive reduced Hessian, or past `NEAR`.

    x = (θ, ln ω_S, ln ω_T) with its certificate `kkt` of the plain conditions. The Hessian takes
    two true designs per free direction. Nocedal and Wright, Numerical Optimization, 18.1.
    """
    here = active_at(problem, x, quantities.at(x))
    held = np.array([kkt.multipliers[name] > 0.0 for name in here.labels], bool)
    A = here.rows[held]
    inside = np.array([INSIDE * (name in problem.inner.bounds) for name in here.labels])
    aim = np.where(np.arange(held.size) < here.constraints, -(here.slack + inside), 0.0)[held]
    Z = null_space(A) if A.size else np.eye(x.size)
    if Z.shape[1] == 0:  # a vertex
        return None
    columns = lagrangian_hessian(problem, x, Z, kkt.multipliers, quantities.at)
    if columns is None:
        return None
    H = Z.T @ columns
    H = 0.5 * (H + H.T)
    if np.linalg.eigvalsh(H).min() <= 0.0:
        return None
    d = -Z @ np.linalg.solve(H, Z.T @ here.gradient)
    if A.size:
        d = d + np.linalg.lstsq(A, aim, rcond=None)[0]
    if np.abs(d).max() > NEAR:
        return None
    lower, upper = lifted_bounds(problem)
    return np.clip(x + (upper - lower) * d, lower, upper)
