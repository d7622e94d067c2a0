"""The optimum that surrogates predict, by IPOPT from several starts.

    min J(x, s(x))  s.t.  g(x, s(x)) <= 0,  lower <= x <= upper,  ‖x̂ - x̂_f‖ >= AVOID

with s the surrogates' means, x̂ in the unit box and x_f the points where the truth had no value.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from surrogates.acquisition import AVOID
from surrogates.casadi_export import to_casadi
from surrogates.gaussian_process import GaussianProcess
from surrogates.interface import Array
from surrogates.ipopt import end_points
from surrogates.truth import Truth


@dataclass(frozen=True, eq=False)
class Optimum:
    """x (d,), the predicted J there, and from how many starts IPOPT converged."""

    x: Array
    objective: float
    converged: int


def predicted_optimum(
    truth: Truth, surrogates: Sequence[GaussianProcess], starts: Array, failed: Array
) -> Optimum | None:
    """The best local optimum from `starts` (m, d), away from `failed` (f, d); None without one."""
    lower, width = truth.lower, truth.upper - truth.lower
    z = ca.MX.sym("z", len(lower))
    x = lower + width * z
    y = to_casadi(list(surrogates), std=False)(x)
    free = [AVOID**2 - ca.sumsqr(z - point) for point in (failed - lower) / width]
    g = ca.vertcat(truth.constraints(x, y), *free)
    program = {"x": z, "f": truth.objective(x, y), "g": g}
    ends = [end for end in end_points(program, (starts - lower) / width) if end.converged]
    if not ends:
        return None
    best = min(ends, key=lambda end: end.objective)
    return Optimum(lower + width * best.z, best.objective, len(ends))
