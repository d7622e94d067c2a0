"""How the optimum of a co-design with sections answers to what was given; see `post_optimal`."""


from collections.abc import Mapping

import numpy as np

from ccd_casadi.codesign.post_optimal import WEAK, PostOptimal, Response
from ccd_casadi.codesign.theta_kkt import theta_kkt
from ccd_casadi.fixed_structure.bounds import kind_and_channel
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.sections_bandwidth import SectionsValue
from ccd_casadi.inner_problem.sections_plant_set import bounds_of, sections_of_problem
from ccd_casadi.plants.plant import hardware_cost, hardware_slopes
from ccd_casadi.sampling.samples import BandwidthSample


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
    kkt = theta_kkt(problem, sample, envelope=found.envelope)
    loop = found.design.multipliers if kkt.kink is None else kkt.kink.multipliers
    size = float(np.abs(kkt.objective_gradient).max())
    strong = [name for name in kkt.active if kkt.multipliers.get(name, 0.0) > WEAK * size]
    bound = [name for name in strong if name not in plant.constraint_names]
    vertex = len(bound) == len(names) == len(strong)
    slope_f = hardware_slopes(plant, theta)[0]
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
