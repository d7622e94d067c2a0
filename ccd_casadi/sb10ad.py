"""SLICOT's SB10AD as a second synthesis back end, certified the same way as our own.

SB10AD accepts a γ when its Riccati solver reports no error and the loop is stable; it tests
neither X >= 0 nor the norm. Its γ is therefore only a search variable: a design counts here
when the certificate passes, and not otherwise.
"""

import warnings
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.closed_loop import measure
from ccd_casadi.kernels.generalized_plant import generalized_plant
from ccd_casadi.scaling import ScaledPlant
from ccd_casadi.synthesis import Design
from ccd_casadi.weights import Weights


@dataclass(frozen=True)
class Sb10adResult:
    """SB10AD's own γ_opt, and the certified design at backoff·γ_opt; None where it reports INFO."""

    gamma_opt: float
    design: Design | None
    reason: str


def synthesise_sb10ad(
    plant: ScaledPlant,
    weights: Weights,
    *,
    omega_low: float,
    gamma_backoff: float = 1.02,
    gamma_start: float = 1e3,
    tolerance: float = 0.0,
) -> Sb10adResult:
    """Bisection for γ_opt (job 1) and a controller at the backed-off γ (job 4); ω_low in rad/s.

    Raises ImportError where slycot is not installed.
    """
    import slycot

    w = weights.scaled(plant.omega_0)
    A, B1, B2, C1, C2, d1, d2 = generalized_plant(plant.A, plant.B, plant.C, w)
    p, m = C2.shape[0], B2.shape[1]
    B, C = np.hstack([B1, B2]), np.vstack([C1, C2])
    D = np.zeros((C.shape[0], B.shape[1]))
    D[:p, :p] = d1 * np.eye(p)
    D[p : p + m, p:] = d2 * np.eye(m)
    D[2 * p + m :, :p] = np.eye(p)
    size = (A.shape[0], B.shape[1], C.shape[0], m, p)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = slycot.sb10ad(*size, gamma_start, A, B, C, D, job=1, gtol=tolerance)
            gamma_opt = float(found[0])
            gamma = gamma_backoff * gamma_opt
            made = slycot.sb10ad(*size, gamma, A, B, C, D, job=4, gtol=tolerance)
    except (slycot.exceptions.SlycotError, ValueError) as error:
        return Sb10adResult(np.nan, None, str(error).strip())
    scaled = plant.controller_si(made[1], made[2], made[3])
    controller = replace(scaled, D=plant.force * made[4])
    figures = measure(
        plant,
        controller,
        weights,
        gamma=gamma,
        omega_low=omega_low,
        gamma_opt=gamma_opt,
    )
    return Sb10adResult(gamma_opt, Design(figures, weights, controller), figures.outcome.value)
