"""Gain, phase and disk margins: every loop alone, and all of them at once.

With L_i = 1/S_ii - 1, the loop that channel i sees while the others are closed, the symmetric disk
margin is α = 1/max|S_ii - 1/2|: the loop is stable for every factor inside the disk through
(2 - α)/(2 + α) and its inverse, that is for any gain in between or any phase up to 2 arctan(α/2).
All loops at once: 1/α is the structured singular value of S - I/2 (diagonal, complex), bounded
from above (`mu_bound`), so that α is a lower bound. (Seiler, Packard and Gahinet 2020.)
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.plants.scaling import ScaledPlant, StateSpace
from ccd_casadi.robust.mu_bound import mu_bound
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.classical_margins import classical_margins
from ccd_casadi.synthesis.closed_loop import responses

FINE = 60  # points between the neighbours of the least disk margin found


@dataclass(frozen=True)
class DiskMargin:
    """α, where it is least (Hz), and the gain (factor) and phase (degrees) that it allows."""

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


def margins(
    plant: ScaledPlant, controller: StateSpace, hz: Array, G: NDArray, K: NDArray
) -> Margins:
    """Margins from G (k, p, m) and K (k, m, p) in SI, on a grid in Hz that resolves resonances."""
    loops = []
    for name, L in (("output", G @ K), ("input", K @ G)):
        S = np.linalg.inv(np.eye(L.shape[1]) + L)
        for i in range(L.shape[1]):
            loops.append(_loop(f"{name} {i + 1}", hz, 1.0 / S[:, i, i] - 1.0))

    def both(omega: Array) -> tuple[NDArray, NDArray]:
        g, k, _ = responses(plant, controller, omega)
        return g, k

    outputs = _together(lambda omega: np.matmul(*both(omega)), G @ K, hz)
    inputs = _together(lambda omega: np.matmul(*both(omega)[::-1]), K @ G, hz)
    return Margins(tuple(loops), outputs, inputs)


def sampled_margins(hz: Array, G: NDArray, K: NDArray) -> Margins:
    """The same from responses alone, of a sampled loop up to half its rate."""
    loops, together = [], []
    for name, L in (("output", G @ K), ("input", K @ G)):
        S = np.linalg.inv(np.eye(L.shape[1]) + L)
        for i in range(L.shape[1]):
            loops.append(_loop(f"{name} {i + 1}", hz, 1.0 / S[:, i, i] - 1.0))
        alpha = 1.0 / mu_bound(S - 0.5 * np.eye(S.shape[1]))
        worst = int(alpha.argmin())
        together.append(DiskMargin(float(alpha[worst]), float(hz[worst])))
    return Margins(tuple(loops), together[0], together[1])


def _loop(name: str, hz: Array, L: NDArray) -> LoopMargins:
    from scipy.interpolate import CubicSpline  # slow to import

    found = classical_margins(CubicSpline(HZ * hz, L), HZ * hz)
    distance = np.abs(1.0 / (1.0 + L) - 0.5)
    worst = int(distance.argmax())
    return LoopMargins(
        name=name,
        gain_up=found.gain_up,
        gain_down=found.gain_down,
        phase_deg=found.phase_deg,
        crossover_hz=found.crossover / HZ,
        disk=DiskMargin(float(1.0 / distance[worst]), float(hz[worst])),
    )


def _together(loop: Callable[[Array], NDArray], L: NDArray, hz: Array) -> DiskMargin:
    """The least disk margin on the grid, then on a finer one around it."""
    for last in (False, True):
        eye = np.eye(L.shape[1])
        alpha = 1.0 / mu_bound(np.linalg.inv(eye + L) - 0.5 * eye)
        worst = int(alpha.argmin())
        found = DiskMargin(float(alpha[worst]), float(hz[worst]))
        if not last:
            ends = hz[max(worst - 1, 0)], hz[min(worst + 1, hz.size - 1)]
            hz = np.geomspace(*ends, FINE)
            L = loop(HZ * hz)
    return found
