"""The drive's position error by the spectra of its disturbances, and its derivatives to κ.

    y = d - Q_0 (d - r) at ω,   -Q_m (d - r) at ω + 2πm/T,   Q_m = Σ_c P_c(jω_m) hold(ω_m) K_c S

d = d_p + P_v d_f, so that σ² is the mean over time, between the samples too. d_p: 13 modes that the
fan excites; d_f: rotational vibration as a force on the arm; r: run-out that repeats with every
revolution, lines at multiples of 120 Hz. Each noise is uniform on ±½ at twenty times the
controller's rate. Numbers: PyHDDBenchmark, function_simulation.py (MIT).
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import plant as drive

from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.plant_set import PlantSet
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.kernels.sections import INTEGRATOR, PAIR

HZ = 2.0 * np.pi
TRACK = 52.697e-9  # m
STROKE = 14.6e-9  # m, the most of the piezo in a second under the benchmark's own controllers
ALIASES = (0, -1, 1)  # the piezo rings at 40 kHz, which the samples take for 10 kHz
PER_SECOND = 4.6  # standard deviations that a second's largest is away
# Gain, damping ratio and Hz of what the fan excites; the vibration's shape is in `vibration`.
FAN = ((0.6, 0.008, 2200), (0.3, 0.005, 2937), (1, 0.005, 3300), (0.5, 0.005, 3545),
       (0.3, 0.002, 3980), (1, 0.01, 4220), (1, 0.008, 4380), (0.5, 0.002, 5072),
       (2, 0.003, 5370), (15, 0.04, 5850), (10, 0.008, 6660), (1.5, 0.003, 7670),
       (2.5, 0.07, 9200))  # fmt: skip
NOISE = 2.0 / 12.0 / (20.0 * drive.RATE_HZ)  # one-sided density per Hz


def response_and_slopes(
    structure: Structure, kappa: np.ndarray, s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """K(s) and ∂ln K/∂κ with the parameters as the last axis."""
    values = np.exp(kappa)
    slopes = np.zeros((*s.shape, len(kappa)), complex)
    slopes[..., 0] = 1.0
    for kind, sign, at in structure.factors[1:].tolist():
        x = values[at] / s if kind == INTEGRATOR else s / values[at]
        middle = 2.0 * values[at + 1] * x if kind == PAIR else 0.0
        factor = 1.0 + middle + x * x if kind == PAIR else 1.0 + x
        first = -middle - 2.0 * x * x if kind == PAIR else x if kind == INTEGRATOR else -x
        slopes[..., at] = sign * first / factor
        if kind == PAIR:
            slopes[..., at + 1] = sign * middle / factor
    return structure.response(kappa, s), slopes


def run_out() -> np.ndarray:
    """Variances of r in m² at multiples of 120 Hz, half the square of the amplitudes kept."""
    file = Path(__file__).with_name("run_out.json")
    return 0.5 * (1e-12 * np.array(json.loads(file.read_text())["amplitude_pm"])) ** 2


def fan(s: np.ndarray) -> np.ndarray:
    """Density of d_p, m²/Hz."""
    found = np.zeros(s.shape)
    for gain, zeta, hz in FAN:
        w = HZ * hz
        found += np.abs(gain / (s**2 + 2.0 * zeta * w * s + w**2)) ** 2
    return NOISE * found


def vibration(s: np.ndarray) -> np.ndarray:
    """Density of P_v d_f with the arm as a free mass, which it is where d_f has its power."""
    w = HZ * np.array([50.0, 3.0, 2000.0, 250.0])
    shape = (s + w[0]) / (s + w[1]) * (s**2 + 40.0 * w[2] * s + w[2] ** 2)
    shape = 3e-10 * (shape / (s**2 + 0.2 * w[3] * s + w[3] ** 2) - 1.0)  # without direct part
    return NOISE * np.abs(shape * drive.VCM["gain"] / s**2) ** 2


def grid() -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in Hz and weights of the trapezoidal rule: fine about every mode."""
    half = 0.5 * drive.RATE_HZ
    parts = [np.geomspace(1.0, 0.9999 * half, 300), np.linspace(500.0, 0.9999 * half, 250)]
    for _, zeta, hz in FAN:
        parts.append(hz * (1.0 + zeta * np.array([-4, -2.5, -1.5, -1, -0.6, -0.3, 0, 0.3, 0.6, 1,
                                                  1.5, 2.5, 4])))  # fmt: skip
    hz = np.unique(np.concatenate(parts))
    step = np.diff(hz)
    return hz, 0.5 * (np.append(step, 0.0) + np.insert(step, 0, 0.0))


