"""The outer problem in CasADi, solved by IPOPT from many starts.

    min  w1 f(θ) + w2 ω_b   s.t.  θ_min <= θ <= θ_max,  λ(θ) <= 0        (paper, equation (9))

`nested` puts the surrogate ω_b*(θ) for ω_b; `lifted` has ω_S and ω_T as variables too, with
‖S‖∞ <= S_max, σ_max(S(jω_low)) <= S_low and ‖GS‖∞ <= compliance_max as explicit constraints on
surrogates; `direct` has no programme: it is local solves on the truth.

What such a formulation leaves behind is here too: iterates, surrogate, and the design it ends with.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.inner_problem.controller_problem import FigureOfMerit
from ccd_casadi.inner_problem.objective import (
    constraint_shares,
    constraint_sizes,
    objective,
    violations,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.sweep import SweepOptions
from ccd_casadi.optim.pieces import Box
from ccd_casadi.plants.plant import constraint_values
from ccd_casadi.sampling.inner_samples import InnerSample, QuantitySample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import interrupts_kept, raise_dropped
from surrogates import GaussianProcess, design

IPOPT: dict[str, Any] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-9,
    "ipopt.acceptable_tol": 1e-7,
    "ipopt.max_iter": 300,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.honor_original_bounds": "yes",
    "show_eval_warnings": False,
}


@dataclass(frozen=True)
class NonlinearProgram:
    """min f(x)  s.t.  g(x) <= 0, x in its box.

    Attributes
    ----------
    x, f, g : casadi.MX
        Variables (n,), J, and constraints (m,), of which λ is in shares of its size.
    box : Box
        Bounds of x.
    exact_hessian : bool
        Whether CasADi has second derivatives of the plant's hardware.
    """

    x: ca.MX
    f: ca.MX
    g: ca.MX
    box: Box
    exact_hessian: bool = True


@dataclass(frozen=True)
class OuterOptimum:
    """The end of local solves from this number of `starts`."""

    x: Array
    objective: float
    starts: int = 1


@dataclass(frozen=True)
class OuterSolution:
    """All distinct local optima, best first, and the number of starts that led to them."""

    optima: tuple[OuterOptimum, ...]
    starts: int

    @property
    def best(self) -> OuterOptimum:
        """The optimum of the least objective."""
        return self.optima[0]


class OuterFailure(RuntimeError):
    """IPOPT converged from no start."""


def outer_program(
    problem: CoDesignProblem, model: ca.Function, *, margin: float = SweepOptions.margin
) -> NonlinearProgram:
    """The program of equation (9) with a model in place of the true synthesis.

    Parameters
    ----------
    problem : CoDesignProblem
        J, λ and the box.
    model : casadi.Function
        θ (n_θ,) to ω_b in rad/s; or (θ, ln ω_S, ln ω_T), ω in rad/s, to ω_b and ln of each
        bounded figure of the loop, which are then constraints.
    margin : float
        ln: how far inside their bounds these are kept.

    Returns
    -------
    NonlinearProgram
        Over the inputs of the model.
    """
    lifted = model.size1_in(0) > len(problem.names)
    bounds = lifted_bounds(problem) if lifted else box(problem)
    levels = problem.inner.levels - margin if lifted else ()
    x = ca.MX.sym("x", len(bounds.lower))
    q = model(x)
    f, lam = _hardware(problem, x[: len(problem.names)])
    J = problem.w1 * f + problem.w2 * q[0]
    g = ca.vertcat(*(q[1 + i] - level for i, level in enumerate(levels)), lam)
    return NonlinearProgram(x, J, g, bounds, plant_of(problem).exact_hessian)


def lifted_bounds(problem: CoDesignProblem) -> Box:
    """Bounds of x = (θ, ln ω_S, ln ω_T).

    Parameters
    ----------
    problem : CoDesignProblem
        With mixed-sensitivity controllers.

    Returns
    -------
    Box
        Of n_θ + 2 variables: θ in SI, ω in rad/s.
    """
    ends = np.log([problem.inner.omega_S, problem.inner.omega_T])
    return Box(*(np.append(end, ends[:, i]) for i, end in enumerate(box(problem))))


def solve_program(program: NonlinearProgram, starts: Array) -> OuterSolution:
    """Solve a program by IPOPT from many starts, with variables scaled to the unit box.

    Parameters
    ----------
    program : NonlinearProgram
        Its box has finite ends.
    starts : (k, n) array
        In the units of x; outside of the box they are moved onto it.

    Returns
    -------
    OuterSolution
        The distinct local optima.

    Raises
    ------
    OuterFailure
        No start converges.
    """
    lower, width = program.box.lower, program.box.width
    z = ca.MX.sym("z", program.x.shape[0])
    inside = lower + width * z
    f, g = ca.substitute([program.f, program.g], [program.x], [inside])
    options = IPOPT.copy()
    if not program.exact_hessian:
        options["ipopt.hessian_approximation"] = "limited-memory"
    solver = ca.nlpsol("program", "ipopt", {"x": z, "f": f, "g": g}, options)
    started = np.clip(program.box.shares(np.atleast_2d(starts)), 0.0, 1.0)
    ends, verdicts = [], []
    for start in started:
        raise_dropped()
        with interrupts_kept():  # Ctrl-C ends it after the start that is under way
            result = solver(x0=start, lbx=0.0, ubx=1.0, lbg=-np.inf, ubg=0.0)
        stats = solver.stats()
        verdicts.append(str(stats["return_status"]))
        if stats["success"]:
            ends.append((float(result["f"]), np.clip(np.array(result["x"]).ravel(), 0.0, 1.0)))
    if not ends:
        raise OuterFailure(f"IPOPT converged from none of {len(started)} starts: {verdicts[0]}")
    return distinct([(J, lower + width * end) for J, end in ends], program.box, len(started))


def distinct(
    ends: Sequence[tuple[float, Array]], bounds: Box, starts: int, apart: float = 1e-4
) -> OuterSolution:
    """Ends (J, x) of local solves from this many starts; those closer than `apart` (shares of the
    box) are one optimum."""
    optima: list[OuterOptimum] = []
    for J, x in sorted(ends, key=lambda item: item[0]):
        near = (i for i, other in enumerate(optima) if bounds.away(x, other.x) < apart)
        same = next(near, None)
        if same is None:
            optima.append(OuterOptimum(x, J))
        else:
            optima[same] = replace(optima[same], starts=optima[same].starts + 1)
    return OuterSolution(tuple(optima), starts)


def unmet_constraint(problem: CoDesignProblem, starts: int, seed: int) -> str:
    """Empty where some θ in its box meets λ(θ) <= 0; else which constraint fails, and by how much.

    Minimises the largest λ, so that the words name what stands nearest to being met.
    """
    plant = plant_of(problem)
    if not plant.constraint_names:
        return ""
    lower, upper = box(problem)
    points = np.vstack([problem.start, design("sobol", lower, upper, starts, seed)])
    if not all(violations(problem, point) for point in points):
        return ""
    theta, slack = ca.MX.sym("theta", len(lower)), ca.MX.sym("slack")
    shares = np.array([constraint_shares(problem, point).max() for point in points])
    most = 2.0 * float(np.abs(shares).max())
    program = NonlinearProgram(
        x=ca.vertcat(theta, slack),
        f=slack,
        g=_hardware(problem, theta)[1] - slack,
        box=Box(np.append(lower, -most), np.append(upper, most)),
        exact_hessian=plant.exact_hessian,
    )
    try:
        best = solve_program(program, np.column_stack([points, shares])).best.x[:-1]
    except OuterFailure:
        best = points[np.argmin(shares)]
    if not violations(problem, best):
        return ""
    worst = int(np.argmax(constraint_shares(problem, best)))
    least = constraint_values(plant, best)[worst]
    return (
        f"no theta was found that meets the constraint {plant.constraint_names[worst]}: its least "
        f"value found in the bounds is {least:.4g}, and it is met where it is 0 or less"
    )


def _hardware(problem: CoDesignProblem, theta: ca.MX) -> tuple[ca.MX, ca.MX]:
    """f, and λ in shares of its size."""
    f, lam = plant_of(problem).hardware(theta)
    return f, lam / ca.DM(constraint_sizes(problem)) if lam.numel() else lam


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
    none for direct; `agreed` is whether prediction and truth met the tolerance at the end.
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
    """List the quantities that `surrogates` predict, in their order, with units; ln of ratios, and
    of m/N."""
    ratios = {"ln_sensitivity_peak": "1", "ln_sensitivity_low": "1"}
    return {figure.key: figure.si_unit, **ratios, "ln_compliance": "ln(m/N)"}


# What a formulation may begin with in place of its own plan: samples at θ, or at (θ, ω_S, ω_T).
KnownSamples = Sequence[InnerSample | QuantitySample]


@dataclass(frozen=True)
class RunTerms:
    """The formulation, relative tolerance and seed of a run; `began` on the clock of
    `perf_counter`."""

    formulation: str
    tolerance: float
    seed: int
    began: float = field(default_factory=perf_counter)


@dataclass(frozen=True)
class GlobalCheck:
    """A check over the box: true inner problems at `points` θ, `feasible` of these with a design.

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
        """The entry of result.json."""
        return {key: value for key, value in vars(self).items() if key != "x"} | {
            "moved": self.moved
        }
