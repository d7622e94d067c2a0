"""Stability margins of a loop, classical and by the structured singular value, and its norms.

Of a plant G (p outputs, m inputs) and a controller K: S = (1 + GK)⁻¹, T = 1 - S. Frequencies are
in rad/s unless a name is or ends in `hz`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.budget.evaluation import Lyapunov
from ccd_casadi.budget.noise_process import process
from ccd_casadi.budget.sources import ErrorSource, ShapedSpectrum, SourceKind
from ccd_casadi.lti.frequency_grid import refine_peak, resonant
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import (
    ClosedLoop,
    StateSpace,
    closed_loop,
    equivalent_open_loop,
    responses_of,
    sensitivity,
    sigma_max,
)
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import PlantAndController, classical_margins


def mu_bound(M: NDArray) -> Array:
    """σ_max(D M D⁻¹) of every one of the matrices (k, n, n), balanced by D.

    >>> float(mu_bound(np.array([[[0.0, 4.0], [1.0, 0.0]]]))[0].round(6))
    2.0
    """
    x = _balance(M)
    scaled = np.exp(x[:, :, None] - x[:, None, :]) * M
    return np.linalg.svd(scaled, compute_uv=False)[:, 0]


def _balance(M: NDArray, *, sweeps: int = 10, settled: float = 1e-4) -> Array:
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
        """The relative error of every natural frequency that is covered, up or down."""
        return float(np.sqrt(1.0 + self.stiffness)) - 1.0


def structured_bound(
    plant: ScaledPlant, modal: ModalPlant, controller: StateSpace, hz: Array,
    options: StructuredBoundOptions = StructuredBoundOptions(),
) -> StructuredBound | None:  # fmt: skip
    """Compute the bound from a grid in Hz, refined where it is decided; None without a flexible
    mode in the loop, and of a plant of first order, whose modes are not masses on springs."""
    residue = np.linalg.norm(modal.B, axis=1) * np.linalg.norm(modal.C, axis=0)
    kept = np.flatnonzero(~modal.rigid & (residue > options.seen * residue.max()))
    if kept.size == 0 or modal.states is not None:
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


@dataclass(frozen=True)
class Noise:
    """RMS of position (p,) in m and of force (m,) in N under white sensor noise, and under a white
    disturbance; inf where the variance is not finite."""

    position_by_noise: Array
    force_by_noise: Array
    position_by_disturbance: Array
    force_by_disturbance: Array


def gains(G: NDArray, K: NDArray) -> Array:
    """σ_max of S, T, GS (disturbance force to position) and KS (noise to force), (4, k).

    From the responses G (k, p, m) and K (k, m, p) at k frequencies.
    """
    closed_loop = responses_of(G, K)
    return np.array([sigma_max(closed_loop[name]) for name in ("S", "T", "GS", "KS")])


def norms(loop: ClosedLoop) -> tuple[tuple[float, float], ...]:
    """(‖·‖∞, ω) of S, T, GS and KS in continuous time, ω of the peak. No grid: `hinf_norm`."""
    return tuple(hinf_norm(part) for part in (loop.S, loop.T, loop.GS, loop.KS))


def highest(gain: Callable[[Array], Array], omega: Array) -> tuple[tuple[float, float], ...]:
    """(peak, ω) of each row of `gain`: ω (k,) to (r, k), for loops in discrete time.

    The grid's largest value brackets the peak, which is refined between its neighbours. One point
    far below the grid stands for ω = 0. The grid ends at π/T.
    """
    omega = np.concatenate([1e-3 * omega[:1], omega])
    values, peaks = gain(omega), []
    for row, i in enumerate(values.argmax(axis=1)):
        bracket = omega[max(i - 1, 0)], omega[min(i + 1, len(omega) - 1)]
        refined = refine_peak(partial(_of_row, gain, row), *bracket)[::-1]
        on_grid = (float(values[row, i]), 0.0 if i == 0 else float(omega[i]))
        peaks.append(max(on_grid, refined) if i else on_grid)
    return tuple(peaks)


def _of_row(gain: Callable[[Array], Array], row: int, omega: float) -> float:
    return float(gain(np.array([omega]))[row, 0])


def noise(loop: Loop, sensor: float, disturbance: float) -> Noise:
    """RMS for white sensor noise (one-sided density, m/√Hz) and white force at every input (N/√Hz).

    The covariance P of the states solves Lyapunov's equation; position C x has the variances
    diag(C P Cᵀ), force F x + V ν those of F P Fᵀ + V Vᵀ. In continuous time V ≠ 0 (a controller
    with feedthrough) makes the force white, of infinite variance. Of a sampled loop these are the
    values at its sampling instants.
    """
    rms = []
    for kind, density in ((SourceKind.SENSOR_NOISE, sensor), (SourceKind.FORCE, disturbance)):
        model = process(loop, ErrorSource(kind.value, kind, ShapedSpectrum(density**2))).balance()
        P = Lyapunov(model.A, sampled=model.sampled).covariance(model.noise)
        position, force = (np.einsum("ij,jk,ik->i", C, P, C) for C in (model.C, model.F))
        force = np.full_like(force, np.inf) if model.infinite_force else force + (model.V**2).sum(1)
        rms += [np.sqrt(np.maximum(position, 0.0)), np.sqrt(np.maximum(force, 0.0))]
    return Noise(*rms)


@dataclass(frozen=True)
class DiskMargin:
    """The balanced disk margin α (skew 0): stable under factors (1 + ½δ)/(1 - ½δ) of L, |δ| < α.

    1/α = max_ω μ(S - ½), where μ is |S - ½| of one channel; of several channels with an independent
    δ each it is replaced by its upper bound, and α is a lower bound.

    Attributes
    ----------
    alpha, hz : float
        α, and the frequency of the maximum.

    References
    ----------
    P. Seiler, A. Packard and P. Gahinet, IEEE Control Systems Magazine 40 (2020) 78-95.
    """

    alpha: float
    hz: float

    @property
    def gain(self) -> float:
        """The loop is stable under any factor of its gain between 1/gain and gain."""
        return (2.0 + self.alpha) / (2.0 - self.alpha) if self.alpha < 2.0 else math.inf

    @property
    def phase_deg(self) -> float:
        """The loop is stable under any change of its phase by less than this, at the same gain."""
        return math.degrees(2.0 * math.atan(self.alpha / 2.0))


@dataclass(frozen=True)
class LoopMargins:
    """Margins of one loop broken at a plant output or input, the others closed.

    Attributes
    ----------
    name : str
        "output 1", "input 2", ...
    gain_up, gain_down : float
        Nearest factors above and below 1 at which stability is lost; inf and 0 where there is none.
    phase_deg : float
        Least phase margin over all crossings of |L| = 1.
    crossover_hz : float
        Where |L| falls through 1, and is above 1 below and below 1 above over most of ln ω: not at
        a resonance further up.
    disk : DiskMargin
    """

    name: str
    gain_up: float
    gain_down: float
    phase_deg: float
    crossover_hz: float
    disk: DiskMargin


@dataclass(frozen=True)
class Margins:
    """Margins of each loop alone, and disk margins with a δ at all outputs, or inputs, at once."""

    loops: tuple[LoopMargins, ...]
    outputs: DiskMargin
    inputs: DiskMargin


def margins(respond: PlantAndController, hz: Array) -> Margins:
    """Margins of a loop from its responses.

    Parameters
    ----------
    respond : callable
        ω (k,) to G (k, p, m) and K (k, m, p), SI.
    hz : array (k,)
        A grid that resolves resonances; of a sampled loop up to half its rate. It only brackets:
        crossings are bisected on the response itself, and the least disk margin is evaluated again
        on a finer grid between its neighbours.
    """
    loops, multiloop = [], []
    for name in ("output", "input"):
        L = partial(_open_loop, respond, name)
        for i in range(L(HZ * hz[:1]).shape[1]):
            loops.append(_loop_margins(f"{name} {i + 1}", partial(_one_channel, L, i), hz))
        multiloop.append(_disk_margin(L, hz))
    return Margins(tuple(loops), *multiloop)


def _open_loop(respond: PlantAndController, name: str, omega: Array) -> NDArray:
    """L = GK (k, p, p), broken at the outputs, or KG (k, m, m), broken at the inputs."""
    G, K = respond(omega)
    return np.asarray(G @ K if name == "output" else K @ G)


def _one_channel(L: Callable[[Array], NDArray], i: int, omega: Array) -> NDArray:
    """(k,) the scalar open loop of channel i, the others closed."""
    return equivalent_open_loop(L(omega), i)


def _loop_margins(name: str, L: Callable[[Array], NDArray], hz: Array) -> LoopMargins:
    classical = classical_margins(L, HZ * hz)
    return LoopMargins(
        name=name,
        gain_up=classical.gain_up,
        gain_down=classical.gain_down,
        phase_deg=classical.phase_deg,
        crossover_hz=classical.crossover / HZ,
        disk=_disk_margin(lambda omega: L(omega)[:, None, None], hz),
    )


def _disk_margin(L: Callable[[Array], NDArray], hz: Array, *, points: int = 61) -> DiskMargin:
    """The least disk margin with a δ in each channel of L (k, n, n): on the grid, then at `points`
    between the neighbours of its minimum."""
    for refined in (False, True):
        eye = np.eye((response := L(HZ * hz)).shape[1])
        alpha = 1.0 / mu_bound(sensitivity(response) - 0.5 * eye)
        worst = int(alpha.argmin())
        margin = DiskMargin(float(alpha[worst]), float(hz[worst]))
        if not refined:
            hz = np.geomspace(hz[max(worst - 1, 0)], hz[min(worst + 1, hz.size - 1)], points)
    return margin
