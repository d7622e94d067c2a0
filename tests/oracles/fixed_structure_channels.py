"""Loops of several channels for the tests: a stage whose load may lie off centre."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    channel_bounds,
    find_decoupling,
)
from ccd_casadi.fixed_structure.composite import composite_problem
from ccd_casadi.fixed_structure.figures import (
    Brackets,
    PeakOptions,
    assess,
    constraints,
    hessians,
    to_theta,
)
from ccd_casadi.fixed_structure.loop_problem import Constraints, LoopCurve, LoopProblem
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.kernels import loop_grid, loop_point
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.plant import Plant, build_plant, mechanics
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.weights import Weights
from oracles.differences import slopes
from oracles.helpers import HZ, SUSPENSION, scaled

M_K = 4.5e4
WEIGHTS = Weights(M_S=2.0, A_S=1e-4, omega_S=10.0 * HZ, c_K=1e4, omega_K=100.0 * HZ, M_K=M_K,
                  A_l=1.0, A_u=1e-2, omega_T=25.0 * HZ)  # fmt: skip
BOUNDS = Bounds(S_max=1.75, S_low=0.03, omega_low=HZ, shape=1.1, weighted_level=20.0,
                weights=WEIGHTS, compliance_max=1e-3)  # fmt: skip
FAST = Sampling(12500.0, 80.0)
STRUCTURE = Structure(lead=1, biquads=1, roll_off=1)
PATTERN = 0.5 * np.array([[1.0, 1, 1, 1], [1, 1, -1, -1], [1, -1, 1, -1]])  # z, tip, tilt


@lru_cache
def stage(off: float = 0.0) -> Plant:
    """z, tip, tilt of a stage with four corners and three outputs; `load` kg lies off centre.

    One torsion mode acts on tip and tilt alike when the load is off centre, one bending mode on z.
    """
    shapes = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0], [0, 0.5, 0], [0, 0, 0.4]])
    side = np.array([[0.0, 1, -0.7], [1, 0, 0.3], [-0.7, 0.3, 0]])

    def model(theta: dict) -> dict:
        m, h = theta["m"], theta["h"]
        mixing = np.zeros((6, 6))
        mixing[:3, :3] = mixing[3:, 3:] = side
        mixing[:3, 3:] = mixing[3:, :3] = 0.3 * side
        mass = ca.diag(ca.vertcat(m, 0.8 * m, 0.7 * m, 0.5, 0.4, 0.4))
        hz = ca.vertcat(0.0, 0.0, 0.0, 230.0 * h, 310.0 * h, 350.0 * h**1.5)
        own = ca.vertcat(1.0, 1.0, 1.0, 0.5, 0.4, 0.4)
        return {
            "mass": mass + off * 0.1 * ca.DM(mixing),
            "stiffness": ca.diag(own * (HZ * hz) ** 2),
            "damping_ratio": 0.01,
            "input": ca.DM(shapes),
            "output": ca.DM(shapes.T),
            "hardware_cost": m,
        }

    return build_plant(model, ("m", "h"), {})


def plant(theta: tuple[float, float] = (1.0, 1.0), off: float = 0.0) -> ScaledPlant:
    """The stage at θ = (mass, relative frequency)."""
    return scaled(mechanics(stage(off), theta), M_K, SUSPENSION)


def structure(own: Structure = STRUCTURE) -> ChannelStructure:
    """The same structure for each of the stage's three channels."""
    return ChannelStructure(find_decoupling(plant()), (own,) * 3)


def loop(
    seed: int, off: tuple[float, ...], sampling: Sampling | None = None
) -> tuple[LoopProblem, Array]:
    """A problem on the stage with these loads, and a random κ that all of them are stable with."""
    rng = np.random.default_rng(seed)
    plants = [plant(off=x) for x in off]
    problem = composite_problem(plants, structure(), BOUNDS, sampling)
    for _ in range(200):
        values = []
        for channel in problem.structure.decoupling.names:
            crossover = np.exp(rng.uniform(-1.0, 0.3))
            near = {"gain": crossover**2 / 3.0, "integrator": 0.1 * crossover,
                    "lead 1 zero": crossover / 3.0, "lead 1 pole": 3.0 * crossover,
                    "biquad 1 zeros": 4.0, "biquad 1 zeros damping": 0.3, "biquad 1 poles": 5.0,
                    "biquad 1 poles damping": 0.5, "roll-off real": 10.0 * crossover}  # fmt: skip
            assert channel
            values += [near[name] * np.exp(0.2 * rng.normal()) for name in STRUCTURE.names]
        kappa = np.log(values)
        if assess(problem, kappa, -1.5).stable:
            return problem, kappa
    raise AssertionError("no random controller is stable")


