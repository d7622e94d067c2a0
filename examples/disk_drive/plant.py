"""The nine plants of a dual-stage hard-disk drive: one sensor, two actuators (VCM and PZT).

    y = P_v u_v + P_p u_p,   P(s) = g Σ κ_i/(s² + 2 ζ_i ω_i s + ω_i²)

Data: PyHDDBenchmark (github.com/liuzd1997/PyHDDBenchmark, MIT licence), a Python version of the
Magnetic-head Positioning Control System in HDDs by T. Atsumi (IEEJ, MATLAB Central 111515); T.
Atsumi and S. Yabui, IEEE Trans. Ind. Electron. 67(11), 2020. y in tracks, u_v and u_p as there.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from ccd_casadi.lti.state_space import StateSpace

RATE_HZ = 7200 / 60 * 420  # revolutions a second times sectors
VCM = {
    "gain": 3.7976e7,
    "hz": [0, 5300, 6100, 6500, 8050, 9600, 14800, 17400, 21000, 26000, 26600, 29000, 32200, 38300,
           43300, 44800],
    "kappa": [1, -1.0, 0.1, -0.1, 0.04, -0.7, -0.2, -1, 3, -3.2, 2.1, -1.5, 2, -0.2, 0.3, -0.5],
    "zeta": [0, 0.02, 0.04, 0.02, 0.01, 0.03, 0.01, 0.02, 0.02, 0.012, 0.007, 0.01, 0.03, 0.01,
             0.01, 0.01],
}  # fmt: skip
PZT = {
    "hz": [14800, 21500, 28000, 40200, 42050, 44400, 46500, 100000],
    "kappa": [-0.005, -0.01, -0.1, 0.8, 0.3, -0.25, 0.3, 10],
    "zeta": [0.025, 0.03, 0.05, 0.008, 0.008, 0.01, 0.02, 0.3],
}
TEMPERATURES = {"cold": -1.0, "room": 0.0, "hot": 1.0}
PZT_GAINS = (1.0, 1.05, 0.95)


def factors(temperature: float) -> tuple[float, float, float]:
    """On frequencies of VCM and PZT, and on damping ratios; from -1 (cold) to 1 (hot)."""
    return 1.0 - 0.04 * temperature, 1.0 - 0.06 * temperature, 1.0 + 0.2 * temperature


def plants(
    temperatures: Sequence[float] = tuple(TEMPERATURES.values()),
    gains: Sequence[float] = PZT_GAINS,
    soft_hz: float = 0.0,
) -> list[StateSpace]:
    """Plants in SI (state space, two inputs): at these temperatures, with each of the PZT's gains.

    By default the nine of the benchmark in the order of its cases. `soft_hz` > 0 holds the arm by a
    spring with damping ratio 0.7 at this frequency in place of the double integrator, since the
    synthesis takes stable plants: at 100 `soft_hz` the two differ by 1.4 %, at 1000 by 0.14 %.
    """
    return [_plant(factors(t), gain, soft_hz) for gain in gains for t in temperatures]


def _plant(scales: tuple[float, float, float], pzt_gain: float, soft_hz: float) -> StateSpace:
    on_vcm, on_pzt, on_damping = scales
    omega = 2.0 * np.pi * on_vcm * np.array(VCM["hz"], float)
    zeta = on_damping * np.array(VCM["zeta"], float)
    if soft_hz > 0.0:
        omega[0], zeta[0] = 2.0 * np.pi * soft_hz, 0.7
    vcm = _modes(omega, zeta, VCM["gain"] * np.array(VCM["kappa"]))
    omega = 2.0 * np.pi * on_pzt * np.array(PZT["hz"], float)
    kappa = np.array(PZT["kappa"], float)
    gain = pzt_gain / abs(float((kappa / omega**2).sum()))
    pzt = _modes(omega, on_damping * np.array(PZT["zeta"]), gain * kappa)
    parts = zip(vcm, pzt, strict=True)
    A, B, C = (join(pair) for join, pair in zip((_blocks, _blocks, np.hstack), parts, strict=True))
    return StateSpace(A, B, C, np.zeros((1, 2)))


def _blocks(pair: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return np.asarray(block_diag(*pair))


def _modes(omega: np.ndarray, zeta: np.ndarray, gain: np.ndarray) -> tuple[np.ndarray, ...]:
    """(A, B, C) of Σ gain/(s² + 2 ζ ω s + ω²), its states in like units."""
    n = len(omega)
    unit = np.where(omega > 0.0, omega, 2.0 * np.pi * 100.0)
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.diag(unit)
    A[n:, :n] = -np.diag(omega**2 / unit)
    A[n:, n:] = -np.diag(2.0 * zeta * omega)
    B = np.concatenate([np.zeros(n), gain / unit])[:, None]
    return A, B, np.concatenate([np.ones(n), np.zeros(n)])[None]
