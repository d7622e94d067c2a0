"""The true inner quantities as a CasADi function with exact Jacobian, for any nlpsol.

    (θ, ln ω_S, ln ω_T) -> (ω_b, ln‖S‖∞, ln σ_max(S(jω_low)), γ_opt)

Each evaluation is one certified synthesis with its total derivatives. Where a design is not
certified the values are NaN, which makes IPOPT shorten its step. Hessians are not available:
use a quasi-Newton method (`ipopt.hessian_approximation = "limited-memory"`).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.derivatives import Sensitivities
from ccd_casadi.interrupts import pending
from ccd_casadi.plant import Array
from ccd_casadi.problem import CoDesignProblem, true_design


class TrueQuantities(ca.Callback):
    """A casadi.Callback; keep a reference to it as long as anything built on it is in use."""

    def __init__(
        self,
        problem: CoDesignProblem,
        record: Callable[[Array, Sensitivities], None] | None = None,
    ) -> None:
        """`record` is told every true synthesis (x, design)."""
        ca.Callback.__init__(self)
        self.problem = problem
        self.record = record
        self.designs: dict[bytes, Sensitivities] = {}
        self._jacobian: ca.Callback | None = None
        self.construct("true_quantities", {})

    def at(self, x: Array) -> Sensitivities:
        """The design at x = (θ, ln ω_S, ln ω_T); repeated points cost nothing."""
        x = np.asarray(x, float).ravel()
        key = x.tobytes()
        if key not in self.designs:
            omega = np.exp(x[-2:])
            inner = self.problem.inner
            # exp(log(bound)) may miss the bound by a rounding error
            omega_S = float(np.clip(omega[0], *inner.omega_S))
            omega_T = float(np.clip(omega[1], *inner.omega_T))
            design = true_design(self.problem, tuple(x[:-2]), omega_S, omega_T)
            self.designs[key] = design
            if self.record is not None:
                self.record(x, design)
        return self.designs[key]

    def values(self, x: Array) -> Array:
        """(4,) values, NaN where the design is not certified."""
        design = self.at(x)
        return design.values if design.figures.certified else np.full(4, np.nan)

    def jacobian_at(self, x: Array) -> Array:
        """(4, n_θ + 2) derivatives."""
        design = self.at(x)
        return np.hstack([design.to_theta, design.to_break_frequencies])

    def get_n_in(self) -> int:
        return 1

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(len(self.problem.names) + 2, 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(4, 1)

    def eval(self, arguments: Sequence[ca.DM]) -> list[Array]:
        if pending():  # NaN ends IPOPT quickly; the interrupt is raised when it has returned
            return [np.full(4, np.nan)]
        return [self.values(np.array(arguments[0]))]

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(
        self, name: str, inames: Sequence[str], onames: Sequence[str], options: Mapping[str, Any]
    ) -> ca.Function:
        parent = self

        class Jacobian(ca.Callback):
            def __init__(self) -> None:
                ca.Callback.__init__(self)
                self.construct(name, options)

            def get_n_in(self) -> int:
                return 2

            def get_n_out(self) -> int:
                return 1

            def get_sparsity_in(self, i: int) -> ca.Sparsity:
                return parent.get_sparsity_in(0) if i == 0 else ca.Sparsity(4, 1)

            def get_sparsity_out(self, i: int) -> ca.Sparsity:
                return ca.Sparsity.dense(4, len(parent.problem.names) + 2)

            def eval(self, arguments: Sequence[ca.DM]) -> list[Array]:
                return [parent.jacobian_at(np.array(arguments[0]))]

        self._jacobian = Jacobian()
        return self._jacobian
