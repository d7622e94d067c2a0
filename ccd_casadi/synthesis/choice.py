"""k of m inputs: where actuators go, without a synthesis for each choice.

With B diag(√z) for B an input is there (z_i = 1), is not (0), or is there in part. Then

    γ_opt²(z) is convex:

the filter's Riccati solution is 0, and what is left is a problem of full information, whose bounded
real inequality is linear in X⁻¹, F X⁻¹, γ² and z. So a synthesis at z_j bounds every choice,

    γ_opt²(z) >= γ_opt²(z_j) + ∇γ_opt²(z_j)ᵀ(z - z_j),

and the next one is made at the choice whose bound is least, until that is the best one known.

Sources: Boyd, El Ghaoui, Feron and Balakrishnan, Linear Matrix Inequalities in System and Control
Theory (1994); Duran and Grossmann, Mathematical Programming 36 (1986), for the cuts.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from ccd_casadi.kernels.gamma import plant_gain
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.worker_process import one_blas_thread
from ccd_casadi.synthesis.derivatives import sensitivities
from ccd_casadi.synthesis.weights import Weights


@dataclass(frozen=True)
class InputChoice:
    """The inputs (from 0, rising) of the least γ_opt, and of how many syntheses it was found.

    `failed`: choices whose synthesis was not certified, left out without a bound.
    """

    inputs: tuple[int, ...]
    gamma_opt: float
    syntheses: int
    failed: tuple[tuple[int, ...], ...]


@one_blas_thread
def choose_inputs(
    plant: ScaledPlant, weights: Weights, count: int, *, absent: float = 1e-8, same: float = 1e-7
) -> InputChoice:
    """The best `count` inputs of a plant for mixed sensitivity with given weights.

        min γ_opt(z)   over z in {0, 1}^m with Σ z = count

    Parameters
    ----------
    plant : ScaledPlant
        With all m inputs; A does not depend on the choice.
    weights : Weights
        W1, W2, W3, without an input disturbance.
    count : int
        At least as many as outputs.
    absent : float
        z of an input that is not there: √z has a slope there.
    same : float
        Relative: a γ_opt² that is lower by less is the same.

    Returns
    -------
    InputChoice
        No other choice has a lower γ_opt, but for those that failed.

    Raises
    ------
    UserError
        Where `count` or the problem does not fit, or no choice has a certified design.
    """
    m, p = plant.B.shape[1], plant.C.shape[0]
    if not p <= count <= m:
        raise UserError(f"{count} of {m} inputs for {p} outputs: give a number from {p} to {m}")
    if weights.delta or len(plant.members) > 1:
        words = "of the model alone, without an input disturbance"
        raise UserError(f"inputs are chosen by the mixed sensitivity {words}; leave these out")
    plant = plant.design_plant
    squared: dict[tuple[int, ...], float] = {}
    rules = [LinearConstraint(np.append(np.ones(m), 0.0), count, count)]  # on (z, γ²)
    z, least = np.full(m, count / m), np.inf  # in equal parts, for a first bound
    while True:
        at = np.maximum(z, absent)
        value, slope = _squared_gamma(plant, weights, at)
        if np.isfinite(value):
            below = float(slope @ at) - value
            rules.append(LinearConstraint(np.append(slope, -1.0), -np.inf, below))
        if z.max() == 1.0:
            squared[tuple(np.flatnonzero(z).tolist())] = value
            rules.append(LinearConstraint(np.append(z, 0.0), -np.inf, count - 0.5))  # not again
            least = np.nanmin([least, value])
        found = milp(
            np.eye(m + 1)[m], integrality=np.arange(m + 1) < m, constraints=rules,
            bounds=Bounds(0.0, np.append(np.ones(m), np.inf)), options={"mip_rel_gap": 0.0},
        )  # fmt: skip
        if found.x is None or found.fun >= least * (1.0 - same):
            break
        z = np.round(found.x[:m])
    failed = tuple(inputs for inputs, value in squared.items() if np.isnan(value))
    if least == np.inf:
        raise UserError(f"no {count} of {m} inputs have a certified design with these weights")
    best = min(squared, key=lambda inputs: np.nan_to_num(squared[inputs], nan=np.inf))
    return InputChoice(best, float(np.sqrt(least)), len(squared) + (count < m), failed)


def _squared_gamma(plant: ScaledPlant, weights: Weights, z: Array) -> tuple[float, Array]:
    """γ_opt² and its gradient to z; NaN where the synthesis is not certified."""
    m, B = len(z), plant.B * np.sqrt(z)
    there = replace(
        plant, B=B, gain=plant_gain(plant.A, B, plant.C, plant.grid), channels=(),
        dA=np.zeros((m, *plant.A.shape)), dB=np.eye(m)[:, None] * (0.5 * B / z),
        dC=np.zeros((m, *plant.C.shape)),
    )  # fmt: skip
    found = sensitivities(there, weights, omega_low=plant.omega_0)
    gamma = found.figures.gamma_opt if found.figures.certified else np.nan
    return gamma**2, 2.0 * gamma * found.to_theta[-1]
