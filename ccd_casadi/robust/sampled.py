"""The loop as it runs: plant behind a zero-order hold and a delay, controller in discrete time.

Between samples the plant sees u(t) = u_k on [kT + τ, (k+1)T + τ), and y is read at kT. This is
exact (modified z-transform in state space: the delayed inputs are states), whatever τ >= 0. S is
taken at the sampling instants: what happens between them, quantisation, an anti-aliasing filter
are not in it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from ccd_casadi.kernels.sensitivity import HALF_POWER, axis_frequencies
from ccd_casadi.lti.closed_loop import sigma_max
from ccd_casadi.lti.grid import frequency_grid, root_flanks
from ccd_casadi.lti.hold import in_w
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.robust.signals import highest

PER_DECADE, DECADES = 60, 6  # of a grid of compliance, below the Nyquist frequency


@dataclass(frozen=True)
class SampledFigures:
    """The loop at the sampling instants; frequencies in rad/s, NaN where the loop is unstable."""

    stable: bool
    spectral_radius: float
    sensitivity_peak: float
    sensitivity_peak_frequency: float
    bandwidth: float


def sampled_figures(S: StateSpace) -> SampledFigures:
    """Stability by eigenvalues, ‖S‖∞ and ω_b by level tests confirmed on the response."""
    poles = np.linalg.eigvals(S.A)
    radius = float(np.abs(poles).max())
    if not radius < 1.0:
        return SampledFigures(False, radius, np.nan, np.nan, np.nan)
    return SampledFigures(True, radius, *hinf_norm(S), _bandwidth(S))


def worst_figures(parts: Sequence[SampledFigures]) -> SampledFigures:
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


def sampled_compliance(plant: StateSpace, S: StateSpace) -> float:
    """max over ω up to π/T of σ_max(S(e^{jωT}) G(jω)), m/N; the plant in SI without hold and delay.

    A sinusoidal force f beside the held one acts without a break: the outputs at the instants are
    S G f. What faster forces leave (aliased) is not in it. S is stable.
    """
    end = np.pi / S.period
    near = root_flanks(np.concatenate([S.rates, plant.poles]))
    grid = frequency_grid(end * 10.0**-DECADES, end, DECADES * PER_DECADE, near)
    return highest(lambda at: sigma_max(S.response(at) @ plant.response(at))[None], grid)[0][0]


def _bandwidth(S: StateSpace) -> float:
    """The first ω at which σ_max(S) passes 1/√2 from below; NaN where there is none.

    Over w the circle is the axis, where a Hamiltonian matrix has imaginary eigenvalues at the
    crossings. They are candidates, and the response itself decides. (SLICOT's AB13DD in discrete
    time missed peaks of these loops: 1.737 instead of 1.877 in one.)
    """
    T, over_w = S.period, in_w(S)
    parts = (np.ascontiguousarray(getattr(over_w, name)) for name in "ABCD")
    found, info = axis_frequencies(*parts, HALF_POWER)
    crossings = 2.0 / T * np.arctan(0.5 * T * found)
    if info or not len(crossings):
        return np.nan
    last = min(2.0 * crossings[-1], np.pi / T)
    ends = np.array([0.5 * crossings[0], *np.sqrt(crossings[1:] * crossings[:-1]), last])
    above = sigma_max(S.response(ends)) > HALF_POWER
    if above[0] or not above.any():
        return np.nan
    first = int(np.argmax(above))
    excess = lambda omega: float(sigma_max(S.response(np.array([omega])))[0] - HALF_POWER)  # noqa: E731
    return float(brentq(excess, ends[first - 1], ends[first], (), 1e-12 * ends[first], 1e-14))
