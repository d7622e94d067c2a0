"""The sequential baseline: hardware first, by a rule of thumb, then the controller once.

    min f(θ)  s.t.  first resonance >= f_1,  θ_min <= θ <= θ_max,  λ(θ) <= 0

with exact eigenvalue derivatives dλ_1 = φᵀ(dK - λ_1 dM)φ, and then the inner problem at that θ.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from ccd_casadi.modal import modal_plant
from ccd_casadi.plant import Array, constraint_values, mechanics
from ccd_casadi.problem import CoDesignProblem, box, plant_of
from surrogates import design


@dataclass(frozen=True)
class HardwareDesign:
    """The hardware that the rule of thumb gives; resonance in rad/s; `met` False: none meets it."""

    theta: tuple[float, ...]
    hardware_cost: float
    first_resonance: float
    met: bool


def first_resonance(problem: CoDesignProblem, theta: Array) -> tuple[float, Array]:
    """ω_1 of the first flexible mode, rad/s, and its gradient to θ; NaN where all is rigid."""
    modal = modal_plant(mechanics(plant_of(problem), tuple(theta)), problem.suspension)
    flexible = np.flatnonzero(~modal.rigid)
    if flexible.size == 0:
        return np.nan, np.full(len(theta), np.nan)
    i = int(flexible[0])
    omega = float(modal.natural[i])
    slope = modal.dK[:, i, i] - omega**2 * modal.dM[:, i, i]
    return omega, slope / (2.0 * omega)


def design_hardware(
    problem: CoDesignProblem, resonance: float, *, starts: int = 8, seed: int = 0
) -> HardwareDesign:
    """The least hardware cost with ω_1 >= `resonance` (rad/s), by SLSQP.

    From the case's start and `starts` more: with none, the local solution next to the start,
    which need not be the least one (for the two masses it is the paper's equal-mass design).
    """
    lower, upper = box(problem)
    width = upper - lower
    plant = plant_of(problem)
    symbol = ca.SX.sym("theta", len(problem.names))
    f, lam = plant.hardware(symbol)
    cost = ca.Function("cost", [symbol], [f, ca.jacobian(f, symbol)])
    extra = ca.Function("extra", [symbol], [lam, ca.jacobian(lam, symbol)])

    def at(z: Array) -> Array:
        return lower + width * np.clip(z, 0.0, 1.0)

    constraints = [
        {
            "type": "ineq",
            "fun": lambda z: first_resonance(problem, at(z))[0] / resonance - 1.0,
            "jac": lambda z: first_resonance(problem, at(z))[1] * width / resonance,
        }
    ]
    if plant.constraint_names:
        constraints.append(
            {
                "type": "ineq",
                "fun": lambda z: -np.array(extra(at(z))[0]).ravel(),
                "jac": lambda z: -np.array(extra(at(z))[1]) * width,
            }
        )
    scale = abs(float(cost(np.array(problem.start))[0])) or 1.0
    points = np.array([problem.start])
    if starts > 0:
        points = np.vstack([points, design("sobol", lower, upper, starts, seed)])
    found = []
    for point in points:
        result = minimize(
            lambda z: float(cost(at(z))[0]) / scale,
            (point - lower) / width,
            jac=lambda z: np.array(cost(at(z))[1]).ravel() * width / scale,
            bounds=[(0.0, 1.0)] * len(lower),
            constraints=constraints,
            method="SLSQP",
            options={"ftol": 1e-12, "maxiter": 200},
        )
        theta = at(result.x)
        omega = first_resonance(problem, theta)[0]
        allowed = bool((constraint_values(plant, theta) <= 1e-9).all())
        met = bool(omega >= resonance * (1.0 - 1e-6)) and allowed
        value = float(cost(theta)[0])
        found.append(HardwareDesign(tuple(float(v) for v in theta), value, omega, met))
    meeting = [item for item in found if item.met]
    if meeting:
        return min(meeting, key=lambda item: item.hardware_cost)
    return max(found, key=lambda item: item.first_resonance)
