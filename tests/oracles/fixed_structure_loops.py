"""Loops for the tests of fixed structures: plants, bounds, random stable controllers."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, Problem
from ccd_casadi.fixed_structure.starts import at_random, stabilising
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.kernels.loop_grid import NONE
from ccd_casadi.kernels.loop_point import levels
from ccd_casadi.kernels.sections import INTEGRATOR, PAIR
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.modal import FREE, Perturbation, modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.support.arrays import Array
from oracles.helpers import HZ, PAPER, two_mass_model

WEIGHTS = PAPER.at(PAPER.omega_S, 25.0 * HZ)
BOUNDS = Bounds(
    S_max=1.75,
    S_low=0.03,
    omega_low=HZ,
    shape=1.1,
    weighted_level=8.426,
    weights=WEIGHTS,
    compliance_max=1e-6,
)
FAST = Sampling(10000.0, 130.0)
LATE = Sampling(5000.0, 250.0)  # a whole period and a quarter
SLOW = Sampling(2500.0, 900.0)  # two whole periods and a quarter of delay


def plant(shift: float = 0.0, damping: float = 1.0, theta: Array | None = None) -> ScaledPlant:
    """Case study 1, at (55, 55) kg unless told."""
    theta = np.array([55.0, 55.0]) if theta is None else theta
    system = mechanics(two_mass_model(), theta)
    modal = modal_plant(system, FREE, Perturbation(shift, damping))
    return scale_plant(modal, WEIGHTS.M_K)


def loop(
    seed: int, structure: Structure, sampling: Sampling | None = None, shifts: tuple = (0.0,)
) -> tuple[Problem, Array]:
    """A problem on shifted plants, and a random controller that all of them are stable with."""
    rng = np.random.default_rng(seed)
    problem = problem_for([plant(shift) for shift in shifts], structure, BOUNDS, sampling)
    for _ in range(50):
        found = stabilising(problem, at_random(problem, np.exp(rng.uniform(-4.0, -1.0, 40)), rng))
        if len(found):
            return problem, found[0]
    raise AssertionError("no random controller is stable")


def by_curve(
    problem: Problem, kappa: Array, tau: float, curves: Sequence[LoopCurve], v: Array
) -> dict[LoopCurve, Array]:
    """The levels of all plants at v (P, k) by curve, without the margin."""
    codes, loop = np.tile(np.array(curves, np.int64), (len(v), 1)), problem.loop(kappa, tau)
    found = levels(codes, np.arange(len(v)), v, loop, -np.inf, NONE)
    return {curve: found[:, :, i, 0] for i, curve in enumerate(curves)}


def response_and_slopes(
    structure: Structure, kappa: Array, s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K(s), ∂ln K/∂κ with the parameters as the last axis, and ∂ln K/∂ln s."""
    values = np.exp(kappa)
    slopes, slope = np.zeros((*s.shape, len(kappa)), complex), np.zeros(s.shape, complex)
    slopes[..., 0] = 1.0
    for kind, sign, at in structure.factors[1:].tolist():
        x = values[at] / s if kind == INTEGRATOR else s / values[at]
        middle = 2.0 * values[at + 1] * x if kind == PAIR else 0.0
        factor = 1.0 + middle + x * x if kind == PAIR else 1.0 + x
        first = -middle - 2.0 * x * x if kind == PAIR else x if kind == INTEGRATOR else -x
        slopes[..., at] = sign * first / factor
        if kind == PAIR:
            slopes[..., at + 1] = sign * middle / factor
        slope = slope - sign * first / factor
    return structure.response(kappa, s), slopes, slope