def gaps(model: LoopProblem, kappa: Array, tau: float, rows: Constraints) -> Array:
    """How far each singular value is from the next one of its matrix, relative."""
    which = model.plants_of(rows)
    loop = model.loop(kappa, tau)
    places = (rows.curve[:, None], which, rows.v[:, None])
    level = loop_point.levels(*places, loop, -np.inf, loop_grid.NONE)[:, 0, 0]
    every, number = np.arange(len(which)), rows.plant // len(model.plants.plants)
    whole = number < model.first
    size = np.exp(level[:, : model.first])
    gap = np.abs(size / size[every, np.where(whole, number, 0)][:, None] - 1.0)
    gap[every, np.where(whole, number, 0)] = np.inf
    return np.where(whole, gap.min(axis=1), np.inf)


def assert_derivatives(
    problem_at: Callable[[tuple[float, float]], LoopProblem],
    kappa: Array,
    chosen: Callable[[np.ndarray], np.ndarray],
) -> set[int]:
    """Of simple singular values to κ, τ and θ, against differences of fourth order; their curves.

    `problem_at` θ; `chosen` rows (a mask by their numbers) belong to plants that move with θ.
    """
    tau, model = -1.5, problem_at((1.0, 1.0))
    peaks = assess(model, kappa, tau, depth=-2.0).peaks
    assert peaks is not None
    peaks = peaks.only(chosen(peaks.plant) & (gaps(model, kappa, tau, peaks) > 0.03))

    def values(of, kappa, tau):
        return constraints(of, kappa, tau, peaks).value

    size = np.abs(peaks.to_kappa).max(1, keepdims=True) + 1e-2
    to_kappa = slopes(lambda x: values(model, x, tau), kappa, 1e-4)
    assert (np.abs(to_kappa - peaks.to_kappa) / size).max() < 1e-5
    rising = peaks.curve != LoopCurve.CROSSING
    slope = (values(model, kappa, tau + 1e-6) - values(model, kappa, tau - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope[rising], peaks.to_tau[rising], atol=1e-6)
    exact = to_theta(model, kappa, peaks)
    scale = np.abs(exact).max(1, keepdims=True) + 1e-3 * np.abs(exact).max()
    found = slopes(lambda theta: values(problem_at(tuple(theta)), kappa, tau), np.ones(2), 1e-4)
    assert (np.abs(found - exact) / scale).max() < 1e-5
    return set(peaks.curve.tolist())


def everything() -> tuple[Array, ...]:
    """Of a coupled, sampled stage with a bound of a channel's own: the peaks, their slopes to κ, τ
    and θ, and their curvature."""
    problem, kappa = loop(0, (0.3,), FAST)
    whole = problem.structure
    own = channel_bounds(whole.decoupling, {"1": {"S_max": 1.5, "bandwidth_ratio": 1.6}})
    problem = composite_problem([plant(off=0.3)], whole, replace(BOUNDS, channels=own), FAST)
    peaks = assess(problem, kappa, -1.5).peaks
    assert peaks is not None
    bends = hessians(problem, kappa, -1.5, peaks)
    return (peaks.v, peaks.value, peaks.to_kappa, peaks.to_tau, to_theta(problem, kappa, peaks),
            bends)  # fmt: skip


def closed(
    patch: pytest.MonkeyPatch, slope: Callable[[float], float], brackets: Brackets
) -> tuple[Array, np.ndarray]:
    """The kernel's false position, interpreted, on curves of this slope to ln v."""
    patch.setattr(loop_point, "rows", lambda *places: (None, np.vectorize(slope)(places[3])))
    run = getattr(loop_point.close, "py_func", loop_point.close)
    ends, own = (brackets.start, brackets.low, brackets.high), PeakOptions()
    rules = (own.slope, own.width, own.iterations)
    return run(brackets.curve, brackets.row, brackets.row, *ends, None, rules)
