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
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.lti.closed_loop import equivalent_open_loop, sensitivity
from ccd_casadi.robust.mu_bound import mu_bound
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.classical_margins import PlantAndController, classical_margins

FINE = 61  # points between the neighbours of the least disk margin found


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


def margins(respond: PlantAndController, hz: Array) -> Margins:
    """Margins of a loop from its responses in SI, on a grid in Hz that resolves resonances.

    The grid only brackets: crossings are bisected on the response itself, and the least disk margin
    is looked for again between its neighbours. Of a sampled loop the grid ends at half its rate.
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


def _least(L: Callable[[Array], NDArray], hz: Array) -> DiskMargin:
    """The least disk margin of all channels at once on the grid, then on a finer one around it."""
    for last in (False, True):
        eye = np.eye((response := L(HZ * hz)).shape[1])
        alpha = 1.0 / mu_bound(sensitivity(response) - 0.5 * eye)
        worst = int(alpha.argmin())
        found = DiskMargin(float(alpha[worst]), float(hz[worst]))
        if not last:
            hz = np.geomspace(hz[max(worst - 1, 0)], hz[min(worst + 1, hz.size - 1)], FINE)
    return found
