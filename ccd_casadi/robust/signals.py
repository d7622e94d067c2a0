"""From disturbance force and sensor noise to position and force: responses and RMS values.

y = G S_i d - T n,   u = S_i d - K S n    (r = 0, S_i = (I + KG)⁻¹, e = -y - n)
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.budget.derivatives import Lyapunov
from ccd_casadi.budget.loops import process
from ccd_casadi.budget.sources import Kind, ShapedSpectrum, Source
from ccd_casadi.lti.closed_loop import ClosedLoop, responses_of, sigma_max
from ccd_casadi.lti.grid import refine_peak
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.support.arrays import Array

REST = 1e-3  # of the lowest frequency of a grid: what counts as constant


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

    Of a loop in discrete time, from far below the grid (a constant signal) to its end.
    """
    omega = np.concatenate([REST * omega[:1], omega])
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
    for kind, density in ((Kind.SENSOR_NOISE, sensor), (Kind.FORCE, disturbance)):
        of = process(loop, Source(kind.value, kind, ShapedSpectrum(density**2))).balanced()
        P = Lyapunov(of.A, sampled=of.sampled).covariance(of.noise)
        position, force = (np.einsum("ij,jk,ik->i", C, P, C) for C in (of.C, of.F))
        force = np.full_like(force, np.inf) if of.infinite_force else force + (of.V**2).sum(1)
        found += [np.sqrt(np.maximum(position, 0.0)), np.sqrt(np.maximum(force, 0.0))]
    return Noise(*found)
