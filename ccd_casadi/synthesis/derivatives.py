"""Total derivatives of a certified design's figures to θ and to the weights.

The controller, γ_opt and the Riccati solution move with the plant; the paper's own gradient,
with K held fixed (its equations (10) to (13)), comes along for the baseline.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from ccd_casadi.kernels.design import design, failed_row
from ccd_casadi.kernels.gradients import LoopAt, MadeFor, figure_gradients
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.notebook import NotebookHtml
from ccd_casadi.synthesis.statics import compliance_over_family
from ccd_casadi.synthesis.synthesis import (
    DesignFigures,
    Outcome,
    figures_from_row,
    judged_on,
    over_family,
)
from ccd_casadi.synthesis.weights import Weights

MULTIPLE_GAP = 1e-6  # below this (σ1 - σ2)/σ1 the largest singular value counts as multiple
_WEIGHTS = ("M_S", "A_S", "omega_S", "c_K", "omega_K", "A_l", "A_u", "omega_T")


@dataclass(frozen=True)
class DesignDerivatives:
    """What was made, in scaled units: for what else is read off the same design.

    `row` of its figures, (A_K, B_K, C_K), dγ_opt to θ and weights; `worst` is the place in its
    family of the plant that has ‖S‖∞, 0 the plant itself.
    """

    row: Array
    controller: tuple[Array, Array, Array]
    to_gamma: Array
    worst: int = 0


@dataclass(frozen=True)
class Sensitivities(NotebookHtml):
    """Figures of one design with their gradients.

    `values` and the rows of the gradients: ω_b (rad/s), ln‖S‖∞, ln σ_max(S(jω_low)), where it was
    asked for ln‖GS‖∞ (m/N), γ_opt. `to_theta` (4 or 5, n_θ) per unit of θ; `to_weights` maps a
    weight's name to the derivatives to its logarithm, W_d as `disturbance` where it is given.
    `fixed_controller` (n_θ) is dω_b/dθ with K held fixed. `simple` tells whether σ_max is a simple
    singular value at these frequencies; where it is not, the gradient is one of several one-sided
    ones.
    """

    figures: DesignFigures
    values: Array
    to_theta: Array
    to_weights: dict[str, Array]
    fixed_controller: Array
    simple: tuple[bool, ...]
    made: DesignDerivatives | None = field(default=None, repr=False, compare=False)

    @property
    def to_break_frequencies(self) -> Array:
        """Derivatives (4 or 5, 2) to (ln ω_S, ln ω_T)."""
        return np.column_stack([self.to_weights["omega_S"], self.to_weights["omega_T"]])


def sensitivities(
    plant: ScaledPlant,
    weights: Weights,
    *,
    omega_low: float,
    gamma_backoff: float = 1.02,
    compliance: bool = False,
) -> Sensitivities:
    """Synthesise, certify and differentiate at one point; gradients are NaN if not certified.

    What is certified here has finite gradients; where they are not, the outcome says so.
    With a family the peak is the largest on any of it, its gradient that of the plant that has it;
    so is ‖GS‖∞, which is among the values where `compliance` asks for it.
    """
    w0, count = plant.omega_0, plant.dA.shape[0]
    made_on = plant.design_plant
    names = _WEIGHTS + (("disturbance",) if weights.delta else ())
    scaled = np.append(weights.scaled(w0), weights.delta)
    made_for = MadeFor(made_on, weights.scaled(w0), gamma_backoff, weights.delta)
    made = None
    try:
        # Rounding may put the blocks' γ_opt below the whole plant's: it is then made from that.
        for channels in (made_on.channels, ()) if made_on.channels else ((),):
            row, Ak, Bk, Ck = design(
                made_on.A, made_on.B, made_on.C, made_for.w, made_on.grid, made_on.gain,
                gamma_backoff, omega_low / w0, 0.0, channels, weights.delta, judged_on(plant),
            )  # fmt: skip
            K = Ak, Bk, Ck
            figures, worst = over_family(plant, weights, row, K, omega_low)
            places = [
                (plant, figures.bandwidth, False),
                (worst, figures.sensitivity_peak_frequency, False),
                (plant, omega_low, False),
            ]
            if compliance and figures.certified:
                most = compliance_over_family(plant, plant.controller_si(*K))
                figures = replace(figures, compliance=most.gain)
                places.append((most.plant, most.omega, True))
            loops = [LoopAt(at, omega / w0, of_force) for at, omega, of_force in places]
            gradient, fixed, gaps, to_gamma, whole = figure_gradients(
                made_for, row, made_on.grid, made_on.gain, loops if figures.certified else []
            )
            if whole:
                break
        made = DesignDerivatives(
            row, K, to_gamma, [at is worst for at in plant.members].index(True)
        )
    except np.linalg.LinAlgError:
        figures = figures_from_row(failed_row(), weights, w0)
        gradient, fixed = np.empty((0, count + len(names))), np.full(count, np.nan)
    if len(gradient) != 4 + compliance:
        gradient, gaps = np.full((4 + compliance, gradient.shape[1]), np.nan), np.full(3, np.nan)
    if figures.certified and not np.isfinite(gradient).all():
        figures = replace(figures, outcome=Outcome.NO_DERIVATIVES)
    gradient[0] *= w0
    with np.errstate(invalid="ignore", divide="ignore"):
        bounded = [figures.sensitivity_peak, figures.sensitivity_low]
        bounded += [figures.compliance] if compliance else []
        values = np.array([figures.bandwidth, *np.log(bounded), figures.gamma_opt])
    return Sensitivities(
        figures=figures,
        values=values,
        to_theta=gradient[:, :count],
        to_weights={name: gradient[:, count + i] * scaled[i] for i, name in enumerate(names)},
        fixed_controller=fixed * w0,
        simple=tuple(bool(gap > MULTIPLE_GAP) for gap in gaps),
        made=made,
    )
