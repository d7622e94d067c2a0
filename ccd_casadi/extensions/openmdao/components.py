"""Certified loops as components of OpenMDAO, with exact partials.

`CertifiedLoop` is one synthesis at (θ, ln ω_S, ln ω_T), its bounds the optimiser's constraints;
`LargestBandwidth` the whole inner problem at θ. Both raise `om.AnalysisError` where no design is
certified, on which a driver that can shorten its step does so, and both also give f(θ) and λ(θ).
"""

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.objective import TrueQuantities
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
from ccd_casadi.support.errors import require

om: Any = require("openmdao.api", "openmdao")
FREQUENCIES = ("ln_omega_S", "ln_omega_T")


class _Component(om.ExplicitComponent):
    """A CasADi function of named inputs as named outputs, its Jacobian as their partials."""

    def initialize(self) -> None:
        self.options.declare("problem", types=CoDesignProblem, desc="as `problem_of` makes it")

    def declare(self, x: ca.MX, controlled: Mapping[str, ca.MX], units: Mapping[str, str]) -> None:
        """Inputs θ, and ln ω_S and ln ω_T where x has them; outputs `controlled`, f and λ."""
        problem: CoDesignProblem = self.options["problem"]
        middle = np.log([problem.inner.omega_S, problem.inner.omega_T]).mean(axis=1)
        start = (*problem.start, *middle)[: x.numel()]
        self._inputs = (*problem.names, *FREQUENCIES)[: x.numel()]
        for name, value, unit in zip(self._inputs, start, (*problem.units, "", ""), strict=False):
            self.add_input(name, val=value, units=om_unit(unit))
        plant = plant_of(problem)
        f, lam = plant.hardware(x[: len(problem.names)])
        made = {**controlled, "hardware_cost": f}
        made |= {"constraints": lam} if plant.constraint_names else {}
        for name, value in made.items():
            self.add_output(name, val=1.0, shape=value.numel(), units=units.get(name))
        self.declare_partials("*", "*")
        values = ca.vertcat(*made.values())
        self._values = ca.Function("values", [x], [values])
        self._slopes = ca.Function("slopes", [x], [ca.jacobian(values, x)])
        ends = np.cumsum([value.numel() for value in made.values()])
        self._rows = dict(zip(made, np.split(np.arange(ends[-1]), ends[:-1]), strict=True))

    def compute(self, inputs: Any, outputs: Any) -> None:
        x = self._x(inputs)
        values = np.array(self._values(x)).ravel()
        if not np.isfinite(values).all():
            raise om.AnalysisError(self.reason(x))
        for name, rows in self._rows.items():
            outputs[name] = values[rows]

    def compute_partials(self, inputs: Any, partials: Any) -> None:
        slopes = np.array(self._slopes(self._x(inputs)))
        for name, rows in self._rows.items():
            for column, variable in enumerate(self._inputs):
                partials[name, variable] = slopes[rows, column][:, None]

    def _x(self, inputs: Mapping[str, Any]) -> Array:
        return np.array([float(inputs[name].item()) for name in self._inputs])


class CertifiedLoop(_Component):
    """One certified synthesis: (θ, ln ω_S, ln ω_T) to ω_b, ‖S‖∞, σ_max(S(jω_low)), γ_opt, f, λ.

    Inputs are θ under its names (SI), `ln_omega_S` and `ln_omega_T` (of rad/s). Outputs:
    `bandwidth` (rad/s), `sensitivity_peak`, `sensitivity_low`, `compliance` (m/N, where the problem
    bounds it), `gamma_opt`, `hardware_cost` and `constraints` (λ <= 0, where there are any). The
    partials are the total derivatives of `TrueQuantities`. `pose` gives a model what is to be kept.
    """

    def setup(self) -> None:
        problem: CoDesignProblem = self.options["problem"]
        self._truth = TrueQuantities(problem)
        x = ca.MX.sym("x", len(problem.names) + 2)
        bandwidth, *logarithms, gamma = ca.vertsplit(self._truth(x))
        bounded = [name for name, _ in problem.inner.bounds.values()]
        figures = {name: ca.exp(y) for name, y in zip(bounded, logarithms, strict=True)}
        found = {"bandwidth": bandwidth, **figures, "gamma_opt": gamma}
        self.declare(x, found, {"bandwidth": "rad/s", "compliance": "m/N"})

    def reason(self, x: Array) -> str:
        """Explain why there is no design at x."""
        return f"not certified: {self._truth.at(x).figures.outcome.value}"


class LargestBandwidth(_Component):
    """The true inner problem at θ: ω_b*(θ), every bound of the case kept, with f and λ.

    Outputs `bandwidth` (rad/s), or `rms_error` (m) or `move_time` (s) where the case minimises
    that, `hardware_cost` and `constraints`. The partials are the envelope gradient; it jumps where
    the binding bounds change. A fixed structure needs the problem of a finished run,
    `read_run(folder).problem`, whose warm starts make ω_b*(θ) a function of θ alone.

    Raises UserError for a fixed structure without warm starts.
    """

    def setup(self) -> None:
        problem: CoDesignProblem = self.options["problem"]
        kind, figure, known = kind_of(problem), problem.figure, dict[bytes, tuple[float, Array]]()
        kind.require_function()

        def at(theta: Array) -> tuple[float, Array]:
            key = theta.tobytes()
            if key not in known:
                known[key] = kind.value(theta.tolist())
            return known[key]

        self._truth = VectorCallback(
            "largest", len(problem.names), 1,
            lambda x: np.array([at(x)[0]]), lambda x: at(x)[1][None],
        )  # fmt: skip
        theta = ca.MX.sym("theta", len(problem.names))
        self.declare(theta, {figure.key: self._truth(theta)}, {figure.key: figure.si_unit})

    def reason(self, x: Array) -> str:
        """Explain why there is no design at θ."""
        return "no certified design meets the bounds at this theta"


def pose(model: Any, problem: CoDesignProblem, *, weights: bool = True) -> None:
    """Tell an OpenMDAO model the problem's start, bounds and constraints; no objective.

    Names are taken as promoted to the model. Variables are scaled to their ranges, constraints to
    their bounds. `weights`: of a `CertifiedLoop`, whose weights' frequencies are variables too.
    """
    box = dict(zip(problem.names, zip(problem.lower, problem.upper, strict=True), strict=True))
    inner = problem.inner
    if weights:
        box |= dict(zip(FREQUENCIES, np.log([inner.omega_S, inner.omega_T]), strict=True))
        for name, bound in inner.bounds.values():
            model.add_constraint(name, upper=bound, ref=bound)
    for name, start, unit in zip(problem.names, problem.start, problem.units, strict=True):
        model.set_input_defaults(name, val=start, units=om_unit(unit))
    for name, (low, high) in box.items():
        model.add_design_var(name, lower=low, upper=high, ref0=low, ref=high)
    if plant_of(problem).constraint_names:
        model.add_constraint("constraints", upper=0.0)


def om_unit(unit: str) -> str | None:
    """A unit that OpenMDAO knows; what it does not know goes without one."""
    known = require("openmdao.utils.units", "openmdao").valid_units
    return unit if unit and known(unit) else None
