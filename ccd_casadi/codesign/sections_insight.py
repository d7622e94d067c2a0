"""The trade-off and the responses of a co-design with a controller of fixed structure.

    max ω_b*(θ)   s.t.  f(θ) = f_k,  θ_min <= θ <= θ_max,  λ(θ) <= 0,     k = 1 … N

IPOPT walks it on a Gaussian process of ω_b*(θ) with its envelope gradients; the true ω_b*(θ) of the
run's anchors answers at every θ, and teaches the process until both agree.
"""

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from ccd_casadi.codesign.nested import fit_bandwidth
from ccd_casadi.codesign.outer_problem import NonlinearProgram, nested_program
from ccd_casadi.codesign.pareto import FLAT, STARTS, Front, efficient, ends_of, front_point, walk
from ccd_casadi.codesign.post_optimal import WEAK, PostOptimal, Response
from ccd_casadi.codesign.sections_kkt import sections_kkt
from ccd_casadi.codesign.stored import stored_thetas
from ccd_casadi.fixed_structure.bounds import kind_and_channel
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.sections_bandwidth import SectionsValue
from ccd_casadi.inner_problem.sections_plant_set import bounds_of, sections_of_problem
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from surrogates import GaussianProcess, design, to_casadi


def sections_front(
    sampler: Sampler,
    *,
    own: Array,
    points: int = 20,
    tolerance: float = 1e-3,
    max_rounds: int = 6,
    seed: int = 0,
) -> Front:
    """The front by `points` costs, from the lightest to the fastest design; `own` is one of them.

    Starts from what the store holds of the problem, and six samples per parameter over the box.
    Raises UserError where the hardware cost is constant, or too few designs are certified.
    """
    problem = sampler.problem
    lower, upper = box(problem)
    plan = design("sobol", lower, upper, 6 * len(lower), seed)
    thetas = np.vstack([own[None], stored_thetas(sampler.store, problem), plan])
    known = _certified(sampler.bandwidths(np.unique(thetas, axis=0)))
    if len(known) <= len(lower):
        words = f"only {len(known)} of {len(thetas)} designs in the box were certified"
        raise UserError(f"no trade-off can be learnt: {words}; widen the bounds")
    process, program = _learnt(problem, known, seed)
    starts = np.vstack([own, design("sobol", lower, upper, STARTS, seed + 1)])
    ends, _ = ends_of(program, problem, starts)
    f_own = hardware_cost(plant_of(problem), own)
    f_ends = [hardware_cost(plant_of(problem), end) for end in ends]
    low, high = min(*f_ends, f_own), max(*f_ends, f_own)
    if not high - low > FLAT * max(abs(low), abs(high)):
        raise UserError("hardware_cost is the same all over the box: there is nothing to trade")
    costs, x = np.linspace(low, high, points), np.linspace(ends[0], ends[1], points)
    through = int(np.argmin(np.abs(costs - f_own)))
    costs[through], x[through] = f_own, own
    todo, result, rounds = list(range(points)), {}, 0
    while todo and rounds < max_rounds:
        rounds += 1
        x = walk(program, problem, costs, todo, starts, x)
        found = sampler.bandwidths(x[todo], f"verifying round {rounds}")
        for k, sample in zip(todo, found, strict=True):
            promised = float(process.predict(x[k][None, :])[0])
            result[k] = front_point(problem, sample, promised, tolerance)
        known = list({s.theta: s for s in (*known, *_certified(found))}.values())
        todo = [k for k in todo if not result[k].verified]
        if todo:
            process, program = _learnt(problem, known, seed)
    own_sample = sampler.bandwidths(own, "the run's own design")[0]
    if own_sample.feasible and not result[through].bandwidth >= own_sample.bandwidth:
        promised = float(process.predict(own[None, :])[0])
        result[through] = front_point(problem, own_sample, promised, tolerance)
    kept = sorted(result.values(), key=lambda point: point.hardware_cost)
    return Front(efficient(kept), rounds, sampler.syntheses)


def _certified(samples: Sequence[BandwidthSample]) -> list[BandwidthSample]:
    """Those with a certified design, each θ once."""
    return list({s.theta: s for s in samples if s.feasible}.values())


def _learnt(
    problem: CoDesignProblem, known: list[BandwidthSample], seed: int
) -> tuple[GaussianProcess, NonlinearProgram]:
    process = fit_bandwidth(problem, known, seed, gradients=True)
    return process, nested_program(problem, to_casadi(process, std=False))


