"""How the optimum answers to what was given: S_max, S_low, λ <= 0, every bound, w1 and w2.

At a design that satisfies the optimality conditions of the true problem

    L(x, μ) = J(x) + Σ μ_i g_i(x),    ∇L = 0,   g_A = 0,

the implicit function theorem gives, for a parameter p of the case,

    [∇²L  Aᵀ] [dx/dp]     [∂∇L/∂p]
    [ A   0 ] [dμ/dp] = - [∂g_A/∂p],     dJ*/dp = ∂L/∂p

(Fiacco 1976). ∇²L comes from differences of the true total derivatives. It holds as long as the
constraints with positive multipliers stay the ones that bind.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import null_space

from ccd_casadi.codesign.kkt import active_at, kkt_certificate, lagrangian_hessian
from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.codesign.peak_constraints import OTHER_PEAK, other_peaks
from ccd_casadi.codesign.theta_kkt import theta_kkt
from ccd_casadi.fixed_structure.bounds import kind_and_channel
from ccd_casadi.inner_problem.figure import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import StructuredValue
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structured_of
from ccd_casadi.inner_problem.true_function import TrueQuantities
from ccd_casadi.optim.kkt import ACTIVE, KktCertificate
from ccd_casadi.plants.plant import hardware_cost, hardware_slopes
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.progress import Progress
from ccd_casadi.synthesis.derivatives import Sensitivities

WEAK = 1e-6  # a multiplier below this share of ‖∇J‖∞ holds nothing


@dataclass(frozen=True)
class Response:
    """Derivatives of the optimum to one parameter of the case, per unit of it.

    Of J*, ω_b (rad/s), f, θ and (ln ω_S, ln ω_T). `value` is the parameter's own; bounds on ω_S
    and ω_T count in rad/s.
    """

    parameter: str
    value: float
    objective: float
    bandwidth: float
    hardware_cost: float
    theta: tuple[float, ...]
    ln_omega: tuple[float, ...]


@dataclass(frozen=True)
class PostOptimal:
    """The responses, the certificate that they rest on, and whether they are determined.

    `weak` names what touches without a multiplier: across it a response is one-sided. Where
    `determined` is False (dependent constraints, no second-order minimum) only dJ*/dp is given.
    """

    responses: tuple[Response, ...]
    kkt: KktCertificate
    weak: tuple[str, ...]
    determined: bool


@dataclass(frozen=True)
class _Parameter:
    """∂∇J/∂p (n, unit box), ∂g/∂p by constraint, and ∂J/∂p at a fixed x."""

    name: str
    value: float
    gradient: Array
    levels: Mapping[str, float] = field(default_factory=dict)
    cost: float = 0.0


def post_optimal(problem: CoDesignProblem, x: Array, quiet: bool = True) -> PostOptimal:
    """Responses at an optimum x = (θ, ln ω_S, ln ω_T) of the true problem.

    Costs 2n true syntheses for n variables, none where the constraints alone determine x.
    """
    quantities = TrueQuantities(problem)
    design = quantities.at(x)
    n = x.size
    kkt = kkt_certificate(problem, x, design)
    size = float(np.abs(kkt.objective_gradient).max())
    strong = [name for name in kkt.active if kkt.multipliers[name] > WEAK * size]
    here = active_at(problem, x, design)
    kinked = not set(strong) <= set(here.labels)
    if kinked:  # where local peaks are equal, each is a constraint
        here = active_at(problem, x, design, other_peaks(problem, x, design, ACTIVE))
    held = [here.labels.index(name) for name in strong]
    A = here.rows[held] * here.sizes[held, None]
    Z = null_space(A) if len(A) else np.eye(n)
    determined = Z.shape[1] == n - len(A)
    H = np.zeros((n, n))
    if Z.shape[1] and kinked:
        determined = False  # the second derivatives of each peak are not known
    elif Z.shape[1]:
        with Progress(2 * n, "second derivatives", quiet=quiet) as progress:

            def at(point: Array) -> Sensitivities:
                progress.advance()
                return quantities.at(point)

            columns = lagrangian_hessian(problem, x, np.eye(n), kkt.multipliers, at)
        H = np.full((n, n), np.nan) if columns is None else 0.5 * (columns + columns.T)
        reduced = Z.T @ H @ Z
        determined &= bool(np.isfinite(H).all() and np.linalg.eigvalsh(reduced).min() > 0.0)
    lower, upper = lifted_bounds(problem)
    slope_b = np.hstack([design.to_theta[0], design.to_break_frequencies[0]]) * (upper - lower)
    to_theta = hardware_slopes(plant_of(problem), x[:-2])[0]
    slope_f = np.append(to_theta, [0.0, 0.0]) * (upper - lower)  # ω_S and ω_T cost nothing
    system = np.block([[H, A.T], [A, np.zeros((len(A), len(A)))]])
    responses = []
    for parameter in _parameters(problem, x, design.values[0], slope_f, slope_b):
        dz = np.full(n, np.nan)
        if determined:
            level = [_level(parameter, name) for name in strong]
            dz = np.linalg.solve(system, -np.concatenate([parameter.gradient, level]))[:n]
        dx = dz * (upper - lower)
        change = sum(mu * _level(parameter, name) for name, mu in kkt.multipliers.items())
        responses.append(
            Response(
                parameter=parameter.name,
                value=parameter.value,
                objective=float(parameter.cost + change),
                bandwidth=float(slope_b @ dz),
                hardware_cost=float(slope_f @ dz),
                theta=tuple(map(float, dx[:-2])),
                ln_omega=tuple(map(float, dx[-2:])),
            )
        )
    weak = tuple(name for name in kkt.active if name not in strong)
    return PostOptimal(tuple(responses), kkt, weak, determined)


def _level(parameter: _Parameter, constraint: str) -> float:
    """∂g/∂p of a constraint; a peak besides the largest moves with S_max as that one does."""
    name = "S_max" if constraint.startswith(OTHER_PEAK) else constraint
    return parameter.levels.get(name, 0.0)


def _parameters(
    problem: CoDesignProblem, x: Array, bandwidth: float, slope_f: Array, slope_b: Array
) -> Iterator[_Parameter]:
    """w1, w2, the inner problem's bounds, the level of each λ, and the bounds of θ, ω_S, ω_T."""
    none = np.zeros(x.size)
    cost = hardware_cost(plant_of(problem), x[:-2])
    yield _Parameter("w1", problem.w1, slope_f, cost=cost)
    yield _Parameter("w2", problem.w2, slope_b, cost=float(bandwidth))
    for name, (_, bound) in problem.inner.bounds.items():
        yield _Parameter(name, bound, none, {name: -1.0 / bound})
    for name in plant_of(problem).constraint_names:
        yield _Parameter(f"{name} <= 0", 0.0, none, {name: -1.0})
    lower, upper = lifted_bounds(problem)
    for i, name in enumerate((*problem.names, "omega_S", "omega_T")):
        for end, bound, sign in (("lower", lower[i], 1.0), ("upper", upper[i], -1.0)):
            value = float(np.exp(bound)) if i >= x.size - 2 else float(bound)
            unit = value if i >= x.size - 2 else 1.0  # d ln ω = dω/ω
            slope = sign / (unit * (upper[i] - lower[i]))
            yield _Parameter(f"{name} {end}", value, none, {f"{name} {end}": slope})


