"""Scalar channels of a loop, and what is exact of each: ‖S‖∞ and ω_b, continuous or sampled.

Channels are the parts along directions in which plant and controller decouple.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from ccd_casadi.kernels.sensitivity import HALF_POWER, axis_frequencies
from ccd_casadi.lti.loop import in_w
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.state_space import ClosedLoop, StateSpace, sigma_max
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class SampledFigures:
    """The figures of a loop at its sampling instants.

    Attributes
    ----------
    stable, spectral_radius : bool, float
    sensitivity_peak, sensitivity_peak_frequency, bandwidth : float
        ‖S‖∞, where it is, and ω_b, in rad/s; NaN where the loop is unstable.
    """

    stable: bool
    spectral_radius: float
    sensitivity_peak: float
    sensitivity_peak_frequency: float
    bandwidth: float


def sampled_figures(S: StateSpace) -> SampledFigures:
    """Measure a loop: stability by eigenvalues, ‖S‖∞ and ω_b by level tests.

    Parameters
    ----------
    S : StateSpace
        In discrete time; a continuous one has no spectral radius.

    Returns
    -------
    SampledFigures
    """
    radius = float(np.abs(S.poles).max()) if S.period else np.nan
    if not S.stable:
        return SampledFigures(False, radius, np.nan, np.nan, np.nan)
    return SampledFigures(True, radius, *hinf_norm(S), _bandwidth(S))


def worst_figures(parts: Sequence[SampledFigures]) -> SampledFigures:
    """Take the worst of each figure of loops that run side by side.

    Parameters
    ----------
    parts : sequence of SampledFigures

    Returns
    -------
    SampledFigures
        The bandwidth is NaN where one has none.
    """
    top = max(parts, key=lambda f: f.sensitivity_peak)
    stable = all(f.stable for f in parts)
    radius = max(f.spectral_radius for f in parts)
    if not stable:
        return SampledFigures(False, radius, np.nan, np.nan, np.nan)
    bandwidth = float(np.min([f.bandwidth for f in parts]))  # NaN where one has none
    return SampledFigures(
        True, radius, top.sensitivity_peak, top.sensitivity_peak_frequency, bandwidth
    )


def loop_figures(loop: ClosedLoop, places: Sequence[BreakPoint] = ()) -> SampledFigures:
    """Measure a loop, that of several sensors on one actuator wherever it may be broken.

    Parameters
    ----------
    loop : ClosedLoop
        Of all sensors.
    places : sequence of BreakPoint
        First that whose error counts.

    Returns
    -------
    SampledFigures
        ‖S‖∞ is the largest of all places, ω_b that of the first.
    """
    loops = [place.close_loop(loop) for place in places] or [loop]
    parts = [sampled_figures(one.S) for one in loops]
    return replace(worst_figures(parts), bandwidth=parts[0].bandwidth)


def _bandwidth(S: StateSpace) -> float:
    """The first ω at which σ_max(S) exceeds 1/√2; NaN where there is none.

    Over w the circle is the axis, where a Hamiltonian matrix has imaginary eigenvalues at the
    crossings. They are candidates, and the response itself decides. (SLICOT's AB13DD in discrete
    time missed peaks of these loops: 1.737 instead of 1.877 in one.)
    """
    T, over_w = S.period, in_w(S) if S.period else S
    parts = (np.ascontiguousarray(getattr(over_w, name)) for name in "ABCD")
    found, info = axis_frequencies(*parts, HALF_POWER)
    crossings = 2.0 / T * np.arctan(0.5 * T * found) if T else found
    if info or not len(crossings):
        return np.nan
    last = min(2.0 * crossings[-1], np.pi / T) if T else 2.0 * crossings[-1]
    ends = np.array([0.5 * crossings[0], *np.sqrt(crossings[1:] * crossings[:-1]), last])
    above = sigma_max(S.response(ends)) > HALF_POWER
    if above[0] or not above.any():
        return np.nan
    first = int(np.argmax(above))
    excess = lambda omega: float(sigma_max(S.response(np.array([omega])))[0] - HALF_POWER)  # noqa: E731
    return float(brentq(excess, ends[first - 1], ends[first], (), 1e-12 * ends[first], 1e-14))


@dataclass(frozen=True)
class LoopChannel:
    """A part of the loop, Uᵀ G V and Vᵀ K U.

    Attributes
    ----------
    name : str
        Its number, or "all".
    outputs, inputs : (p, k), (m, k) array
        U and V.
    plant : ScaledPlant
        Uᵀ G V.
    controller : StateSpace
        Vᵀ K U, SI.
    places : tuple of BreakPoint
        Of several sensors on one actuator.
    """

    name: str
    outputs: Array
    inputs: Array
    plant: ScaledPlant
    controller: StateSpace
    places: tuple[BreakPoint, ...] = ()


def whole_loop(
    plant: ScaledPlant, controller: StateSpace, places: tuple[BreakPoint, ...] = ()
) -> tuple[LoopChannel, ...]:
    """Take the loop as one channel.

    Parameters
    ----------
    plant, controller : ScaledPlant, StateSpace
    places : tuple of BreakPoint
        Of several sensors on one actuator.

    Returns
    -------
    tuple of one LoopChannel
    """
    p, m = plant.C.shape[0], plant.B.shape[1]
    return (LoopChannel("all", np.eye(p), np.eye(m), plant, controller, places),)


def scalar_channels(plant: ScaledPlant, controller: StateSpace) -> tuple[LoopChannel, ...]:
    """The scalar channels of a loop, or the whole loop as one channel.

    Parameters
    ----------
    plant : ScaledPlant
        With its decoupling directions.
    controller : StateSpace
        e in, u out, SI.

    Returns
    -------
    tuple of LoopChannel
        One for each output where plant and controller are diagonal along the directions.
    """
    p, m = plant.C.shape[0], plant.B.shape[1]
    U = np.hstack([c.outputs for c in plant.channels] or [np.eye(p)])
    V = np.hstack([c.inputs for c in plant.channels] or [np.eye(m)])
    if not (U.shape == (p, p) and V.shape == (m, m) and p == m > 1):
        return whole_loop(plant, controller)
    omega = plant.grid * plant.omega_0
    G, K = plant.plant_si().response(omega), controller.response(omega)
    if not (_diagonal(U.T @ G @ V) and _diagonal(V.T @ K @ U)):
        return whole_loop(plant, controller)
    found = []
    for i in range(p):
        u, v = U[:, [i]], V[:, [i]]
        part = StateSpace(
            controller.A, controller.B @ u, v.T @ controller.C, v.T @ controller.D @ u
        )
        found.append(LoopChannel(str(i + 1), u, v, along_directions(plant, u, v), part))
    return tuple(found)


def along_directions(plant: ScaledPlant, u: Array, v: Array) -> ScaledPlant:
    """Take uᵀ G v of a plant.

    Parameters
    ----------
    plant : ScaledPlant
    u, v : (p, k), (m, k) array
        Directions of its outputs and inputs.

    Returns
    -------
    ScaledPlant
    """
    B, C = np.ascontiguousarray(plant.B @ v), np.ascontiguousarray(u.T @ plant.C)
    return replace(plant, B=B, C=C, channels=())


def _diagonal(response: np.ndarray, rounding: float = 1e-8) -> bool:
    """Whether what is off the diagonal is at most this share of the gain."""
    off = response * (1.0 - np.eye(response.shape[1]))
    return bool(np.abs(off).max() <= rounding * np.abs(response).max())
