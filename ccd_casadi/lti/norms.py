"""Norms: ‖G‖∞ of a stable state space, and the peak of a sampled loop's S between its samples.

‖G‖∞ is found from the frequency response and a Hamiltonian matrix. Nothing here comes from the
compiled kernels, so that the two may judge each other. (Boyd, Balakrishnan & Kabamba 1989;
Bruinsma & Steinbuch 1990.)

The peak of S between the sampling instants. A disturbance e^{jωt} at the outputs, ω < π/T, is
sampled as z^k with z = e^{jωT}. In the steady state the force is u_k = -K(z) S(z) z^k, held and
delayed. A time τ after an instant the plant gives

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
from scipy.linalg import eigvals, expm, solve

from ccd_casadi.lti.frequency_grid import local_maxima, root_flanks, zoom
from ccd_casadi.lti.loop import Loop, Sampling, delay_parts, in_w, zoh
from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.state_space import StateSpace, balance_system, sensitivity, sigma_max
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class NormOptions:
    """Numbers of the computation of the H∞ norm."""

    near_axis: float = 1e-3  # |Re λ|/|λ| of a candidate at most; a spurious one costs an evaluation
    resolution: float = 1e-10  # relative step of the level
    rounds: int = 40  # largest number of steps
    climbed: float = 0.1  # relative: how far below the largest a maximum is climbed, too
    climbs: int = 4  # maxima that are climbed
    divisions: int = 4  # times that the bracket of each is divided
    points: int = 41  # of the bracket at each division


def gains(system: StateSpace, omega: Array, *, memory: int = 1_000_000) -> Array:
    """Evaluate σ_max of C(jω - A)⁻¹B + D.

    Parameters
    ----------
    system : StateSpace
        Continuous.
    omega : array (k,)
        rad/s, infinity allowed.
    memory : int
        Complex numbers of the responses that are held at once.

    Returns
    -------
    array (k,)
        Infinite at a pole on the axis.
    """
    out = np.full(len(omega), np.linalg.norm(system.D, 2))
    finite = np.flatnonzero(np.isfinite(omega))
    size = max(1, memory // max(1, system.A.size))
    for first in range(0, len(finite), size):
        part = finite[first : first + size]
        try:
            out[part] = _gains(system, omega[part])
        except np.linalg.LinAlgError:  # of some of them
            single = len(part) == 1
            out[part] = np.inf if single else [gains(system, omega[[i]])[0] for i in part]
    return out


def _gains(system: StateSpace, omega: Array) -> Array:
    response = system.at(1j * omega)
    known = np.asarray(np.isfinite(response).all(axis=(1, 2)))
    sizes = np.linalg.norm(np.where(known[:, None, None], response, 0.0), 2, axis=(1, 2))
    return np.where(known, sizes, np.inf)


def level_frequencies(
    system: StateSpace, level: float, *, options: NormOptions = NormOptions()
) -> Array:
    """Sorted ω >= 0 where a singular value of the response may equal `level` > σ_max(D).

    They are the imaginary eigenvalues of [[F, BR⁻¹Bᵀ], [-Cᵀ(I + DR⁻¹Dᵀ)C, -Fᵀ]], R = level² -
    DᵀD, F = A + BR⁻¹DᵀC.
    """
    A, B, C, D = system.A, system.B, system.C, system.D
    R = level**2 * np.eye(D.shape[1]) - D.T @ D
    RDC, RB = solve(R, D.T @ C, assume_a="sym"), solve(R, B.T, assume_a="sym")
    F = A + B @ RDC
    values = eigvals(np.block([[F, B @ RB], [-C.T @ C - C.T @ D @ RDC, -F.T]]))
    near = np.abs(values.real) <= options.near_axis * np.abs(values)
    return np.unique(values.imag[near & (values.imag >= 0.0)])


def hinf_norm(
    system: StateSpace, start: float | None = None, *, options: NormOptions = NormOptions()
) -> tuple[float, float]:
    """Compute the H∞ norm, the largest σ_max of the response over ω.

    The value is attained at the ω returned. It is raised until the Hamiltonian matrix has no higher
    level, each candidate confirmed on the frequency response. A system in discrete time is
    transformed to w, whose axis is its circle (`in_w`).

    Parameters
    ----------
    system : StateSpace
    start : float, optional
        ω near the maximum in rad/s, in place of a grid.
    options : NormOptions

    Returns
    -------
    norm : float
        Infinite where A has an eigenvalue with Re >= 0.
    omega : float
        rad/s.

    References
    ----------
    Boyd, Balakrishnan & Kabamba (1989); Bruinsma & Steinbuch (1990).
    """
    if T := system.period:
        near = None if start is None else 2.0 / T * np.tan(0.5 * start * T)
        norm, v = hinf_norm(in_w(system), near, options=options)
        return norm, float(2.0 / T * np.arctan(0.5 * v * T))
    if not len(system.A):
        return float(np.linalg.norm(system.D, 2)), 0.0
    A, B, C = balance_system(system.A, system.B, system.C)
    scaled = StateSpace(A, B, C, system.D)
    poles = np.linalg.eigvals(A)
    if not poles.real.max() < 0.0:
        return np.inf, float(abs(poles[np.argmax(poles.real)].imag))
    omega = _first_grid(poles) if start is None else np.array([start, np.inf])
    best, at = _climb(scaled, omega, options)
    for _ in range(options.rounds):
        level = best * (1.0 + options.resolution)
        if level == 0.0:
            break
        edges = level_frequencies(scaled, level, options=options)
        inner = edges[edges > 0.0]
        if not inner.size:
            break
        between = np.sqrt(inner[:-1] * inner[1:])
        trials = np.concatenate([[0.0, 0.5 * inner[0], 2.0 * inner[-1]], between, inner])
        found = gains(scaled, trials)
        i = int(np.argmax(found))
        if found[i] <= level:
            break
        best, at = float(found[i]), float(trials[i])
    return best, at


def _climb(system: StateSpace, omega: Array, options: NormOptions) -> tuple[float, float]:
    """The largest gain, and its ω, on ascending frequencies and on finer ones beside its maxima.

    A flat maximum far below the other poles is an eigenvalue of the Hamiltonian that rounding moves
    off the axis; the climb does not depend on it.
    """
    values = gains(system, omega)
    i = int(np.argmax(values))
    best, at = float(values[i]), float(omega[i])
    if not 0.0 < best < np.inf:
        return best, at
    inside = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
    tops = inside[
        (values[inside] > (1.0 - options.climbed) * best) & np.isfinite(omega[inside + 1])
    ]
    for top in tops[np.argsort(-values[tops])][: options.climbs]:
        low, high = omega[top - 1], omega[top + 1]
        for _ in range(options.divisions):
            fine = np.linspace(low, high, options.points)
            found = gains(system, fine)
            k = int(np.argmax(found))
            if found[k] > best:
                best, at = float(found[k]), float(fine[k])
            low, high = fine[max(k - 1, 0)], fine[min(k + 1, options.points - 1)]
    return best, at


def _first_grid(poles: np.ndarray) -> Array:
    """0, infinity, ten frequencies a decade around the poles, and every resonance with flanks."""
    size = np.abs(poles)
    low, high = 0.01 * size.min(), 100.0 * size.max()
    count = int(10 * np.log10(high / low)) + 2
    flanks = root_flanks(poles[poles.imag > 0.0], (-1.0, 0.0, 1.0))
    grid = np.concatenate([[0.0, np.inf], np.geomspace(low, high, count), flanks])
    return np.unique(grid[grid >= 0.0])


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