def structured_responses(
    problem: CoDesignProblem, sample: BandwidthSample, found: StructuredValue
) -> PostOptimal:
    """Derivatives of the optimum to w1, w2, the bounds on the loop, λ <= 0 and the bounds of θ.

        dJ*/dp = ∂L/∂p,   with the bounds on the loop dω_b*/dp = ω_b μ/p

    Of an error or a move time those to the bounds on the loop, and how ω_b moves, are not known.

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
        response("w2", problem.w2, sample.value, 0.0),
    ]
    known = problem.figure is BANDWIDTH
    for name, value, mu in _loop_bounds(problem, loop) if known else ():
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
            rate = rate if known or which is None else np.nan
            answers.append(response(label, value, sign * mu / width[i], rate, which))
    weak = tuple(name for name in kkt.active if name not in strong)
    return PostOptimal(tuple(answers), kkt, weak, vertex)


def _loop_bounds(
    problem: CoDesignProblem, mu: Mapping[str, float]
) -> list[tuple[str, float, float]]:
    """Bounds on the loop that the case gives: name, value, and d ln ω_b/d ln of it."""
    structured = structured_of(problem)
    effort = sum(value for name, value in mu.items() if kind_and_channel(name)[0] == "KS")
    rows = [
        ("S_max", problem.inner.S_max, mu.get("S_MAX", 0.0)),
        ("S_low", problem.inner.S_low, mu.get("S_LOW", 0.0)),
        ("shape", structured.shape, mu.get("SHAPE", 0.0)),
        ("weighted_level", structured.weighted_level, effort + mu.get("T", 0.0)),
        ("compliance_max", structured.compliance_max, mu.get("GS", 0.0)),
    ]
    for own in bounds_of(problem).channels:
        rows += [
            (f"S_max of channel {own.name}", own.S_max, mu.get(f"S_MAX of {own.name}", 0.0)),
            (f"M_K of channel {own.name}", own.M_K, mu.get(f"KS of {own.name}", 0.0)),
        ]
    return [(name, float(value), m) for name, value, m in rows if value is not None]
