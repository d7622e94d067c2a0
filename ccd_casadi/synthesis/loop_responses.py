"""One loop over frequency: G, K, the gains of S, KS and T, and where they stand out."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.lti.closed_loop import largest
from ccd_casadi.lti.grid import frequency_grid, light
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.closed_loop import local_peaks, responses
from ccd_casadi.synthesis.weights import Weights

POINTS = 500  # of the frequency grid, besides those around lightly damped poles and zeros


@dataclass(frozen=True)
class Loop:
    """One design over frequency in Hz: G (k, p, m), K (k, m, p), gains of S, KS, T, and bounds.

    `bounds` are γ/|W1|, γ/|W2|, γ/|W3| (3, k). `peaks`: local maxima of σ_max(S) as (Hz, gain).
    """

    label: str
    hz: Array
    plant: NDArray[np.complex128]
    controller: NDArray[np.complex128]
    gains: Array
    bounds: Array
    bandwidth_hz: float
    peaks: tuple[tuple[float, float], ...]
    resonances_hz: tuple[float, ...]
    antiresonances_hz: tuple[float, ...]


def loop_data(
    plant: ScaledPlant,
    controller: StateSpace,
    weights: Weights,
    *,
    gamma: float,
    bandwidth_hz: float,
    omega_low: float,
    label: str = "",
) -> Loop:
    """Frequency responses of a design; `omega_low` in rad/s sets where the plots begin."""
    poles = _light(plant.system.poles * plant.omega_0)
    zeros = _light(plant.system.zeros() * plant.omega_0)
    peaks = tuple((omega / HZ, gain) for omega, gain in local_peaks(plant, controller))
    tops = [hz for hz, gain in peaks if gain > 1.05]
    low = min(omega_low / HZ, bandwidth_hz / 10.0) / 5.0
    high = max([20.0 * bandwidth_hz, *(3.0 * hz for hz in (*poles[:12], *tops))])
    around = plant.grid * plant.omega_0 / HZ
    special = [*poles, *zeros, bandwidth_hz, *(hz for hz, _ in peaks)]
    hz = frequency_grid(low, high, POINTS, around, np.array(special))
    G, K, S = responses(plant, controller, HZ * hz)
    KS = K @ S
    gains = np.array([largest(part) for part in (S, KS, G @ KS)])
    return Loop(
        label=label,
        hz=hz,
        plant=G,
        controller=K,
        gains=gains,
        bounds=gamma / np.abs(weights.responses(HZ * hz)),
        bandwidth_hz=bandwidth_hz,
        peaks=peaks,
        resonances_hz=poles,
        antiresonances_hz=zeros,
    )


def _light(roots: NDArray[Any]) -> tuple[float, ...]:
    """Frequencies in Hz of lightly damped pairs, ascending."""
    return tuple(float(value) for value in np.abs(light(roots)) / HZ)
