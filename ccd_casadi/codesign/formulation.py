"""What a formulation leaves behind: its iterates, its surrogate, and the design it ends with."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.codesign.outer_problem import OuterSolution
from ccd_casadi.inner_problem.controller_problem import FigureOfMerit
from ccd_casadi.inner_problem.objective import objective
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.sampling.inner_samples import InnerSample, QuantitySample
from ccd_casadi.support.arrays import Array
from surrogates import GaussianProcess


@dataclass(frozen=True)
class FormulationRound:
    """One round: what the surrogate promised at θ and what the true inner problem gave.

    Attributes
    ----------
    theta : tuple of float
        SI.
    predicted, truth : float
        ω_b in rad/s, or another figure in SI; `truth` NaN where θ is infeasible.
    predicted_objective, objective : float
        J of both.
    error : float
        Relative.
    step, radius : float
        From the incumbent, and of the trust region, in shares of the box.
    """

    theta: tuple[float, ...]
    predicted: float
    truth: float
    predicted_objective: float
    objective: float
    error: float
    step: float
    radius: float


def iterate_of(
    problem: CoDesignProblem, theta: tuple[float, ...], predicted: float, truth: float,
    *, error: float, step: float, radius: float = 1.0,
) -> FormulationRound:  # fmt: skip
    """A round with J as it was promised and as it is, infinite where there is no true value."""
    promised, J = (objective(problem, theta, value) for value in (predicted, truth))
    J = J if np.isfinite(truth) else np.inf
    return FormulationRound(theta, predicted, truth, promised, J, error, step, radius)


@dataclass(frozen=True)
class FormulationResult:
    """x = (θ, ln ω_S, ln ω_T) of the best verified design (None: infeasible) and the way there.

    `surrogates` are the processes of ω_b* (nested) or of ω_b, ln‖S‖∞, ln|S(jω_low)| (lifted),
    none for direct; `agreed` tells whether prediction and truth met the tolerance at the end.
    `foreseen`: what they predicted of the run's end before they learnt it, SI (None: they did not).
    """

    x: Array | None = None
    iterates: tuple[FormulationRound, ...] = ()
    surrogates: tuple[GaussianProcess, ...] = ()
    outer: OuterSolution | None = None
    agreed: bool = False
    message: str = ""
    foreseen: float | None = None


def outputs_of(figure: FigureOfMerit) -> dict[str, str]:
    """What `surrogates` are of, in their order, with units; ln of ratios, and of m/N."""
    ratios = {"ln_sensitivity_peak": "1", "ln_sensitivity_low": "1"}
    return {figure.key: figure.si_unit, **ratios, "ln_compliance": "ln(m/N)"}


# What a formulation may begin with in place of its own plan: samples at θ, or at (θ, ω_S, ω_T).
KnownSamples = Sequence[InnerSample | QuantitySample]


@dataclass(frozen=True)
class RunTerms:
    """By which formulation, to what relative tolerance and from which seed a run goes; `began` on
    the clock of `perf_counter`."""

    formulation: str
    tolerance: float
    seed: int
    began: float = field(default_factory=perf_counter)


@dataclass(frozen=True)
class GlobalCheck:
    """What was evaluated: true inner problems at `points` θ, `feasible` of these with a design.

    `fresh`: those that were solved for it; the run had solved the rest on its way.
    `better`: how many of them beat the J that the formulation came `before` with; `starts` local
    solves went from them; `after` is the best J at the end, at `x` (None: nothing was better).
    """

    points: int
    fresh: int
    feasible: int
    better: int
    starts: int
    seed: int
    before: float
    after: float
    x: Array | None

    @property
    def moved(self) -> bool:
        """Whether something better was found."""
        return self.x is not None

    @property
    def entry(self) -> dict[str, Any]:
        """Of result.json."""
        return {key: value for key, value in vars(self).items() if key != "x"} | {
            "moved": self.moved
        }
