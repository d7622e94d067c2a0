"""Margins and norms of a loop, and the RMS of its signals under white noise.

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
from ccd_casadi.lti.frequency_grid import refine_peak
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import (
    ClosedLoop,
    equivalent_open_loop,
    responses_of,
    sensitivity,
    sigma_max,
)
from ccd_casadi.robust.structured_singular_value import mu_bound
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import PlantAndController, classical_margins


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
        model = process(loop, ErrorSource(kind.value, kind, ShapedSpectrum(density**2))).balanced()
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
