"""Structured singular value of uncertain modal stiffnesses K_i (1 + δ_i), by SLICOT's AB13MD.

In modal coordinates q̈ + D q̇ + K q = B u the errors close the loop w = δ z around

    M = -K_f^½ [(s² + D s + K + B K(s) C)⁻¹]_ff K_f^½,   f the flexible modes,

and the loop stays stable for |δ_i| <= r while no such δ makes I - M(jω) δ singular at any ω. With
complex δ that is r < 1/μ, which at a lightly damped mode is little. The real interval [-r, r] lies
in every disk with its centre at ±jκr and radius r√(1 + κ²) as well, and with

    M' = (I - jκr M s)⁻¹ M r√(1 + κ²),   s_i = ±1,

μ(M') < 1 for one κ is enough at each ω; the disks play the part of the G-scalings of mixed μ.
AB13MD has real blocks too, but for some matrices it then does not end (slycot 0.7).

Every answer holds at the frequencies of a grid; between them nothing is proven.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.plants.scaling import ScaledPlant, StateSpace
from ccd_casadi.robust.signals import closed_loop
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.optional_packages import require
from ccd_casadi.synthesis.closed_loop import responses

KAPPA = (0.0, 10.0, 3.0, 1.0)  # a larger one asks for a finer grid
COMPLEX = 2
SEEN = 1e-9  # share of the strongest residue under which a mode is in no loop
LIGHT = 0.3  # damping ratio of the loop's poles around which the grid is dense
FLANKS = np.linspace(-12.0, 12.0, 97)  # in their real parts
SAME = 1e-6  # relative
ROUNDS, FINE = 8, 8  # refinements around the worst frequency, and points a side
BISECTIONS = 25


@dataclass(frozen=True)
class StructuredBound:
    """|δ_i| <= `stiffness` is allowed for, real and each mode by itself; `worst_hz` decides.

    `mu` over `hz` is the upper bound for complex δ_i.
    """

    hz: Array
    mu: Array
    stiffness: float
    worst_hz: float
    modes: int

    @property
    def shift(self) -> float:
        """By how much every natural frequency may err then, up or down (relative)."""
        return float(np.sqrt(1.0 + self.stiffness)) - 1.0


def structured_bound(
    plant: ScaledPlant, modal: ModalPlant, controller: StateSpace, hz: Array
) -> StructuredBound | None:
    """From a grid in Hz, refined where it is decided; None without a flexible mode in the loop."""
    residue = np.linalg.norm(modal.B, axis=1) * np.linalg.norm(modal.C, axis=0)
    kept = np.flatnonzero(~modal.rigid & (residue > SEEN * residue.max()))
    if kept.size == 0:
        return None
    poles = np.linalg.eigvals(closed_loop(plant.plant_si(), controller).A)
    poles = poles[(poles.imag > 0.0) & (np.abs(poles.real) < LIGHT * np.abs(poles))]
    around = np.abs(poles.imag + np.outer(FLANKS, poles.real)).ravel() / (2.0 * np.pi)
    new = np.unique(np.concatenate([hz, around]))
    new = new[np.diff(new, prepend=0.0) > SAME * new]  # twins would hide what lies beside them
    known = np.empty((0, 2))
    allowed, worst = 1.0, float(new[0])  # |δ| = 1 leaves no stiffness
    for _ in range(1 + ROUNDS):
        K = responses(plant, controller, 2.0 * np.pi * new)[1]
        M = [_errors(modal, kept, 2.0 * np.pi * f, k) for f, k in zip(new, K, strict=True)]
        mu = np.array([diagonal_mu(m) for m in M])
        known = np.vstack([known, np.column_stack([new, mu])])
        for i in np.argsort(-mu):
            if not _stands(M[i], allowed):
                allowed, worst = _largest(M[i], 1.0 / mu[i], allowed), float(new[i])
        known = known[np.argsort(known[:, 0])]
        at = int(np.searchsorted(known[:, 0], worst))
        ends = known[max(at - 2, 0), 0], known[min(at + 2, len(known) - 1), 0]
        sides = [np.linspace(a, b, FINE + 2)[1:-1] for a, b in ((ends[0], worst), (worst, ends[1]))]
        new = np.setdiff1d(np.concatenate(sides), known[:, 0])
    return StructuredBound(known[:, 0], known[:, 1], allowed, worst, kept.size)


def _errors(modal: ModalPlant, kept: NDArray[np.intp], omega: float, K: NDArray) -> NDArray:
    """M(jω)."""
    root = np.sqrt(np.diag(modal.K)[kept])
    stiffness = modal.K + modal.B @ K @ modal.C
    Z = stiffness + 1j * omega * modal.D - omega**2 * np.eye(len(stiffness))
    return -root[:, None] * np.linalg.inv(Z)[np.ix_(kept, kept)] * root


def diagonal_mu(M: NDArray) -> float:
    """Upper bound for complex scalars on the diagonal."""
    ones = np.ones(len(M), dtype=int)
    return float(require("slycot", "slicot").ab13md(M, ones, COMPLEX * ones)[0])


def _stands(M: NDArray, r: float) -> bool:
    """Whether some disk around [-r, r] is free of singular points."""
    side = np.where(np.diag(M).imag < 0.0, -1.0, 1.0)
    for kappa in KAPPA:
        turned = np.linalg.solve(np.eye(len(M)) - 1j * kappa * r * M * side, M)
        if diagonal_mu(turned * (r * np.sqrt(1.0 + kappa**2))) < 1.0:
            return True
    return False


def _largest(M: NDArray, low: float, high: float) -> float:
    """The largest r that stands, to bisection, from one that does and one that does not."""
    low = min(low, high)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _stands(M, middle) else (low, middle)
    return low