def sections_responses(
    problem: CoDesignProblem, sample: BandwidthSample, found: SectionsValue
) -> PostOptimal:
    """Derivatives of the optimum to w1, w2, the bounds on the loop, λ <= 0 and the bounds of θ.

        dJ*/dp = ∂L/∂p,   with the bounds on the loop dω_b*/dp = ω_b μ/p

    How θ and ω_b move is given where the bounds on θ and λ alone determine θ (a vertex); elsewhere
    it takes second derivatives of ω_b*, which are not known. At a kink of ω_b* the multipliers μ
    are those of θ and controller together.
    """
    theta, names = np.array(sample.theta), problem.names
    plant, width = plant_of(problem), np.subtract(problem.upper, problem.lower)
    kkt = sections_kkt(problem, sample, envelope=found.envelope)
    loop = found.design.multipliers if kkt.kink is None else kkt.kink.multipliers
    size = float(np.abs(kkt.objective_gradient).max())
    strong = [name for name in kkt.active if kkt.multipliers.get(name, 0.0) > WEAK * size]
    bound = [name for name in strong if name not in plant.constraint_names]
    vertex = len(bound) == len(names) == len(strong)
    symbol = ca.MX.sym("theta", len(names))
    f = plant.hardware(symbol)[0]
    slope_f = np.array(ca.Function("f", [symbol], [ca.jacobian(f, symbol)])(theta)).ravel()
    still = (0.0,) * len(names)
    unknown = (float("nan"),) * len(names)

    def response(
        name: str, value: float, J: float, bandwidth: float, i: int | None = None
    ) -> Response:
        """`i`: the θ that moves with the parameter, one to one."""
        if not vertex:
            nan = float("nan")
            return Response(name, value, J, nan, nan, unknown, ())
        moved = still if i is None else tuple(map(float, np.eye(len(names))[i]))
        cost = 0.0 if i is None else float(slope_f[i])
        return Response(name, value, J, bandwidth, cost, moved, ())

    answers = [
        response("w1", problem.w1, hardware_cost(plant, theta), 0.0),
        response("w2", problem.w2, sample.bandwidth, 0.0),
    ]
    for name, value, mu in _loop_bounds(problem, loop):
        rate = sample.bandwidth * mu / value
        answers.append(response(name, value, problem.w2 * rate, rate))
    for name in plant.constraint_names:
        answers.append(response(f"{name} <= 0", 0.0, -kkt.multipliers.get(name, 0.0), 0.0))
    for i, name in enumerate(names):
        ends = (("lower", problem.lower[i], 1.0), ("upper", problem.upper[i], -1.0))
        for end, value, sign in ends:
            label = f"{name} {end}"
            mu = kkt.multipliers.get(label, 0.0)
            rate, which = (sample.gradient[i], i) if label in strong else (0.0, None)
            answers.append(response(label, value, sign * mu / width[i], rate, which))
    weak = tuple(name for name in kkt.active if name not in strong)
    return PostOptimal(tuple(answers), kkt, weak, vertex)


def _loop_bounds(
    problem: CoDesignProblem, mu: Mapping[str, float]
) -> list[tuple[str, float, float]]:
    """Bounds on the loop that the case gives: name, value, and d ln ω_b/d ln of it."""
    sections = sections_of_problem(problem)
    effort = sum(value for name, value in mu.items() if kind_and_channel(name)[0] == "KS")
    rows = [
        ("S_max", problem.inner.S_max, mu.get("S_MAX", 0.0)),
        ("S_low", problem.inner.S_low, mu.get("S_LOW", 0.0)),
        ("shape", sections.shape, mu.get("SHAPE", 0.0)),
        ("weighted_level", sections.weighted_level, effort + mu.get("T", 0.0)),
        ("compliance_max", sections.compliance_max, mu.get("GS", 0.0)),
    ]
    for own in bounds_of(problem).channels:
        rows += [
            (f"S_max of channel {own.name}", own.S_max, mu.get(f"S_MAX of {own.name}", 0.0)),
            (f"M_K of channel {own.name}", own.M_K, mu.get(f"KS of {own.name}", 0.0)),
        ]
    return [(name, float(value), m) for name, value, m in rows if value is not None]