@dataclass(frozen=True)
class PositionError:
    """ln of the RMS error over some plants of a set, with a payment for stroke that is too long.

    `lines` (k,): variance of the run-out in m² at multiples of 120 Hz.
    """

    plants: PlantSet
    structure: ChannelStructure
    which: Sequence[int]
    lines: np.ndarray
    dear: float = 4.0

    @cached_property
    def sources(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """v of every frequency over ω₀, and variances that enter as d and as r there."""
        hz, width = grid()
        s = 1j * HZ * hz
        d = (fan(s) + vibration(s)) * width
        at = 120.0 * np.arange(1, len(self.lines) + 1)
        hz = np.concatenate([hz, at])
        v = self.plants.variable(HZ * hz / self.plants.omega_0)
        none = np.zeros(len(at))
        return v, np.concatenate([d, none]), np.concatenate([np.zeros(len(width)), self.lines])

    @cached_property
    def responses(self) -> tuple[np.ndarray, np.ndarray]:
        """G at the samples (plants, frequencies, 2), and of the held plant between them: P(jω_m)
        (1 - e^{-jω_m T})/(jω_m T) at ω_m = ω + 2πm/T (plants, aliases, frequencies, 2)."""
        P, v = self.plants, self.sources[0]
        assert P.period is not None
        omega = P.frequency(v) + 2.0 * np.pi / P.period * np.array(ALIASES)[:, None]
        turn = 1j * omega * P.period
        hold = -np.expm1(-turn) / turn
        at, held = [], []
        for i in self.which:
            at.append(P.responses(np.full(len(v), i), v)[0][:, 0])
            modes = 1.0 / (1j * omega[..., None] - P.poles[i])
            held.append(hold[..., None] * (modes @ P.residues[i, :, 0, :]))
        return np.array(at), np.array(held)

    def figures(self, kappa: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """σ² of y and y_p (plants,), and their derivatives (plants, n) to κ."""
        v, d, r = self.sources
        K, slopes = np.zeros((2, len(v)), complex), np.zeros((2, len(v), len(kappa)), complex)
        for c, (own, place) in enumerate(
            zip(self.structure.structures, self.structure.slices, strict=True)
        ):
            K[c], slopes[c][:, place] = response_and_slopes(own, kappa[place], 1j * v)
        rows = []
        for G, held in zip(*self.responses, strict=True):
            L = G.T * K
            S = 1.0 / (1.0 + L.sum(0))
            SdL = S[:, None] * np.einsum("cf,cfn->fn", L, slopes)
            y = p = 0.0
            dy, dp = np.zeros(len(kappa)), np.zeros(len(kappa))
            for m, H in zip(ALIASES, held, strict=True):
                parts = H.T * K * S
                Q = parts.sum(0)
                dQ = np.einsum("cf,cfn->fn", parts, slopes) - Q[:, None] * SdL
                # 1 - Q, which is small: what the samples take for L from elsewhere remains
                E = -Q if m else S * (1.0 + (L - H.T * K).sum(0))
                y += d @ np.abs(E) ** 2 + r @ np.abs(Q) ** 2
                dy += 2.0 * ((r * Q.conj() - d * E.conj()) @ dQ).real
                P2 = (d + r) * np.abs(parts[1]) ** 2
                p += P2.sum()
                dp += 2.0 * (P2 @ (slopes[1] - SdL)).real
            rows.append((y, p, dy, dp))
        y, p, dy, dp = (np.array(part) for part in zip(*rows, strict=True))
        return y, p, dy, dp

    def __call__(self, kappa: np.ndarray) -> tuple[float, np.ndarray]:
        """Half the logarithm of the mean of σ⁴/σ² over the plants, nearly the worst, and slopes."""
        y, p, dy, dp = self.figures(kappa)
        power = 6
        mean = (y**power).mean()
        value = 0.5 / power * float(np.log(mean))
        slope = 0.5 / mean * ((y ** (power - 1))[:, None] * dy).mean(0)
        over = np.maximum(0.5 * np.log(p / (STROKE / PER_SECOND) ** 2), 0.0)
        value += self.dear * float((over**2).mean())
        slope = slope + self.dear * ((over / p)[:, None] * dp).mean(0)
        return value, slope
