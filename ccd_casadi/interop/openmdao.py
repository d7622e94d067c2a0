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
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.true_function import TrueQuantities
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import require

om: Any = require("openmdao.api", "openmdao")
FREQUENCIES = ("ln_omega_S", "ln_omega_T")


class _Component(om.ExplicitComponent):
    """Inputs x by name, f(θ) and λ(θ); what is controlled is for those that inherit."""

    def initialize(self) -> None:
        self.options.declare("problem", types=CoDesignProblem, desc="as `problem_of` makes it")

    def setup(self) -> None:
        problem: CoDesignProblem = self.options["problem"]
        for name, value, unit in zip(problem.names, problem.start, problem.units, strict=True):
            self.add_input(name, val=value, units=om_unit(unit))
        plant = plant_of(problem)
        theta = ca.MX.sym("theta", len(problem.names))
        f, lam = plant.hardware(theta)
        slopes = [ca.jacobian(f, theta), ca.jacobian(lam, theta)]
        self._hardware = ca.Function("hardware_and_slopes", [theta], [f, lam, *slopes])
        self.add_output("hardware_cost", desc="f(θ)")
        if plant.constraint_names:
            names = ", ".join(plant.constraint_names)
            self.add_output("constraints", shape=len(plant.constraint_names), desc=f"<= 0: {names}")

    def setup_partials(self) -> None:
        self.declare_partials("*", "*")
        if self._variables() != self._theta():  # f and λ know nothing of the weights
            for output in set(self._plain()) & {"hardware_cost", "constraints"}:
                self.declare_partials(output, list(FREQUENCIES), dependent=False)

    def _theta(self) -> tuple[str, ...]:
        return tuple(self.options["problem"].names)

    def _variables(self) -> tuple[str, ...]:
        return self._theta()

    def _plain(self) -> list[str]:
        return [name.rpartition(".")[2] for name in self._var_rel_names["output"]]

    def _x(self, inputs: Mapping[str, Any]) -> Array:
        return np.array([float(inputs[name].item()) for name in self._variables()])

    def _write(self, outputs: Any, theta: Array) -> None:
        f, lam = self._hardware(theta)[:2]
        outputs["hardware_cost"] = float(f)
        if "constraints" in self._plain():
            outputs["constraints"] = np.array(lam).ravel()

    def _write_slopes(self, partials: Any, theta: Array) -> None:
        df, dlam = (np.array(part) for part in self._hardware(theta)[2:])
        for i, name in enumerate(self._theta()):
            partials["hardware_cost", name] = df[0, i]
            if "constraints" in self._plain():
                partials["constraints", name] = dlam[:, [i]]


class CertifiedLoop(_Component):
    """One certified synthesis: (θ, ln ω_S, ln ω_T) to ω_b, ‖S‖∞, σ_max(S(jω_low)), γ_opt, f, λ.

    Inputs are θ under its names (SI), `ln_omega_S` and `ln_omega_T` (of rad/s). Outputs:
    `bandwidth` (rad/s), `sensitivity_peak`, `sensitivity_low`, `compliance` (m/N, where the problem
    bounds it), `gamma_opt`, `hardware_cost` and `constraints` (λ <= 0, where there are any). The
    partials are the total derivatives of `TrueQuantities`. `bounds` and `limits` hold what is to be
    kept, `pose` tells it to a model.
    """

    def setup(self) -> None:
        problem: CoDesignProblem = self.options["problem"]
        self._truth = TrueQuantities(problem)
        super().setup()
        for name, (low, high) in zip(FREQUENCIES, self._ranges(problem), strict=True):
            self.add_input(name, val=0.5 * (low + high), desc="ln of rad/s")
        self.add_output("bandwidth", units="rad/s", desc="ω_b")
        for name, _ in problem.inner.bounds.values():
            self.add_output(name, val=1.0, units="m/N" if name == "compliance" else None)
        self.add_output("gamma_opt", val=1.0)

    def compute(self, inputs: Any, outputs: Any) -> None:
        x = self._x(inputs)
        design = self._truth.at(x)
        if not design.figures.certified:
            raise om.AnalysisError(f"not certified: {design.figures.outcome.value}")
        self._write(outputs, x[:-2])
        for name, value in zip(self._controlled(), self._scaled(x), strict=True):
            outputs[name] = value

    def compute_partials(self, inputs: Any, partials: Any) -> None:
        x = self._x(inputs)
        self._write_slopes(partials, x[:-2])
        # of ω_b and γ_opt themselves, of the others in ln
        factors = self._scaled(x)
        factors[[0, -1]] = 1.0
        slopes = factors[:, None] * self._truth.jacobian_at(x)
        for name, row in zip(self._controlled(), slopes, strict=True):
            for variable, slope in zip(self._variables(), row, strict=True):
                partials[name, variable] = slope

    def _variables(self) -> tuple[str, ...]:
        return (*self._theta(), *FREQUENCIES)

    def _controlled(self) -> tuple[str, ...]:
        bounded = (name for name, _ in self.options["problem"].inner.bounds.values())
        return ("bandwidth", *bounded, "gamma_opt")

    def _scaled(self, x: Array) -> Array:
        values = self._truth.values(x).copy()
        values[1:-1] = np.exp(values[1:-1])
        return values

    @staticmethod
    def _ranges(problem: CoDesignProblem) -> Array:
        return np.log([problem.inner.omega_S, problem.inner.omega_T])


class LargestBandwidth(_Component):
    """The true inner problem at θ: ω_b*(θ), every bound of the case kept, with f and λ.

    Outputs `bandwidth` (rad/s), or `rms_error` (m) where the case minimises that, `hardware_cost`
    and `constraints`. The partials are the envelope gradient; it jumps where the binding bounds
    change. A fixed structure needs the problem of a finished run, `read_run(folder).problem`, whose
    anchors make ω_b*(θ) a function of θ alone.

    Raises UserError for a fixed structure without anchors.
    """

    def setup(self) -> None:
        problem: CoDesignProblem = self.options["problem"]
        super().setup()
        self._found: dict[bytes, tuple[float, Array]] = {}
        self._value = problem.figure.key
        kind_of(problem).require_function()
        self.add_output(self._value, units=problem.figure.si_unit)

    def compute(self, inputs: Any, outputs: Any) -> None:
        theta = self._x(inputs)
        value, _ = self._at(theta)
        if not np.isfinite(value):
            raise om.AnalysisError("no certified design meets the bounds at this theta")
        self._write(outputs, theta)
        outputs[self._value] = value

    def compute_partials(self, inputs: Any, partials: Any) -> None:
        theta = self._x(inputs)
        self._write_slopes(partials, theta)
        for name, slope in zip(self._theta(), self._at(theta)[1], strict=True):
            partials[self._value, name] = slope

    def _at(self, theta: Array) -> tuple[float, Array]:
        key = theta.tobytes()
        if key not in self._found:
            self._found[key] = kind_of(self.options["problem"]).value(theta.tolist())
        return self._found[key]


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
