"""The trade-off of weight against bandwidth: the largest true ω_b at each hardware cost.

    max ω_b*(θ)   s.t.  f(θ) = f_k,  θ_min <= θ <= θ_max,  λ(θ) <= 0,     k = 1 … N

An equation, not a bound: where lighter is also faster, the curve shows by how much. IPOPT walks
it on the lifted surrogates, each point started from its neighbour's; the true inner problem
answers at every θ, and its designs teach the surrogates until both agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ccd_casadi.codesign.lifted import MARGIN, REFIT, fit_quantities, update_quantities
from ccd_casadi.codesign.outer_problem import (
    NonlinearProgram,
    OuterFailure,
    lifted_bounds,
    lifted_program,
    solve_program,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.sampler import BandwidthSample, Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from surrogates import GaussianProcess, design, to_casadi

STARTS = 6  # of IPOPT at every point, besides its neighbours' optima
FLAT = 1e-9  # relative: a hardware cost that moves less over the box is constant
DOMINATED = 1e-3  # of the costs' range: closer to the lightest, the fastest is the same design


@dataclass(frozen=True)
class FrontPoint:
    """One cost and the fastest true design there; bandwidths in rad/s, NaN where infeasible.

    `verified`: the true inner problem at θ is solved by a certified design, and what the surrogate
    promised is met within the tolerance. `efficient`: no other point is as light and as fast.
    """

    theta: tuple[float, ...]
    hardware_cost: float
    bandwidth: float
    predicted: float
    omega_S: float
    omega_T: float
    active: tuple[str, ...]
    verified: bool
    reason: str
    efficient: bool = False


@dataclass(frozen=True)
class Front:
    """The points in order of their cost, and the rounds that prediction and truth took to agree."""

    points: tuple[FrontPoint, ...]
    rounds: int
    syntheses: int


def pareto_front(
    sampler: Sampler,
    *,
    points: int = 20,
    samples: int = 0,
    tolerance: float = 1e-3,
    max_rounds: int = 8,
    seed: int = 0,
) -> Front:
    """The front by `points` costs, evenly spaced from the lightest to the fastest design.

    Where the lightest is the fastest there is no trade-off, and the costs go on to the largest.

    `samples` designs are sampled first (0: six per variable). Raises UserError where the
    hardware cost is constant, or where too few designs are certified to learn from.
    """
    problem = sampler.problem
    lower, upper = lifted_bounds(problem)
    count = samples or 6 * len(lower)
    found = sampler.quantities(design("sobol", lower, upper, count, seed))
    known = [sample for sample in found if sample.certified]
    if len(known) <= len(lower):
        words = f"only {len(known)} of {count} designs in the box were certified"
        raise UserError(f"no trade-off can be learnt: {words}; widen the bounds")
    processes, fitted = fit_quantities(problem, known, seed), len(known)
    program = _program(problem, processes)
    starts = design("sobol", lower, upper, STARTS, seed + 1)
    ends = _ends(program, problem, starts)
    f_low, f_high = (hardware_cost(plant_of(problem), x[:-2]) for x in ends)
    if not f_high - f_low > FLAT * max(abs(f_low), abs(f_high)):
        raise UserError("hardware_cost is the same all over the box: there is nothing to trade")
    costs = np.linspace(f_low, f_high, points)
    todo = list(range(points))
    x = np.linspace(ends[0], ends[1], points)
    result: dict[int, FrontPoint] = {}
    rounds = 0
    while todo and rounds < max_rounds:
        rounds += 1
        x = _walk(program, problem, costs, todo, starts, x)
        learn = []
        inner = sampler.bandwidths(x[todo, :-2], f"verifying round {rounds}")
        for k, sample in zip(todo, inner, strict=True):
            predicted = float(processes[0].predict(x[k][None, :])[0])
            result[k] = _point(problem, sample, predicted, tolerance)
            if not result[k].verified:
                learn.append(x[k])
        todo = [k for k in todo if not result[k].verified]
        if todo and rounds < max_rounds:
            new = [s for s in sampler.quantities(np.array(learn), "learning") if s.certified]
            known = list({sample.x: sample for sample in (*known, *new)}.values())
            if len(known) >= REFIT * fitted:
                processes, fitted = fit_quantities(problem, known, seed), len(known)
            else:
                processes = update_quantities(problem, known, processes)
            program = _program(problem, processes)
    return Front(_efficient([result[k] for k in range(points)]), rounds, sampler.syntheses)


def _program(problem: CoDesignProblem, processes: tuple[GaussianProcess, ...]) -> NonlinearProgram:
    return lifted_program(problem, to_casadi(processes, std=False), margin=MARGIN)


def _walk(
    program: NonlinearProgram,
    problem: CoDesignProblem,
    costs: Array,
    todo: Sequence[int],
    starts: Array,
    x: Array,
) -> Array:
    """The program's optimum at each cost of `todo`, from the neighbours' optima and `starts`.

    At the two ends θ stands: there is no freedom left but ω_S and ω_T.
    """
    x = x.copy()
    for k in todo:
        end = k in (0, len(costs) - 1)
        there = _at_theta(program, x[k][:-2]) if end else _at_cost(program, problem, costs[k])
        tries = np.vstack([x[k], x[max(k - 1, 0)], starts])
        try:
            best = solve_program(there, tries[:, -2:] if end else tries).best.x
        except OuterFailure:
            continue  # the truth is asked where it stands, and teaches the surrogates
        x[k, -len(best) :] = best
    return x


def _at_cost(program: NonlinearProgram, problem: CoDesignProblem, cost: float) -> NonlinearProgram:
    f = plant_of(problem).hardware(program.x[: len(problem.names)])[0]
    lower = np.append(np.full(program.g.shape[0], -np.inf), 0.0)
    return replace(program, g=ca.vertcat(program.g, f / cost - 1.0), g_lower=lower)


def _at_theta(program: NonlinearProgram, theta: Array) -> NonlinearProgram:
    omega = ca.MX.sym("omega", 2)
    x = ca.vertcat(ca.DM(theta), omega)
    f, g = ca.substitute([program.f, program.g], [program.x], [x])
    lower, upper, variables = program.lower[-2:], program.upper[-2:], program.variables[-2:]
    return replace(program, x=omega, f=f, g=g, lower=lower, upper=upper, variables=variables)


def _ends(program: NonlinearProgram, problem: CoDesignProblem, starts: Array) -> list[Array]:
    """The lightest and the fastest predicted feasible design; where these are one, the heaviest.

    Raises UserError where IPOPT finds none.
    """
    f = plant_of(problem).hardware(program.x[: len(problem.names)])[0]
    bandwidth = (program.f - problem.w1 * f) / problem.w2
    try:
        light, fast, heavy = (
            solve_program(replace(program, f=part), starts).best.x for part in (f, -bandwidth, -f)
        )
    except OuterFailure as error:
        words = "no design in the box is predicted to meet the constraints; widen the bounds"
        raise UserError(f"no trade-off: {words} ({error})") from None
    costs = [hardware_cost(plant_of(problem), x[:-2]) for x in (light, fast, heavy)]
    trades = costs[1] - costs[0] > DOMINATED * (costs[2] - costs[0])
    return [light, fast if trades else heavy]


def _point(
    problem: CoDesignProblem, sample: BandwidthSample, predicted: float, tolerance: float
) -> FrontPoint:
    error = abs(predicted / sample.bandwidth - 1.0)
    reason = ""
    if not sample.feasible:
        reason = sample.shortfall
    elif not error <= tolerance:
        reason = f"prediction and truth differ by {100.0 * error:.2g} %"
    return FrontPoint(
        theta=sample.theta,
        hardware_cost=hardware_cost(plant_of(problem), sample.theta),
        bandwidth=sample.bandwidth,
        predicted=predicted,
        omega_S=sample.omega_S,
        omega_T=sample.omega_T,
        active=sample.active,
        verified=not reason,
        reason=reason,
    )


def _efficient(points: Sequence[FrontPoint]) -> tuple[FrontPoint, ...]:
    """Mark what no other feasible point beats in cost or bandwidth without losing in the other."""

    def beaten(point: FrontPoint) -> bool:
        return any(
            other.hardware_cost <= point.hardware_cost
            and other.bandwidth >= point.bandwidth
            and (other.hardware_cost, other.bandwidth) != (point.hardware_cost, point.bandwidth)
            for other in points
        )

    return tuple(
        replace(point, efficient=bool(np.isfinite(point.bandwidth)) and not beaten(point))
        for point in points
    )
