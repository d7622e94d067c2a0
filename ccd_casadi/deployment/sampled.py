"""The loop as it runs: plant behind a zero-order hold and a delay, controller in discrete time.

Between samples the plant sees u(t) = u_k on [kT + τ, (k+1)T + τ), and y is read at kT. This is
exact (modified z-transform in state space: the delayed inputs are states), whatever τ >= 0. S is
taken at the sampling instants: what happens between them, quantisation, an anti-aliasing filter
are not in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

from ccd_casadi.kernels.sensitivity import HALF_POWER, axis_frequencies
from ccd_casadi.lti.closed_loop import largest
from ccd_casadi.lti.grid import climbed
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array

ROUNDS = 30  # of climbing; two or three are used
CLOSE = 1e-9  # relative: by how much a peak may be missed


@dataclass(frozen=True)
class SampledFigures:
    """The loop at the sampling instants; frequencies in rad/s, NaN where the loop is unstable."""

    stable: bool
    spectral_radius: float
    sensitivity_peak: float
    sensitivity_peak_frequency: float
    bandwidth: float


def sampled_plant(plant: StateSpace, period: float, delay: float) -> StateSpace:
    """u_k to y_k behind a zero-order hold and a delay in s; states [x; u_{k-1}; …; u_{k-d-1}].

    With τ = (d + f)T, 0 <= f < 1, u_{k-d-1} acts during the first fT of a period, u_{k-d} during
    the rest. The judge's own, beside `lti.hold`.
    """
    n, m = plant.B.shape
    d = int(np.floor(delay / period + 1e-12))
    f = max(delay / period - d, 0.0)
    joint = np.zeros((n + m, n + m))
    joint[:n] = np.hstack([plant.A, plant.B])
    early, late = expm(joint * f * period), expm(joint * (1.0 - f) * period)
    step = late[:n, :n] @ early[:n, :n]
    old, new = late[:n, :n] @ early[:n, n:], late[:n, n:]
    kept = d + (f > 0.0)  # delayed inputs that have to be remembered
    A = np.zeros((n + kept * m, n + kept * m))
    B = np.zeros((n + kept * m, m))
    A[:n, :n] = step
    for age, gain in ((d, new), (d + 1, old)):
        if age == 0:
            B[:n] = gain
        elif age <= kept:
            A[:n, n + (age - 1) * m : n + age * m] = gain
    if kept:
        B[n : n + m] = np.eye(m)
        A[n + m :, n : n + (kept - 1) * m] = np.eye((kept - 1) * m)
    C = np.hstack([plant.C, np.zeros((len(plant.C), kept * m))])
    return StateSpace(A, B, C, np.zeros((len(C), m)), period=period)


def sensitivity_loop(
    plant: StateSpace, controller: StateSpace
) -> StateSpace:
    """S, r to e = r - y; the plant without feedthrough, states [plant; controller].

    The judge's own, beside `lti.closed_loop`.
    """
    G, K = plant, controller
    A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    B = np.vstack([G.B @ K.D, K.B])
    C = np.hstack([-G.C, np.zeros((len(G.C), len(K.A)))])
    return StateSpace(A, B, C, np.eye(len(C)), period=G.period)


def sampled_figures(S: StateSpace) -> SampledFigures:
    """Stability by eigenvalues, ‖S‖∞ and ω_b by level tests confirmed on the response."""
    poles = np.linalg.eigvals(S.A)
    radius = float(np.abs(poles).max())
    if not radius < 1.0:
        return SampledFigures(False, radius, np.nan, np.nan, np.nan)
    levels = _Levels(S)
    peak, at = levels.peak(np.abs(np.angle(poles)) / S.period)
    return SampledFigures(True, radius, peak, at, levels.bandwidth())


def together(parts: Sequence[SampledFigures]) -> SampledFigures:
    """The figures of a loop that is these, side by side: the worst of each."""
    top = max(parts, key=lambda f: f.sensitivity_peak)
    stable = all(f.stable for f in parts)
    radius = max(f.spectral_radius for f in parts)
    if not stable:
        return SampledFigures(False, radius, np.nan, np.nan, np.nan)
    bandwidth = float(np.min([f.bandwidth for f in parts]))  # NaN where one has none
    return SampledFigures(
        True, radius, top.sensitivity_peak, top.sensitivity_peak_frequency, bandwidth
    )


class _Levels:
    """Where σ_max(S) crosses a level: z = (1 + w)/(1 - w) maps the circle to the axis.

    There a Hamiltonian matrix has imaginary eigenvalues at the crossings. They are candidates,
    and the response itself decides. (SLICOT's AB13DD in discrete time missed peaks of these
    loops: 1.737 instead of 1.877 in one.)
    """

    def __init__(self, S: StateSpace) -> None:
        self.S = S
        inverse = np.linalg.inv(S.A + np.eye(len(S.A)))
        self.A = np.ascontiguousarray(inverse @ (S.A - np.eye(len(S.A))))
        self.B = np.ascontiguousarray(np.sqrt(2.0) * inverse @ S.B)
        self.C = np.ascontiguousarray(np.sqrt(2.0) * S.C @ inverse)
        self.D = np.ascontiguousarray(S.D - S.C @ inverse @ S.B)

    def gains(self, omega: Array) -> Array:
        """σ_max(S) at frequencies in rad/s."""
        return largest(self.S.response(omega))

    def crossings(self, level: float) -> Array:
        """Candidates in rad/s, ascending."""
        found, info = axis_frequencies(self.A, self.B, self.C, self.D, level)
        return 2.0 / self.S.period * np.arctan(found) if info == 0 else np.zeros(0)

    def bandwidth(self) -> float:
        """The first ω at which the gain passes 1/√2 from below; NaN where there is none."""
        crossings = self.crossings(HALF_POWER)
        if not len(crossings):
            return np.nan
        last = min(2.0 * crossings[-1], np.pi / self.S.period)
        ends = np.array([0.5 * crossings[0], *np.sqrt(crossings[1:] * crossings[:-1]), last])
        above = self.gains(ends) > HALF_POWER
        if above[0] or not above.any():
            return np.nan
        first = int(np.argmax(above))
        excess = lambda omega: float(self.gains(np.array([omega]))[0] - HALF_POWER)  # noqa: E731
        return float(brentq(excess, ends[first - 1], ends[first], (), 1e-12 * ends[first], 1e-14))

    def peak(self, starts: Array) -> tuple[float, float]:
        """‖S‖∞ and its frequency: climb, look for a crossing above, climb from there again."""
        points = np.append(starts, np.pi / self.S.period)
        best, at = 0.0, 0.0
        for _ in range(ROUNDS):
            gains = self.gains(points)
            top = int(gains.argmax())
            if gains[top] <= best * (1.0 + CLOSE):
                break
            best, at = self._climb(float(points[top]), float(gains[top]))
            crossings = self.crossings(best * (1.0 + CLOSE))
            points = np.append(crossings, np.sqrt(crossings[1:] * crossings[:-1]))
            if not len(points):
                break
        return best, at

    def _climb(self, start: float, gain: float) -> tuple[float, float]:
        ends = (0.9 * start, min(1.1 * start, np.pi / self.S.period))
        if ends[0] >= ends[1]:
            return gain, start
        at, top = climbed(lambda w: float(self.gains(np.array([w]))[0]), *ends, 1e-9)
        return max((gain, start), (top, at))
