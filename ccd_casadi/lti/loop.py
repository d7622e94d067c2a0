"""A loop as it runs: hold and delay, Tustin's rule, and S, T, KS and GS over frequency."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import expm

from ccd_casadi.lti.frequency_grid import frequency_grid, root_flanks, zoom
from ccd_casadi.lti.ports import BreakPoint, Ports, ports_of
from ccd_casadi.lti.state_space import (
    ClosedLoop,
    StateSpace,
    closed_loop,
    responses_of,
    sensitivity,
    sigma_max,
    strictly_proper,
)
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class Sampling:
    """The rate of a sampled loop, and its delay.

    Parameters
    ----------
    rate_hz, delay_us : float
        Of K, Hz; from measurement to force beside the hold, µs.
    """

    rate_hz: float
    delay_us: float = 0.0

    def __post_init__(self) -> None:
        if not self.rate_hz > 0.0:
            raise ValueError(f"rate_hz is {self.rate_hz}; give a rate above 0")
        if not self.delay_us >= 0.0:
            raise ValueError(f"delay_us is {self.delay_us}; give 0 or more")

    @property
    def period(self) -> float:
        """The period T in s."""
        return 1.0 / self.rate_hz

    @property
    def delay(self) -> float:
        """The delay τ in s."""
        return 1e-6 * self.delay_us


@dataclass(frozen=True)
class DelayOptions:
    """Numbers of the split of a delay.

    Attributes
    ----------
    instant : float
        Share of a period that counts as zero.
    """

    instant: float = 1e-9


def delay_parts(
    period: float, delay: float, *, options: DelayOptions = DelayOptions()
) -> tuple[int, float]:
    """Split a delay into whole periods and a rest.

    Parameters
    ----------
    period, delay : float
        s.
    options : DelayOptions

    Returns
    -------
    whole : int
    rest : float
        s.
    """
    whole = int(np.floor(delay / period + options.instant))
    return whole, max(delay - whole * period, 0.0)


def transfer(p: np.ndarray, omega: Array, period: float, delay: float) -> np.ndarray:
    """f(p), (len(ω), len(p)), with which the plant's response is C f(A) B."""
    s = 1j * omega[:, None]
    d, late, early = moments(p, period, delay)
    gap = np.exp(p * period) * np.expm1((s - p) * period)
    return (late + early * np.exp(-s * period)) / gap * np.exp(-s * period * d)


