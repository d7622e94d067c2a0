"""The trade-off of weight against bandwidth: the largest true ω_b at each hardware cost.

    max ω_b*(θ)   s.t.  f(θ) = f_k,  θ_min <= θ <= θ_max,  λ(θ) <= 0,     k = 1 … N

An equation, not a bound: where lighter is also faster, the curve shows by how much. IPOPT walks
it on surrogates (`front_learners`), each point started from its neighbour's; the true inner problem
answers at every θ, and its designs teach the surrogates until both agree. The two ends are found
anew in every round, and the curve goes through a design that is known already, or above it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ccd_casadi.codesign.front_learners import Learner
from ccd_casadi.codesign.outer_problem import NonlinearProgram, OuterFailure, solve_program
from ccd_casadi.codesign.sections_entries import bound_words
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from surrogates import design

STARTS = 6  # of IPOPT at every point, besides its neighbours' optima
FLAT = 1e-9  # relative: a hardware cost that moves less over the box is constant
ROUNDS = 8
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
    learner: Learner,
    *,
    points: int = 20,
    tolerance: float = 1e-3,
    seed: int = 0,
    own: Array | None = None,
) -> Front:
    """The front by `points` costs, evenly spaced from the lightest to the fastest design.

    Where the lightest is the fastest there is no trade-off, and the costs go on to the largest.

    `own`, a design (θ, and what else the learner's surrogates depend on) known to be good, is a
    point of the front unless a faster one is found at its cost. What is slower than a lighter point
    is solved again from there; an end that stays so is dropped. Raises UserError where the hardware
    cost is constant, or where too few designs are certified to learn from.
    """
    sampler, problem = learner.sampler, learner.sampler.problem
    lower, upper = learner.bounds
    if own is not None:
        own = np.clip(own, lower, upper)
    learner.begin(own)
    starts = design("sobol", lower, upper, STARTS, seed + 1)
    if own is not None:
        starts = np.vstack([own, starts])
    ends, trades = ends_of(learner.program(), problem, starts)
    count = len(problem.names)
    f_low, f_high = (hardware_cost(plant_of(problem), x[:count]) for x in ends)
    if own is not None:  # the true optimum may lie beyond what the first surrogates expect
        f_own = hardware_cost(plant_of(problem), own[:count])
        f_low, f_high = min(f_low, f_own), max(f_high, f_own)
    if not f_high - f_low > FLAT * max(abs(f_low), abs(f_high)):
        raise UserError("hardware_cost is the same all over the box: there is nothing to trade")
    costs = np.linspace(f_low, f_high, points)
    todo = list(range(points))
    x = np.linspace(ends[0], ends[1], points)
    through = None
    if own is not None:
        through = int(np.argmin(np.abs(costs - f_own)))
        costs[through], x[through] = f_own, own
    result: dict[int, FrontPoint] = {}

    def move_ends(free: list[int]) -> None:
        """Put the ends that are not verified where the surrogates see them by now."""
        if not {0, points - 1} & set(free):
            return
        try:
            ends, _ = ends_of(learner.program(), problem, starts)
        except UserError:
            return
        for k, end in ((0, ends[0]), (points - 1, ends[1])):
            if k in free:
                x[k], costs[k] = end, hardware_cost(plant_of(problem), end[:count])

    def solve_again(k: int, faster: FrontPoint) -> None:
        """Point k from a lighter and faster one: kept where the truth is faster than before.

        A design that was not predicted takes no verified one's place for less than the `tolerance`.
        """
        begin = learner.point(sampler.bandwidths(np.array(faster.theta))[0])
        try:
            at = solve_program(_at_cost(learner.program(), problem, costs[k]), begin).best.x
        except OuterFailure:
            return
        sample = sampler.bandwidths(at[:count], "from a lighter point")[0]
        if sample.feasible and not result[k].bandwidth >= sample.bandwidth:
            new, old = front_point(problem, sample, learner.predicted(at), tolerance), result[k]
            gained = not new.bandwidth <= (1.0 + tolerance) * old.bandwidth
            if new.verified or gained or not old.verified:
                result[k] = new

    rounds = 0
    while todo and rounds < ROUNDS:
        rounds += 1
        if rounds > 1:
            move_ends([k for k in todo if k != through])
        x = walk(learner.program(), problem, costs, todo, starts, x)
        inner = sampler.bandwidths(x[todo, :count], f"verifying round {rounds}")
        for k, sample in zip(todo, inner, strict=True):
            result[k] = front_point(problem, sample, learner.predicted(x[k]), tolerance)
        missed = [i for i, k in enumerate(todo) if not result[k].verified]
        rows, todo = x[todo][missed], [todo[i] for i in missed]
        if todo and rounds < ROUNDS:
            learner.learn(rows, [inner[i] for i in missed])
    if through is not None:
        assert own is not None
        sample = sampler.bandwidths(own[:count], "the run's own design")[0]
        if sample.feasible and not result[through].bandwidth >= sample.bandwidth:
            result[through] = front_point(problem, sample, learner.predicted(own), tolerance)
    for k in range(1, points):
        lighter = [result[i] for i in range(k) if result[i].bandwidth > result[k].bandwidth]
        if lighter:
            solve_again(k, max(lighter, key=lambda point: point.bandwidth))
    kept = sorted(result.values(), key=lambda point: point.hardware_cost)
    while trades and len(kept) > 1 and not kept[-1].bandwidth >= kept[-2].bandwidth:
        kept.pop()  # the fastest design is not there
    return Front(efficient(kept), rounds, sampler.syntheses)


def walk(
    program: NonlinearProgram,
    problem: CoDesignProblem,
    costs: Array,
    todo: Sequence[int],
    starts: Array,
    x: Array,
) -> Array:
    """The program's optimum at each cost of `todo`, from both neighbours' optima and `starts`."""
    x = x.copy()
    last = len(costs) - 1
    for k in todo:
        there = _at_cost(program, problem, costs[k])
        tries = np.vstack([x[k], x[max(k - 1, 0)], x[min(k + 1, last)], starts])
        try:
            best = solve_program(there, tries).best.x
        except OuterFailure:
            continue  # the truth is asked where it stands, and teaches the surrogates
        x[k] = best
    return x


def _at_cost(program: NonlinearProgram, problem: CoDesignProblem, cost: float) -> NonlinearProgram:
    f = plant_of(problem).hardware(program.x[: len(problem.names)])[0]
    lower = np.append(np.full(program.g.shape[0], -np.inf), 0.0)
    return replace(program, g=ca.vertcat(program.g, f / cost - 1.0), g_lower=lower)


def ends_of(
    program: NonlinearProgram, problem: CoDesignProblem, starts: Array
) -> tuple[list[Array], bool]:
    """The lightest and the fastest predicted feasible design; where these are one, the heaviest.

    Second, whether they are two. Raises UserError where IPOPT finds none.
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
    count = len(problem.names)
    costs = [hardware_cost(plant_of(problem), x[:count]) for x in (light, fast, heavy)]
    trades = costs[1] - costs[0] > DOMINATED * (costs[2] - costs[0])
    return [light, fast if trades else heavy], trades


def front_point(
    problem: CoDesignProblem, sample: BandwidthSample, predicted: float, tolerance: float
) -> FrontPoint:
    """A true inner problem as a point of the front, and whether it was predicted."""
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
        active=tuple(bound_words(sample.active)) if sample.kappa else sample.active,
        verified=not reason,
        reason=reason,
    )


def efficient(points: Sequence[FrontPoint]) -> tuple[FrontPoint, ...]:
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
