"""Measure and certify any controller on any plant: the judge that all back ends share."""

from dataclasses import replace

import numpy as np

from ccd_casadi.kernels.design import judge
from ccd_casadi.kernels.figures import Column
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.synthesis.synthesis import (
    UNBOUNDED,
    Design,
    DesignFigures,
    Outcome,
    figures_from_row,
)
from ccd_casadi.synthesis.weights import Weights

EPS = 2.0**-52
ROUNDING = 1e-6  # relative: what the conversion to SI may change of a norm and of a bandwidth


def measure(
    plant: ScaledPlant,
    controller: StateSpace,
    weights: Weights,
    *,
    omega_low: float,
    gamma: float = UNBOUNDED,
    gamma_opt: float = np.nan,
    gamma_lower_bound: float = np.nan,
) -> DesignFigures:
    """Rebuild the loop from an SI controller (e in, u out), certify it against `gamma`, measure S.

    The figures end where the certificate fails; ω_low in rad/s. Without `gamma` the norm is not
    judged.
    """
    w0, row = plant.omega_0, np.full(int(Column.COUNT), np.nan)
    row[Column.GAMMA_OPT], row[Column.GAMMA_LOWER_BOUND] = gamma_opt, gamma_lower_bound
    row[Column.LIMITED_BY_BOUND] = 0.0
    K = controller.in_units(w0, plant.force)
    A, B, C, D = (np.ascontiguousarray(part) for part in (K.A, K.B, K.C, K.D))
    judge(plant.A, plant.B, plant.C, A, B, C, D, weights.scaled(w0), weights.delta, gamma,
          omega_low / w0, row)  # fmt: skip
    return figures_from_row(row, weights, w0)


def recertified_in_si(plant: ScaledPlant, design: Design, omega_low: float) -> Design:
    """The design, no longer certified where the numbers of its controller in SI do not carry it.

    What is certified in a synthesis is the controller in the plant's own units. Where the loop
    hangs on digits that doubles do not have (a plant of gain 10¹², for instance), the controller
    that a user gets is another one: it is certified again, to its bound, as it is given away.
    """
    if not design.figures.certified:
        return design
    bound = design.figures.certificate.norm_bound * (1.0 + ROUNDING)  # the γ reached is a grid's
    rng = np.random.default_rng(0)  # the way to SI and back alone may change no digit at all
    K = design.controller
    rounded = StateSpace(
        *(X * (1.0 + EPS * rng.choice([-1.0, 1.0], X.shape)) for X in (K.A, K.B, K.C, K.D))
    )
    again = measure(plant, rounded, design.weights, gamma=bound, omega_low=omega_low)
    if again.certified and abs(again.bandwidth / design.figures.bandwidth - 1.0) <= ROUNDING:
        return design
    return replace(design, figures=replace(design.figures, outcome=Outcome.LOST_IN_ROUNDING))