def moments(p: np.ndarray, T: float, delay: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Integrate a mode e^{pt} over a period in which the held force changes once.

    Parameters
    ----------
    p : complex array (n,)
        Poles, 1/s.
    T, delay : float
        Period and delay, s.

    Returns
    -------
    d : float
        Whole periods of delay.
    late, early : complex arrays (n,)
        Gains of u_{k-d} and u_{k-d-1} on a mode in one period, s.
    """
    d, rest = delay_parts(T, delay)
    h, free = T - rest, p == 0.0
    over = np.where(free, 1.0, p)
    late = np.where(free, h, np.expm1(p * h) / over)
    early = np.where(free, rest, np.exp(p * h) * np.expm1(p * rest) / over)
    return float(d), late, early


def moment_slopes(p: np.ndarray, T: float, delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate `moments` to p.

    Parameters
    ----------
    p : complex array (n,)
        Poles, 1/s.
    T, delay : float
        s.

    Returns
    -------
    late, early : complex arrays (n,)
        s².
    """
    _, late, early = moments(p, T, delay)
    rest = delay_parts(T, delay)[1]
    h, free = T - rest, p == 0.0
    over = np.where(free, 1.0, p)
    d_late = np.where(free, 0.5 * h**2, (h * np.exp(p * h) - late) / over)
    first = (rest * np.exp(p * rest) - np.expm1(p * rest) / over) / over
    d_early = h * early + np.exp(p * h) * np.where(free, 0.5 * rest**2, first)
    return d_late, d_early


def zoh(G: StateSpace, period: float, delay: float) -> StateSpace:
    """Discretise a plant behind hold and delay, u_k to y_k.

    One exponential over each part of a period: before and after the delayed force changes. Analytic
    in the plant's matrices.

    Parameters
    ----------
    G : StateSpace
        Continuous, without feedthrough.
    period, delay : float
        s.

    Returns
    -------
    StateSpace
        With the states [x; u_{k-1}; …].
    """
    n, m = G.B.shape
    whole, rest = delay_parts(period, delay)
    joint = np.zeros((n + m, n + m), np.result_type(G.A, G.B))
    joint[:n, :n], joint[:n, n:] = G.A, G.B
    late = expm(joint * (period - rest))[:n]
    gains = [np.zeros((n, m))] * whole + [late[:, n:]]
    A = late[:, :n]
    if rest > 0.0:
        early = expm(joint * rest)[:n]
        gains.append(A @ early[:, n:])
        A = A @ early[:, :n]
    return with_delays(A, gains, G.C, period)


def with_delays(A: np.ndarray, gains: Sequence[np.ndarray], C: np.ndarray, T: float) -> StateSpace:
    """Make one state space of x_{k+1} = A x_k + Σ gains_i u_{k-i}, y = C x.

    Parameters
    ----------
    A : array (n, n)
    gains : sequence of arrays (n, m)
        Of u_k, u_{k-1}, …
    C : array (p, n)
    T : float
        Period, s.

    Returns
    -------
    StateSpace
        With the states [x; u_{k-1}; …].
    """
    n, m = gains[0].shape
    kept = m * (len(gains) - 1)
    older = np.hstack([np.zeros((n, 0)), *gains[1:]])
    return strictly_proper(
        np.block([[A, older], [np.zeros((kept, n)), np.eye(kept, k=-m)]]),
        np.vstack([gains[0], np.eye(kept, m)]),
        np.hstack([C, np.zeros((len(C), kept))]),
        T,
    )


def tustin(K: StateSpace, period: float) -> StateSpace:
    """Discretise a controller by Tustin's rule: s = (2/T)(z - 1)/(z + 1), without prewarping.

    The result is analytic in the controller's matrices.

    Parameters
    ----------
    K : StateSpace
        Continuous.
    period : float
        T in s.

    Returns
    -------
    StateSpace
    """
    one, half = np.eye(len(K.A)), 0.5 * period
    inverse = np.linalg.inv(one - half * K.A)
    C = K.C @ inverse
    A, B = inverse @ (one + half * K.A), period * inverse @ K.B
    return StateSpace(A, B, C, K.D + half * C @ K.B, period=period)


def in_w(G: StateSpace) -> StateSpace:
    """Transform a system in discrete time to w, z = (1 + wT/2)/(1 - wT/2).

    The system is stable where its poles in w lie left of the axis.

    Parameters
    ----------
    G : StateSpace
        With a period.

    Returns
    -------
    StateSpace
        Without a period.
    """
    T = G.period
    inverse = np.linalg.inv(G.A + np.eye(len(G.A)))
    root = 2.0 / np.sqrt(T)
    return StateSpace(
        2.0 / T * inverse @ (G.A - np.eye(len(G.A))),
        root * inverse @ G.B,
        root * G.C @ inverse,
        G.D - G.C @ inverse @ G.B,
    )


@dataclass(frozen=True)
class Loop:
    """A feedback loop as it runs.

    Attributes
    ----------
    plant : StateSpace
        G, continuous, without feedthrough, SI.
    controller : StateSpace
        K in SI; one in discrete time runs as it is, at the rate of `sampling`.
    sampling : Sampling, optional
        Without, the loop is continuous.
    at : tuple of BreakPoint
        Of several sensors on one actuator: first where the error counts, of which responses and S
        are, then the other places, which `peak` has too.
    drive, counted : array (n, q), (z, n), optional
        Where disturbing forces act and what of the states counts, where that is not the plant's own
        B and C.
    force : array (m, n), optional
        The force that the machine gets, where actuators make it of u.
    names : (str, str)
        Of what counts, and of where disturbing forces act.
    """

    plant: StateSpace
    controller: StateSpace
    sampling: Sampling | None = None
    at: tuple[BreakPoint, ...] = ()
    drive: Array | None = None
    counted: Array | None = None
    force: Array | None = None
    names: tuple[str, str] = ("output", "actuator")

    @cached_property
    def ports(self) -> Ports:
        """The places where disturbing forces act, and what counts."""
        return ports_of(self.plant, self.at, self.drive, self.counted, self.force)

    @property
    def ported(self) -> bool:
        """Whether forces act, or the error counts, elsewhere than at its actuators and sensors."""
        return self.drive is not None or self.counted is not None

    def force_responses(self, omega: Array) -> np.ndarray:
        """Compute what counts per disturbing force (k, z, q), of a sampled loop at its instants."""
        plant, ports, p = self.plant, self.ports, len(self.plant.C)
        C = np.vstack([plant.C, ports.counted])
        whole = replace(self, plant=strictly_proper(plant.A, plant.B, C), drive=None, counted=None)
        (G, K), free = whole.run_responses(omega), strictly_proper(plant.A, ports.drive, C)
        d = free.sweep(omega)
        u = np.linalg.solve(np.eye(G.shape[2]) + K @ G[:, :p], K @ d[:, :p])
        return np.asarray(d[:, p:] - G[:, p:] @ u)

    @property
    def compliance(self) -> float:
        """The largest σ_max of `moved`, m/N."""
        return self._largest(lambda omega: sigma_max(self.force_responses(omega)))

    @property
    def places(self) -> "list[Loop]":
        """The loop broken at each place by itself."""
        return [replace(self, at=(one,)) for one in self.at] or [self]

    def responses(self, omega: Array) -> tuple[np.ndarray, np.ndarray]:
        """G (k, p, m), hold and delay in it, and K (k, m, p) as they run, at ω (k,) in rad/s."""
        G, K = self.run_responses(omega)
        return self.at[0].open_loop(G, K) if self.at else (G, K)

    def curves(self, omega: Array) -> dict[str, np.ndarray]:
        """S, T, KS and GS as matrices (k, ·, ·); KS the whole force."""
        found = responses_of(*self.responses(omega))
        if self.at and self.at[0].output:
            G, K = self.run_responses(omega)
            found["KS"] = K @ np.array([self.at[0].reference]).T / (1.0 + K @ G)
        if self.ported:
            found["GS"] = self.force_responses(omega)
        return found

    def run_responses(self, omega: Array) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate `responses` with the loop broken at no place."""
        K = self.as_run[1].sweep(omega)
        if self.sampling is None:
            return self.plant.sweep(omega), K
        omega = self.plant.off_poles(omega, self.sampling.period)
        return held(self.plant, omega, self.sampling), K

    def sensitivity(self, omega: Array) -> np.ndarray:
        """S = (I + GK)⁻¹ (k, p, p)."""
        G, K = self.responses(omega)
        return sensitivity(G @ K)

    @cached_property
    def closed(self) -> ClosedLoop:
        """The closed loop, sampled at its instants; a disturbing force is held, and not delayed."""
        found = closed_loop(*self.as_run)
        if self.at:
            found = self.at[0].close_loop(found)
        if self.sampling is None and not self.ported:
            return found
        drive, n = self.plant.B if self.drive is None else self.drive, len(self.plant.A)
        force, counted = np.zeros((len(found.A), drive.shape[1])), None
        force[:n] = drive
        if self.sampling is not None:
            held = strictly_proper(self.plant.A, drive, self.plant.C)
            force[:n] = zoh(held, self.sampling.period, 0.0).B
        if self.ported:
            counted = np.zeros((len(self.ports.counted), len(found.A)))
            counted[:, :n] = self.ports.counted
        return replace(found, B_d=force, counted=counted)

    @property
    def period(self) -> float | None:
        """T in s of a sampled loop."""
        return None if self.sampling is None else self.sampling.period

    @property
    def stable(self) -> bool:
        """Whether every pole of the loop is."""
        return self.closed.S.stable

    def over_a_step(self, longest: float) -> ClosedLoop:
        """The closed loop over a sampling period, or over `longest` s where it is continuous."""
        return self.closed if self.sampling is not None else at_instants(self.closed, longest)

    @property
    def poles(self) -> np.ndarray:
        """Closed-loop poles in rad/s; of a sampled loop ln(z)/T, those of a delay left out."""
        return self.closed.S.rates

    def grid(self, *, per_decade: int = 60, apart: float = 1e-7) -> Array:
        """ω in rad/s from far below the slowest pole to far above the fastest, ascending.

        It has every pole of plant, controller and loop, and their flanks. Points closer than
        `apart` (relative) differ in gain by rounding alone.
        """
        roots = np.concatenate([self.poles, self.plant.rates, self.controller.rates])
        roots = roots[np.abs(roots) > 1e-9 * np.abs(roots).max()]
        low, high = 0.1 * np.abs(roots).min(), 10.0 * np.abs(roots).max()
        if self.sampling is not None:
            high = np.pi / self.sampling.period
        count = int(per_decade * np.log10(high / low)) + 1
        return frequency_grid(low, high, count, root_flanks(roots), apart=apart)

    @cached_property
    def peak(self) -> float:
        """‖S‖∞ of a stable loop: every local maximum on the grid near the largest closed in on."""
        if len(self.at) > 1:
            return max(one.peak for one in self.places)

        return self._largest(lambda omega: sigma_max(self.sensitivity(omega)))

    def _largest(self, of: Callable[[Array], Array]) -> float:
        def gain(omega: Array) -> Array:
            return of(omega.ravel()).reshape(omega.shape)

        grid = self.grid()
        S = gain(grid)
        at = np.flatnonzero((S[1:-1] >= S[:-2]) & (S[1:-1] >= S[2:])) + 1
        at = at[S[at] > 0.9 * S.max()]  # lower ones are lower between the points, too
        return float(max((S.max(), *zoom(gain, grid[at - 1], grid[at + 1])[1])))

    @cached_property
    def as_run(self) -> tuple[StateSpace, StateSpace]:
        """Plant and controller of the loop, in discrete time where it is sampled."""
        if self.sampling is None:
            return self.plant, self.controller
        T, K = self.sampling.period, self.controller
        K = K if K.period else tustin(K, T)
        K = K if K.period == T else replace(K, period=T)
        return zoh(self.plant, T, self.sampling.delay), K


def held(plant: StateSpace, omega: Array, sampling: Sampling) -> np.ndarray:
    """The response (k, p, m) of a plant behind hold and delay, at ω (k,) in rad/s.

    By its modes, those at 0 apart where their eigenvectors are no basis.
    """
    if plant.modes is not None:
        poles, drive, reading = plant.modes
        f = transfer(poles, omega, sampling.period, sampling.delay)
        return np.asarray((reading * f[:, None, :]) @ drive)
    if plant.at_rest is not None:
        return np.asarray(sum(held(part, omega, sampling) for part in plant.at_rest))
    return zoh(plant, sampling.period, sampling.delay).sweep(omega)


def at_instants(loop: ClosedLoop, period: float) -> ClosedLoop:
    """A continuous loop at instants `period` s apart, r and d constant in between; exact."""
    both = np.hstack([loop.B_r, loop.B_d])
    held = zoh(strictly_proper(loop.A, both, loop.C_y), period, 0.0)
    count = loop.B_r.shape[1]
    return replace(loop, A=held.A, B_r=held.B[:, :count], B_d=held.B[:, count:], period=period)


def constant_drive(loop: ClosedLoop, drive: Array, count: int) -> Array:
    """Simulate the output of a loop at its instants, from rest under a constant input.

    By doubling: the states of 2n instants are those of n, and Aⁿ times them.

    Parameters
    ----------
    loop : ClosedLoop
        In discrete time.
    drive : array (n,)
        B_r r or B_d d.
    count : int
        Number of instants.

    Returns
    -------
    array (p, count)
        y.
    """
    n = len(loop.A)
    P = np.eye(n + 1)
    P[:n, :n], P[:n, n] = loop.A, drive
    x = np.eye(n + 1)[:, n:]
    while x.shape[1] < count:
        x = np.hstack([x, P @ x])
        P = P @ P
    return np.asarray(loop.C_y @ x[:n, :count])
