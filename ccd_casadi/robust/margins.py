"""Margins of a loop, and its signals under noise."""

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
    """RMS of every output and every input under given densities; inf where they are not finite."""

    position_by_noise: Array
    force_by_noise: Array
    position_by_disturbance: Array
    force_by_disturbance: Array


def gains(G: NDArray, K: NDArray) -> Array:
    """σ_max of S, T, GS (disturbance force to position) and KS (noise to force), rows (4, k)."""
    found = responses_of(G, K)
    return np.array([sigma_max(found[name]) for name in ("S", "T", "GS", "KS")])


def norms(loop: ClosedLoop) -> tuple[tuple[float, float], ...]:
    """‖·‖∞ of S, T, GS and KS, each with its frequency in rad/s (0: at rest), without a grid."""
    return tuple(hinf_norm(part) for part in (loop.S, loop.T, loop.GS, loop.KS))


def highest(gain: Callable[[Array], Array], omega: Array) -> tuple[tuple[float, float], ...]:
    """The largest value of each row of gains (r, k), climbed from a grid in rad/s, and its ω.

    Of a loop in discrete time, from far below the grid to its end.
    """
    omega = np.concatenate([1e-3 * omega[:1], omega])  # a constant signal
    values, found = gain(omega), []
    for row, i in enumerate(values.argmax(axis=1)):
        ends = omega[max(i - 1, 0)], omega[min(i + 1, len(omega) - 1)]
        top = refine_peak(partial(_of_row, gain, row), *ends)
        tops = (float(values[row, i]), 0.0 if i == 0 else float(omega[i]))
        found.append(max(tops, top[::-1]) if i else tops)
    return tuple(found)


def _of_row(gain: Callable[[Array], Array], row: int, omega: float) -> float:
    return float(gain(np.array([omega]))[row, 0])


def noise(loop: Loop, sensor: float, disturbance: float) -> Noise:
    """RMS values for white sensor noise (m/√Hz) and white force at every input (N/√Hz).

    They are those of an error budget of both sources: of a sampled loop at its instants.
    """
    found = []
    for kind, density in ((SourceKind.SENSOR_NOISE, sensor), (SourceKind.FORCE, disturbance)):
        of = process(loop, ErrorSource(kind.value, kind, ShapedSpectrum(density**2))).balanced()
        P = Lyapunov(of.A, sampled=of.sampled).covariance(of.noise)
        position, force = (np.einsum("ij,jk,ik->i", C, P, C) for C in (of.C, of.F))
        force = np.full_like(force, np.inf) if of.infinite_force else force + (of.V**2).sum(1)
        found += [np.sqrt(np.maximum(position, 0.0)), np.sqrt(np.maximum(force, 0.0))]
    return Noise(*found)


@dataclass(frozen=True)
class DiskMargin:
    """The disk margin of a loop (balanced, σ = 0): 1/α = ‖S - ½‖∞, of channels its bound on μ.

    Attributes
    ----------
    alpha, hz : float
        α, and where it is least.

    References
    ----------
    P. Seiler, A. Packard and P. Gahinet, IEEE Control Systems Magazine 40 (2020) 78-95.
    """

    alpha: float
    hz: float

    @property
    def gain(self) -> float:
        """The loop's gain may be multiplied by anything from 1/gain to gain."""
        return (2.0 + self.alpha) / (2.0 - self.alpha) if self.alpha < 2.0 else math.inf

    @property
    def phase_deg(self) -> float:
        """And its phase changed by less than this."""
        return math.degrees(2.0 * math.atan(self.alpha / 2.0))


@dataclass(frozen=True)
class LoopMargins:
    """One loop broken at a plant output or input, the others closed.

    `gain_up` and `gain_down` are the nearest factors above and below 1 at which stability is lost
    (inf and 0 where there are none), `phase_deg` the least phase margin, `crossover_hz` the first
    frequency at which |L| falls through 1.
    """

    name: str
    gain_up: float
    gain_down: float
    phase_deg: float
    crossover_hz: float
    disk: DiskMargin


@dataclass(frozen=True)
class Margins:
    """Of every loop alone, and of all outputs, or all inputs, at once."""

    loops: tuple[LoopMargins, ...]
    outputs: DiskMargin
    inputs: DiskMargin


def margins(respond: PlantAndController, hz: Array) -> Margins:
    """Margins of a loop from its responses in SI, on a grid in Hz that resolves resonances.

    The grid only brackets: crossings are bisected on the response itself, and the least disk margin
    is searched again between its neighbours. Of a sampled loop the grid ends at half its rate.
    """
    loops, together = [], []
    for name in ("output", "input"):
        L = partial(_broken, respond, name)
        for i in range(L(HZ * hz[:1]).shape[1]):
            loops.append(_loop(f"{name} {i + 1}", partial(_alone, L, i), hz))
        together.append(_least(L, hz))
    return Margins(tuple(loops), *together)


def _broken(respond: PlantAndController, name: str, omega: Array) -> NDArray:
    G, K = respond(omega)
    return np.asarray(G @ K if name == "output" else K @ G)


def _alone(L: Callable[[Array], NDArray], i: int, omega: Array) -> NDArray:
    return equivalent_open_loop(L(omega), i)


def _loop(name: str, L: Callable[[Array], NDArray], hz: Array) -> LoopMargins:
    found = classical_margins(L, HZ * hz)
    return LoopMargins(
        name=name,
        gain_up=found.gain_up,
        gain_down=found.gain_down,
        phase_deg=found.phase_deg,
        crossover_hz=found.crossover / HZ,
        disk=_least(lambda omega: L(omega)[:, None, None], hz),
    )


def _least(L: Callable[[Array], NDArray], hz: Array, *, points: int = 61) -> DiskMargin:
    """The least disk margin of all channels at once on the grid, then at `points` around it."""
    for last in (False, True):
        eye = np.eye((response := L(HZ * hz)).shape[1])
        alpha = 1.0 / mu_bound(sensitivity(response) - 0.5 * eye)
        worst = int(alpha.argmin())
        found = DiskMargin(float(alpha[worst]), float(hz[worst]))
        if not last:
            hz = np.geomspace(hz[max(worst - 1, 0)], hz[min(worst + 1, hz.size - 1)], points)
    return found
