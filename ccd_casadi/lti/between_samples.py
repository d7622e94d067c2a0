"""S of a sampled loop between its sampling instants.

A disturbance e^{jωt} at the outputs, ω < π/T, is sampled as z^k with z = e^{jωT}. In the steady
state the force is u_k = -K(z) S(z) z^k, held and delayed. A time τ after an instant the plant gives

    y(kT + τ) = P_τ(z) u_k,        0 <= τ < T,

where P_τ is the transfer function from u_k to the output at that time (the modified z-transform:
Jury 1964). The sum of disturbance and output is e^{jω(kT + τ)} S_τ(jω) with

    S_τ(jω) = I - e^{-jωτ} P_τ(z) K(z) S(z).

S_0 is the S of the instants, and at τ = T it returns, as P_T = z P_0. The largest σ_max(S_τ) over τ
is what a disturbance of one frequency becomes at any time. Beyond half the rate a disturbance is
sampled as one of another frequency, which no bound on S covers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm

from ccd_casadi.lti.frequency_grid import local_maxima, zoom
from ccd_casadi.lti.loop import Loop, Sampling, delay_parts, zoh
from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.state_space import StateSpace, sensitivity, sigma_max
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class BetweenOptions:
    """Numbers of the search between the samples."""

    times: int = 8  # of a period at which S_τ is evaluated, evenly spread from the instant on
    near: float = 0.9  # share of the largest value: lower local maxima are not refined
    plants: int = 12  # of a set: those with the largest peaks at the instants


@dataclass(frozen=True)
class BetweenSamples:
    """The largest σ_max(S_τ) of one or several loops.

    Attributes
    ----------
    peak, at_instants : float
        Over all τ, and of τ = 0 alone.
    frequency : float
        Of `peak`, rad/s.
    share : float
        τ/T of `peak`.
    """

    peak: float
    at_instants: float
    frequency: float
    share: float

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of result.json and deploy.json."""
        return {
            "sensitivity_peak": self.peak,
            "at_instants": self.at_instants,
            "frequency_hz": self.frequency / HZ,
            "share_of_period": self.share,
        }


def held_between(G: StateSpace, period: float, delay: float, times: Sequence[float]) -> StateSpace:
    """Discretise a plant behind hold and delay, u_k to y(kT + τ) for N times τ in s, 0 <= τ <= T.

    u_{k-d-1} acts until the rest of the delay is over, then u_{k-d}. `G` is continuous, without
    feedthrough; of its p outputs there are N p, those of the first τ first.
    """
    held, (n, m) = zoh(G, period, delay), G.B.shape
    whole, rest = delay_parts(period, delay)
    joint = np.zeros((n + m, n + m))
    joint[:n, :n], joint[:n, n:] = G.A, G.B
    rows = []
    for time in times:
        first, second = expm(joint * min(time, rest))[:n], expm(joint * max(time - rest, 0.0))[:n]
        row = np.zeros((n, len(held.A) + m))  # the last columns are of u_k
        row[:, :n] = second[:, :n] @ first[:, :n]
        for age, gain in ((whole + 1, second[:, :n] @ first[:, n:]), (whole, second[:, n:])):
            if gain.any():
                start = n + m * (age - 1) if age else len(held.A)
                row[:, start : start + m] += gain
        rows.append(G.C @ row)
    found = np.vstack(rows)
    C, D = found[:, : len(held.A)], found[:, len(held.A) :]
    return StateSpace(held.A, held.B, C, D, period=period)


def sensitivity_between(
    loop: Loop, omega: Array, place: BreakPoint | None = None, times: int = BetweenOptions.times
) -> np.ndarray:
    """Evaluate S_τ (N, k, p, p) of a sampled loop with a continuous plant at N times τ = 0, T/N, …

    `omega` (k,) is in rad/s, below half the rate. Of several sensors on one actuator `place` is the
    one that is disturbed and read, and S_τ is (N, k, 1, 1).
    """
    assert loop.sampling is not None
    T, p = loop.sampling.period, len(loop.plant.C)
    tau = np.arange(times) * T / times
    omega = loop.plant.off_poles(omega, T)
    P = held_between(loop.plant, T, loop.sampling.delay, tau.tolist()).response(omega)
    K = loop.as_run[1].response(omega)
    P = P.reshape(len(omega), times, p, -1).swapaxes(0, 1)
    back = np.exp(-1j * tau[:, None] * omega)[..., None, None]
    y = back * P @ (K @ sensitivity(P[0] @ K))
    if place is not None:
        y = np.array([place.output]) @ y @ np.array([place.reference]).T
    return np.asarray(np.eye(y.shape[-1]) - y)


def peak_between(loop: Loop, options: BetweenOptions = BetweenOptions()) -> BetweenSamples:
    """Find the largest σ_max(S_τ) of a stable sampled loop over frequency and τ.

    Its grid goes through the poles of plant, controller and loop; local maxima are refined, and no
    level test is of it. Of several sensors S_τ is where the error counts, `loop.at[0]`.
    """
    place = loop.at[0] if loop.at and loop.at[0].output else None

    def gains(omega: Array) -> Array:
        return sigma_max(sensitivity_between(loop, omega, place, options.times))

    def largest(omega: Array) -> Array:
        return np.asarray(gains(omega.ravel()).max(axis=0)).reshape(omega.shape)

    grid = loop.grid()
    values = largest(grid)
    near = [i for i in local_maxima(values) if values[i] > options.near * values.max()]
    at, heights = zoom(largest, grid[np.array(near, int) - 1], grid[np.array(near, int) + 1])
    omega = np.append(at, grid[np.argmax(values)])
    top = omega[np.argmax(np.append(heights, values.max()))]
    each = gains(np.array([top]))[:, 0]
    instants = float(gains(np.append(omega, grid))[0].max())
    step = int(np.argmax(each))
    return BetweenSamples(float(each[step]), instants, float(top), step / options.times)


def worst_between(
    plants: Sequence[StateSpace], peaks: Sequence[float], controller: StateSpace,
    sampling: Sampling, places: tuple[BreakPoint, ...] = (),
    options: BetweenOptions = BetweenOptions(),
) -> BetweenSamples | None:  # fmt: skip
    """Find the largest σ_max(S_τ) on those of a set's plants that are worst at the instants.

    Parameters
    ----------
    plants : sequence of StateSpace
        Continuous, SI; each loop is stable.
    peaks : sequence of float
        ‖S‖∞ at the instants, of each.
    controller : StateSpace
        K in SI; one in discrete time runs as it is.
    sampling : Sampling
    places : tuple of BreakPoint
        Of several sensors on one actuator: first where the error counts.
    options : BetweenOptions

    Returns
    -------
    BetweenSamples or None
        None of plants that are known at the instants alone.
    """
    if plants[0].period:
        return None
    first = np.argsort(-np.array(peaks))[: options.plants]
    loops = [Loop(plants[i], controller, sampling, at=places) for i in first]
    return max((peak_between(loop, options) for loop in loops), key=lambda one: one.peak)
