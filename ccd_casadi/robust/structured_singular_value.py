"""The largest error of modal stiffness that a loop survives, by a bound on the structured singular
value."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.lti.frequency_grid import resonant
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array


def mu_bound(M: NDArray) -> Array:
    """σ_max(D M D⁻¹) of every one of the matrices (k, n, n), balanced by D.

    >>> float(mu_bound(np.array([[[0.0, 4.0], [1.0, 0.0]]]))[0].round(6))
    2.0
    """
    x = _balanced(M)
    scaled = np.exp(x[:, :, None] - x[:, None, :]) * M
    return np.linalg.svd(scaled, compute_uv=False)[:, 0]


def _balanced(M: NDArray, *, sweeps: int = 10, settled: float = 1e-4) -> Array:
    """x (k, n): every row of e^x M e^-x as long as its column, off the diagonal; after `sweeps` at
    most, or a step below `settled`."""
    size = np.abs(M) ** 2
    n = size.shape[1]
    size[:, np.arange(n), np.arange(n)] = 0.0
    x = np.zeros(size.shape[:2])
    tiny = np.finfo(float).tiny
    for _ in range(sweeps):
        moved = 0.0
        for i in range(n):
            row, column = size[:, i, :].sum(axis=1), size[:, :, i].sum(axis=1)
            live = (row > tiny) & (column > tiny)
            factor = np.sqrt(np.where(live, column, 1.0) / np.where(live, row, 1.0))
            size[:, i, :] *= factor[:, None]
            size[:, :, i] /= factor[:, None]
            step = 0.5 * np.log(factor)
            x[:, i] += step
            moved = max(moved, float(np.abs(step).max(initial=0.0)))
        if moved < settled:
            break
    return x - x.mean(axis=1, keepdims=True)


@dataclass(frozen=True)
class StructuredBoundOptions:
    """Numbers of the bound on errors of modal stiffness."""

    slopes: tuple[float, ...] = (0.0, 10.0, 3.0, 1.0)  # of disks; larger ones need a finer grid
    seen: float = 1e-9  # share of the strongest residue below which a mode is in no loop
    flank: float = 12.0  # half widths to either side of a resonance of the loop
    flank_points: int = 97
    same: float = 1e-6  # relative: closer frequencies are one
    rounds: int = 8  # refinements around the worst frequency
    points: int = 8  # of each, to either side
    bisections: int = 25


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
    plant: ScaledPlant, modal: ModalPlant, controller: StateSpace, hz: Array,
    options: StructuredBoundOptions = StructuredBoundOptions(),
) -> StructuredBound | None:  # fmt: skip
    """From a grid in Hz, refined where it is decided; None without a flexible mode in the loop."""
    residue = np.linalg.norm(modal.B, axis=1) * np.linalg.norm(modal.C, axis=0)
    kept = np.flatnonzero(~modal.rigid & (residue > options.seen * residue.max()))
    if kept.size == 0:
        return None
    poles = resonant(closed_loop(plant.plant_si(), controller).S.poles)
    flanks = np.linspace(-options.flank, options.flank, options.flank_points)
    around = np.abs(poles.imag + np.outer(flanks, poles.real)).ravel() / (2.0 * np.pi)
    new = np.unique(np.concatenate([hz, around]))
    # twins would hide what lies beside them
    new = new[np.diff(new, prepend=0.0) > options.same * new]
    known = np.empty((0, 2))
    allowed, worst = 1.0, float(new[0])  # |δ| = 1 leaves no stiffness
    for _ in range(1 + options.rounds):
        K = controller.response(2.0 * np.pi * new)
        each = zip(2.0 * np.pi * new, K, strict=True)
        M = np.array([_errors(modal, kept, omega, k) for omega, k in each])
        mu = mu_bound(M)
        known = np.vstack([known, np.column_stack([new, mu])])
        found = _largest(M, 1.0 / mu.max(), allowed, options)
        if found is not None:
            allowed, worst = found[0], float(new[found[1]])
        known = known[np.argsort(known[:, 0])]
        at = int(np.searchsorted(known[:, 0], worst))
        ends = known[max(at - 2, 0), 0], known[min(at + 2, len(known) - 1), 0]
        pairs, count = ((ends[0], worst), (worst, ends[1])), options.points + 2
        sides = [np.linspace(a, b, count)[1:-1] for a, b in pairs]
        new = np.setdiff1d(np.concatenate(sides), known[:, 0])
    return StructuredBound(known[:, 0], known[:, 1], allowed, worst, kept.size)


def _errors(modal: ModalPlant, kept: NDArray[np.intp], omega: float, K: NDArray) -> NDArray:
    """M(jω) = -K^½ Z⁻¹ K^½ of the modes `kept`, Z the dynamic stiffness of the closed loop."""
    root = np.sqrt(np.diag(modal.K)[kept])
    stiffness = modal.K + modal.B @ K @ modal.C
    Z = stiffness + 1j * omega * modal.D - omega**2 * np.eye(len(stiffness))
    return -root[:, None] * np.linalg.inv(Z)[np.ix_(kept, kept)] * root


def _regular(M: NDArray, r: float, slopes: tuple[float, ...]) -> NDArray[np.bool_]:
    """Whether a disk around [-r, r], its centre at ±jκr of some κ of `slopes`, is free of singular
    points, for matrices (k, n, n)."""
    diagonal = np.einsum("kii->ki", M)
    side = np.where(diagonal.imag < 0.0, -1.0, 1.0)[:, None, :]
    regular = np.zeros(len(M), dtype=bool)
    for kappa in slopes:
        left = np.flatnonzero(~regular)
        if left.size == 0:
            break
        moved = np.eye(M.shape[1]) - 1j * kappa * r * M[left] * side[left]
        turned = np.linalg.solve(moved, M[left])
        turned *= r * np.sqrt(1.0 + kappa**2)
        # cheapest first: the two norms that bound σ_max
        size = np.abs(turned)
        bound = np.sqrt(size.sum(axis=1).max(axis=1) * size.sum(axis=2).max(axis=1))
        open_ = bound >= 1.0
        bound[open_] = mu_bound(turned[open_])
        regular[left] = bound < 1.0
    return regular


def _largest(
    M: NDArray, low: float, high: float, options: StructuredBoundOptions
) -> tuple[float, int] | None:
    """The largest r below `high` at which all matrices have a disk, as at `low`; which decides.

    None where all of them have one at `high`. A matrix with a disk at some r has one at smaller r.
    """
    falls = np.flatnonzero(~_regular(M, high, options.slopes))
    if falls.size == 0:
        return None
    low = min(low, high)
    for _ in range(options.bisections):
        middle = 0.5 * (low + high)
        still = falls[~_regular(M[falls], middle, options.slopes)]
        if still.size:
            falls, high = still, middle
        else:
            low = middle
    return low, int(falls[0])
