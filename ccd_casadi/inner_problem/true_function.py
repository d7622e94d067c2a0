"""The true inner quantities as a CasADi function with exact Jacobian, for any nlpsol.

    (θ, ln ω_S, ln ω_T) -> (ω_b, ln‖S‖∞, ln σ_max(S(jω_low)), γ_opt)

with ln‖GS‖∞ before γ_opt where the problem bounds the compliance. Each evaluation is one certified
synthesis with its total derivatives. Where a design is not certified the values are NaN, which
makes IPOPT shorten its step. Hessians are not available: use a quasi-Newton method
(`ipopt.hessian_approximation = "limited-memory"`).
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant, true_design
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
from ccd_casadi.synthesis.closed_loop import recertified_in_si
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.synthesis import Design, synthesise


def final_design(
    problem: CoDesignProblem, theta: Sequence[float], point: tuple[float, float]
) -> Design:
    """The synthesis at (ω_S, ω_T) in rad/s that is handed out, in SI and certified again there."""
    plant, inner = scaled_plant(problem, theta), problem.inner
    made = synthesise(
        plant, problem.weights.at(*point), omega_low=inner.omega_low,
        gamma_backoff=inner.gamma_backoff, compliance=True,
    )  # fmt: skip
    return recertified_in_si(plant, made, inner.omega_low)


class TrueQuantities(VectorCallback):
    """(θ, ln ω_S, ln ω_T) -> ω_b (rad/s), ln‖S‖∞, ln σ_max(S(jω_low)), γ_opt, with exact Jacobian.

    Before γ_opt comes ln‖GS‖∞ (m/N) where the problem has a `compliance_max`. A casadi.Callback:
    keep a reference to it as long as anything built on it is in use. A design that is not certified
    is NaN, on which IPOPT shortens its step.

    Parameters
    ----------
    problem : CoDesignProblem
        The problem.
    kept : callable, optional
        (x, compute) -> Sensitivities: a store of what was computed.

    Examples
    --------
    >>> import ccd_casadi as ccd
    >>> import numpy as np
    >>> quantities = ccd.TrueQuantities(ccd.problem_of(ccd.load_case(ccd.TWO_MASS)))
    >>> x = [60.0, 60.0, *np.log([800.0 * ccd.HZ, 40.0 * ccd.HZ])]
    >>> round(float(quantities(x)[0]) / ccd.HZ, 2)
    55.56
    """

    def __init__(
        self,
        problem: CoDesignProblem,
        kept: Callable[[Array, Callable[[], Sensitivities]], Sensitivities] | None = None,
    ) -> None:
        """`kept(x, make)` gives the design at x from where designs are kept, or makes it."""
        self.problem = problem
        self.kept = kept
        self.designs: dict[bytes, Sensitivities] = {}
        count = len(problem.names) + 2
        self.size = 2 + len(problem.inner.bounds)
        super().__init__("true_quantities", count, self.size, self.values, self.jacobian_at)

    def at(self, x: Array) -> Sensitivities:
        """The design at x = (θ, ln ω_S, ln ω_T); repeated points cost nothing."""
        x = np.asarray(x, float).ravel()
        key = x.tobytes()
        if key not in self.designs:
            at = self.problem.inner.frequencies(x)
            make = partial(true_design, self.problem, tuple(x[:-2]), *at)
            self.designs[key] = make() if self.kept is None else self.kept(x, make)
        return self.designs[key]

    def values(self, x: Array) -> Array:
        """Values, NaN where the design is not certified."""
        design = self.at(x)
        return design.values if design.figures.certified else np.full(self.size, np.nan)

    def jacobian_at(self, x: Array) -> Array:
        """Derivatives of the values (…, n_θ + 2)."""
        design = self.at(x)
        return np.hstack([design.to_theta, design.to_break_frequencies])
