"""How the optimum answers to what was given: S_max, S_low, λ <= 0, every bound, w1 and w2.

At a design that satisfies the optimality conditions of the true problem

    L(x, μ) = J(x) + Σ μ_i g_i(x),    ∇L = 0,   g_A = 0,

the implicit function theorem gives, for a parameter p of the case,

    [∇²L  Aᵀ] [dx/dp]     [∂∇L/∂p]
    [ A   0 ] [dμ/dp] = - [∂g_A/∂p],     dJ*/dp = ∂L/∂p

(Fiacco 1976). ∇²L comes from differences of the true total derivatives. It holds as long as the
constraints with positive multipliers stay the ones that bind.

A bound p has g = S/p - 1 or g = (p - x)/width, whose ∂∇g/∂p is a multiple of ∇g: it changes dμ/dp
alone, and is left out of ∂∇L/∂p. Where A alone determines x, ∇²L is not needed. x is in shares of
the box (z), as are all gradients here.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import null_space

from ccd_casadi.codesign.optimality import (
    OTHER_PEAK,
    TrueDesign,
    active_at,
    active_theta,
    lagrangian_hessian,
    other_peaks,
    theta_kkt,
)
from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.fixed_structure.bounds import kind_and_channel
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.objective import TrueQuantities
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import StructuredValue
from ccd_casadi.inner_problem.structured_plant_set import bounds_of
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.optim.kkt import ActiveSet, KktCertificate, KktOptions
from ccd_casadi.optim.pieces import Box
from ccd_casadi.plants.plant import hardware_cost, hardware_slopes
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.terminal import Progress


@dataclass(frozen=True)
class OptimumResponse:
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
    """The response of an optimum to the parameters of its case.

    Attributes
    ----------
    responses : tuple of OptimumResponse
        Derivatives, one per parameter.
    kkt : KktCertificate
        Of the optimality conditions on which they rest.
    weak : tuple of str
        What binds without a multiplier: across it a response is one-sided.
    determined : bool
        False with dependent constraints or without a second-order minimum: then only dJ*/dp is
        given.
    """

    responses: tuple[OptimumResponse, ...]
    kkt: KktCertificate
    weak: tuple[str, ...]
    determined: bool


@dataclass(frozen=True)
class _Parameter:
    """A parameter p of the case.

    Attributes
    ----------
    name, value : str, float
    gradient : array (n,)
        ∂∇J/∂p.
    levels : mapping
        ∂g/∂p by constraint.
    cost, bandwidth : float
        ∂J/∂p and ∂ω_b/∂p at a fixed x.
    """

    name: str
    value: float
    gradient: Array
    levels: Mapping[str, float] = field(default_factory=dict)
    cost: float = 0.0
    bandwidth: float = 0.0


def post_optimal(problem: CoDesignProblem, x: Array, quiet: bool = True) -> PostOptimal:
    """Responses at an optimum x = (θ, ln ω_S, ln ω_T) of the true problem.

    Costs 2n true syntheses for n variables, none where the constraints alone determine x.
    """
    at, n = TrueDesign(TrueQuantities(problem), x), x.size
    design, kkt, active = at.design, at.kkt, active_at(at)
    # where local peaks of |S| are equal, more of them bind than ‖S‖∞ alone: each is a constraint
    equal_peaks = not set(_strong(kkt)) <= set(active.labels)
    if equal_peaks:
        active = active_at(at, other_peaks(problem, x, design, KktOptions.active))

    def hessian() -> Array | None:
        if equal_peaks:
            return None  # the second derivatives of each peak are not known
        with Progress(1, f"{2 * n} second derivatives", quiet=quiet) as progress:
            found = lagrangian_hessian(at, np.eye(n), kkt.multipliers)
            progress.advance()
        return found

    bounds = lifted_bounds(problem)
    to_bandwidth = np.hstack([design.to_theta[0], design.to_break_frequencies[0]]) * bounds.width
    moved = {name: [name] for name in problem.inner.bounds}  # the constraints that a bound moves
    moved["S_max"] += [name for name in kkt.multipliers if name.startswith(OTHER_PEAK)]
    w2 = _Parameter("w2", problem.w2, to_bandwidth, cost=float(design.values[0]))
    own = [_Parameter(name, bound, np.zeros(n), dict.fromkeys(moved[name], -1.0 / bound))
           for name, (_, bound) in problem.inner.bounds.items()]  # fmt: skip
    return _responses(problem, x, bounds, kkt, active, hessian, [w2, *own], to_bandwidth)


def structured_responses(
    problem: CoDesignProblem, sample: InnerSample, found: StructuredValue
) -> PostOptimal:
    """The same over θ alone, of a controller of fixed structure.

    A bound p on the loop moves ω_b* of a fixed θ by dω_b*/dp = ω_b μ/p, μ = d ln ω_b/d ln p being
    the multiplier of the search, and J by w2 times that. Where the objective is an error or a move
    time, neither these nor how ω_b moves are known.

    How θ and ω_b move is given where the bounds on θ and λ alone determine θ (a vertex); elsewhere
    it takes second derivatives of v(θ), which are not known. At a kink of it the multipliers μ
    are those of θ and controller together.
    """
    bounds = box(problem)
    kkt = theta_kkt(problem, sample, envelope=found.envelope)
    mu = found.design.multipliers if kkt.kink is None else kkt.kink.multipliers
    to_value, of_bandwidth = np.array(sample.gradient) * bounds.width, problem.figure is BANDWIDTH
    parameters = [_Parameter("w2", problem.w2, to_value, cost=sample.value)]
    for name, value, rate in _loop_bounds(problem, mu) if of_bandwidth else ():
        change = sample.bandwidth * rate / value
        parameters.append(_Parameter(name, value, 0.0 * to_value, {}, problem.w2 * change, change))
    return _responses(
        problem, np.array(sample.theta), bounds, kkt, active_theta(problem, sample),
        lambda: None, parameters, to_value if of_bandwidth else np.nan * to_value,
    )  # fmt: skip


def _strong(kkt: KktCertificate, weak: float = 1e-6) -> list[str]:
    """Name what holds the design: a multiplier above this share of ‖∇J‖∞."""
    size = float(np.abs(kkt.objective_gradient).max())
    return [name for name in kkt.active if kkt.multipliers[name] > weak * size]


def _responses(
    problem: CoDesignProblem,
    x: Array,
    bounds: Box,
    kkt: KktCertificate,
    active: ActiveSet,
    hessian: Callable[[], Array | None],
    parameters: Sequence[_Parameter],
    to_bandwidth: Array,
) -> PostOptimal:
    """Responses at x within `bounds`, which begins with θ.

    `hessian` gives ∇²L, None where it is not known; it is called where the strong constraints leave
    directions Z free. `parameters` are w2 and the bounds on the loop; `to_bandwidth` (n,) is ∇ω_b,
    NaN where it is not known.
    """
    n, count, width = x.size, len(problem.names), bounds.width
    strong = _strong(kkt)
    held = [active.labels.index(name) for name in strong]
    A = active.rows[held] * active.sizes[held, None]
    Z = null_space(A)
    H = hessian() if Z.shape[1] else np.zeros((n, n))  # 0 where there is no direction for it
    independent = Z.shape[1] == n - len(A)
    determined = H is not None and independent
    if H is not None and Z.shape[1]:
        H = 0.5 * (H + H.T)
        determined &= bool(np.linalg.eigvalsh(Z.T @ H @ Z).min() > 0.0)
    system = np.block([[np.zeros((n, n)) if H is None else H, A.T], [A, np.zeros((len(A),) * 2)]])
    to_theta = hardware_slopes(plant_of(problem), x[:count])[0]
    to_hardware = np.pad(to_theta, (0, n - count)) * width  # ω_S and ω_T cost nothing
    responses = []
    for parameter in _parameters(problem, x, bounds, to_hardware, parameters):
        dz = np.full(n, np.nan)
        if determined:
            level = [parameter.levels.get(name, 0.0) for name in strong]
            dz = np.linalg.solve(system, -np.concatenate([parameter.gradient, level]))[:n]
        dx = tuple(map(float, dz * width))
        change = sum(kkt.multipliers.get(name, 0.0) * d for name, d in parameter.levels.items())
        by_move = to_bandwidth @ dz if dz.any() else 0.0  # also where ∇ω_b is not known
        responses.append(
            OptimumResponse(
                parameter=parameter.name,
                value=parameter.value,
                objective=float(parameter.cost + change),
                bandwidth=float(parameter.bandwidth + by_move),
                hardware_cost=float(to_hardware @ dz),
                theta=dx[:count],
                ln_omega=dx[count:],
            )
        )
    weak = tuple(name for name in kkt.active if name not in strong)
    return PostOptimal(tuple(responses), kkt, weak, determined)


def _parameters(
    problem: CoDesignProblem, x: Array, bounds: Box, to_hardware: Array,
    parameters: Sequence[_Parameter],
) -> Iterator[_Parameter]:  # fmt: skip
    """w1, `parameters` (w2, bounds on the loop), the level of each λ, and the bounds of x."""
    none, count, plant = np.zeros(x.size), len(problem.names), plant_of(problem)
    yield _Parameter("w1", problem.w1, to_hardware, cost=hardware_cost(plant, x[:count]))
    yield from parameters
    for name in plant.constraint_names:
        yield _Parameter(f"{name} <= 0", 0.0, none, {name: -1.0})
    names = (*problem.names, "omega_S", "omega_T")[: x.size]
    for i, (name, *ends) in enumerate(zip(names, *bounds, strict=True)):
        for end, bound, sign in zip(("lower", "upper"), ends, (1.0, -1.0), strict=True):
            value = float(bound if i < count else np.exp(bound))
            unit = 1.0 if i < count else value  # d ln ω = dω/ω
            level = sign / (unit * (ends[1] - ends[0]))
            yield _Parameter(f"{name} {end}", value, none, {f"{name} {end}": level})


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
