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
from ccd_casadi.synthesis.derivatives import sensitivities
from ccd_casadi.synthesis.weights import Weights

ABSENT = 1e-8  # presence of an input that is not there: √z has a slope
SAME = 1e-7  # relative: a γ_opt² that is lower by less is the same


@dataclass(frozen=True)
class InputChoice:
    """The inputs (from 0) of the least γ_opt.

    Parameters
    ----------
    inputs : tuple of int
        Those chosen, in rising order.
    gamma_opt : float
        Of the plant with these inputs.
    syntheses : int
        How many were made, for all choices.
    failed : tuple of tuple of int
        Choices whose synthesis was not certified; they are left out without a bound.
    """

    inputs: tuple[int, ...]
    gamma_opt: float
    syntheses: int
    failed: tuple[tuple[int, ...], ...]


def choose_inputs(plant: ScaledPlant, weights: Weights, count: int) -> InputChoice:
    """The best `count` inputs of a plant for mixed sensitivity with given weights.

        min γ_opt(z)   over z in {0, 1}^m with Σ z = count

    Parameters
    ----------
    plant : ScaledPlant
        With all m inputs, and the masses of all: A does not depend on the choice.
    weights : Weights
        W1, W2, W3, without an input disturbance.
    count : int
        At least as many as outputs.

    Returns
    -------
    InputChoice
        No choice has a lower γ_opt, but for those that failed.

    Raises
    ------
    UserError
        Where `count` or the problem does not fit, or no choice has a certified design.
    """
    m, p = plant.B.shape[1], plant.C.shape[0]
    if not p <= count <= m:
        raise UserError(f"{count} of {m} inputs for {p} outputs: give a number from {p} to {m}")
    if weights.delta or plant.family is not None:
        words = "of the model alone, without an input disturbance"
        raise UserError(f"inputs are chosen by the mixed sensitivity {words}; leave these out")
    cuts: list[Array] = []  # (∇, -1): z and g with g >= every cut
    limits: list[float] = []
    best, chosen, failed, made = np.inf, None, [], 0
    z = np.full(m, count / m)
    while True:
        made += 1
        value, slope = _squared(plant, weights, np.maximum(z, ABSENT))
        whole = made > 1
        if np.isfinite(value):
            cuts.append(np.append(slope, -1.0))
            limits.append(float(slope @ np.maximum(z, ABSENT)) - value)
            if whole and value < best:
                best, chosen = value, z
        if whole:  # this choice is known
            cuts.append(np.append(z, 0.0))
            limits.append(count - 0.5)
            failed += [] if np.isfinite(value) else [tuple(np.flatnonzero(z).tolist())]
        found = milp(
            np.append(np.zeros(m), 1.0),
            integrality=np.append(np.ones(m), 0.0),
            bounds=Bounds(np.zeros(m + 1), np.append(np.ones(m), np.inf)),
            constraints=[
                LinearConstraint(np.append(np.ones(m), 0.0), count, count),
                *([LinearConstraint(np.array(cuts), -np.inf, limits)] if cuts else []),
            ],
            options={"mip_rel_gap": 0.0},
        )
        if found.x is None or found.fun >= best * (1.0 - SAME):
            break
        z = np.round(found.x[:m])
    if chosen is None:
        raise UserError(f"no {count} of {m} inputs have a certified design with these weights")
    inputs = tuple(np.flatnonzero(chosen).tolist())
    return InputChoice(inputs, float(np.sqrt(best)), made, tuple(failed))


def _squared(plant: ScaledPlant, weights: Weights, z: Array) -> tuple[float, Array]:
    """γ_opt² and its gradient to z; NaN where the synthesis is not certified."""
    root, m = np.sqrt(z), len(z)
    dB = np.einsum("ni,ki->kni", plant.B, np.diag(0.5 / root))
    B = plant.B * root
    there = replace(
        plant,
        B=B,
        gain=plant_gain(plant.A, B, plant.C, plant.grid),
        dA=np.zeros((m, *plant.A.shape)),
        dB=dB,
        dC=np.zeros((m, *plant.C.shape)),
        channels=(),
    )
    found = sensitivities(there, weights, omega_low=plant.omega_0)
    gamma = found.figures.gamma_opt if found.figures.certified else np.nan
    return gamma**2, 2.0 * gamma * found.to_theta[-1]
