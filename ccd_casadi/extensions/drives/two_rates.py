"""A cascade whose position loop is slower than its velocity loop, judged exactly by lifting.

Every N-th instant the position's error is read, and it is held between: the loop is periodic. With
the state x of plant, cascade and held error, x_{k+1} = A_k x_k + B_k d_k, s_k = C_k x_k + D_k d_k,
A_{k+N} = A_k, the stack of N instants is a system that does not change with time,

    x⁺ = Φ x + Γ d,   Φ = A_{N-1} … A_0

It is stable where Φ is. With d at a place where the loop may be broken and s the signal behind it,
S_ij leads from d_j to s_i. At the position's sensor, where several sensors are, only instant 0
counts: S is scalar, at the slower rate. Elsewhere |S| is the larger of two figures. One is the part
of s that has the frequency of a sine d, which a frequency response analyser shows:

    |S(ω)| = |1/N Σ_ij e^{jω(j - i)T} S_ij(e^{jωNT})|

The other is the spectral radius of S_ij(e^{jωNT}) = (1 + L)⁻¹: a factor f of gain and phase at the
place makes the loop unstable only where 1 + f λ(L) = 0, so that |S| <= S_max keeps the margins of
gain and phase that it has in loops of one rate. The norm of S is larger: it counts the steps of the
held error as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.extensions.drives.cascade import Cascade
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import PlantFigures, SetCertificate
from ccd_casadi.lti.frequency_grid import root_flanks
from ccd_casadi.lti.loop import Sampling, zoh
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import plural


@dataclass(frozen=True)
class TwoRateOptions:
    """Numbers of the judge.

    Attributes
    ----------
    points : int
        Frequencies from `lowest` times ω_low to half the velocity loop's rate, as many again spread
        evenly; more lie about the loop's poles.
    lowest : float
    room : float
        Share of a bound that it may be exceeded by: for what lies between the frequencies.
    """

    points: int = 400
    lowest: float = 0.05
    room: float = 1e-3


@dataclass(frozen=True)
class LiftedLoop:
    """The loop of one plant over N instants."""

    step: Array  # (n, n) Φ
    places: dict[int | None, StateSpace]  # S, N x N, by sensor, of the actuator by None
    slower: int  # N
    period: float  # T of the velocity loop, s

    @property
    def poles(self) -> np.ndarray:
        """The poles of Φ, over one instant, in rad/s."""
        roots = np.linalg.eigvals(self.step).astype(complex)
        return np.asarray(np.log(roots[np.abs(roots) > 1e-12]) / (self.slower * self.period))

    def sensitivity(self, place: int | None, omega: Array) -> Array:
        """|S| at a place (k,), as the module defines it, at ω in rad/s."""
        found = np.abs(self.fundamental(place, omega))
        S = self.places[place].sweep(omega)
        if S.shape[1:] == (1, 1):
            return found
        return np.asarray(np.fmax(found, np.abs(np.linalg.eigvals(S)).max(axis=1)))

    def grid(self, lowest: float) -> Array:
        """ω in rad/s from `lowest` to half the velocity loop's rate, fine about its poles."""
        top, poles, o = 0.999999 * np.pi / self.period, self.poles, TwoRateOptions()
        near = root_flanks(poles[poles.imag > 0.0])
        near = near[(near > lowest) & (near < top)]
        even = np.linspace(lowest, top, o.points)
        return np.unique([*np.geomspace(lowest, top, o.points), *even, *near])

    @property
    def radius(self) -> float:
        """The spectral radius of Φ over one instant, 1 at the limit of stability."""
        return float(np.abs(np.linalg.eigvals(self.step)).max() ** (1.0 / self.slower))

    def fundamental(self, place: int | None, omega: Array) -> np.ndarray:
        """The part of S at a place that has the frequency of d (k,), at ω in rad/s."""
        S = self.places[place].sweep(omega)
        if S.shape[1:] == (1, 1):
            return np.asarray(S[:, 0, 0])
        turn = np.exp(1j * omega[:, None] * self.period * np.arange(self.slower))
        return np.einsum("ki,kij,kj->k", turn.conj(), S, turn) / self.slower


def lift(cascade: Cascade, values: Array, system: StateSpace) -> LiftedLoop:
    """Lift the loop of a plant from force to all sensors, sampled at the cascade's period."""
    one = cascade.position == cascade.velocity
    # the position's error, which is held, apart from the motor's
    K = replace(cascade, position=0, velocity=1, sensors=2).state_space(values)
    G, N, n, m = system, cascade.slower, len(system.A), len(K.A)
    y = G.C[[cascade.position, cascade.velocity]]
    first = np.zeros((n + m + 1, n + m + 1)), np.zeros((n + m + 1, 3))
    parts = []
    for reads in (True, False):
        # e = E x + F d, d at the position's sensor, the motor's and the actuator
        E, F = np.zeros((2, n + m + 1)), np.zeros((2, 3))
        if reads:
            E[0, :n], F[0, 0] = -y[0], -1.0
        else:
            E[0, -1] = 1.0
        E[1, :n], F[1, 1] = -y[1], -1.0
        if one:
            F[:, 0] += F[:, 1]
        u = np.hstack([np.zeros((1, n)), K.C, np.zeros((1, 1))]) + K.D @ E
        du = K.D @ F + np.array([[0.0, 0.0, 1.0]])
        A, B = (part.copy() for part in first)
        A[:n, :n] = G.A
        A[:n] += G.B @ u
        B[:n] = G.B @ du
        A[n:-1, n:-1] = K.A
        A[n:-1] += K.B @ E
        B[n:-1] = K.B @ F
        A[-1], B[-1] = E[0], F[0]
        C, D = np.zeros((3, n + m + 1)), np.eye(3)
        C[:2, :n], C[2], D[2] = y, u, du
        parts.append((A, B, C, D))
    sequence = [parts[0], *[parts[1]] * (N - 1)]
    every = list(range(N))
    instants = {cascade.position: (0, every)} if one else {
        cascade.position: (0, [0]), cascade.velocity: (1, every), None: (2, every)}  # fmt: skip
    places = {place: _stack(sequence, column, used, cascade.period)
              for place, (column, used) in instants.items()}  # fmt: skip
    step = np.eye(n + m + 1)
    for A, *_ in sequence:
        step = A @ step
    return LiftedLoop(step, places, N, cascade.period)


def _stack(
    sequence: Sequence[tuple[Array, Array, Array, Array]],
    place: int,
    used: list[int],
    period: float,
) -> StateSpace:
    """The system over all instants, from d at the `used` ones to s at these."""
    n, N = len(sequence[0][0]), len(sequence)
    step, into = np.eye(n), np.zeros((n, N))
    rows, through = np.zeros((N, n)), np.zeros((N, N))
    for k, (A, B, C, D) in enumerate(sequence):
        rows[k], through[k] = C[place] @ step, C[place] @ into
        through[k, k] += D[place, place]
        step, into = A @ step, A @ into
        into[:, k] += B[:, place]
    return StateSpace(step, into[:, used], rows[used], through[np.ix_(used, used)],
                      period=N * period)  # fmt: skip


def judge_two_rates(
    cascade: Cascade, values: Array, plants: Sequence[StateSpace], bounds: Bounds,
    sampling: Sampling, options: TwoRateOptions = TwoRateOptions(),
) -> SetCertificate:  # fmt: skip
    """Judge a cascade of two rates on continuous plants: stability, |S| at every place, S_low, ω_b.

    `worst` of the certificate has figures over their bounds by the names of the bounds.
    """
    found = [_figures(lift(cascade, values, zoh(plant, sampling.period, sampling.delay)),
                      cascade, bounds, options) for plant in plants]  # fmt: skip
    unstable = sum(not one.stable for one, _ in found)
    worst: dict[str, float] = {}
    for _, shares in found:
        for name, share in shares.items():
            worst[name] = max(share, worst.get(name, 0.0))
    bandwidth = float(np.min([one.bandwidth for one, _ in found]))
    over = {name: share for name, share in worst.items() if not share <= 1.0 + options.room}
    count = plural(len(plants), "plant")
    words = f"every bound holds on {count}, by lifting"
    if over:
        name = max(over, key=lambda name: over[name])
        words = f"{name} is exceeded by {100.0 * (over[name] - 1.0):.2g} % on one of {count}"
    if unstable:
        words = f"unstable on {unstable} of {count}"
    passed = not over and not unstable and bool(np.isfinite(bandwidth))
    return SetCertificate(passed, bandwidth, tuple(one for one, _ in found), worst, words)


def place_name(bounds: Bounds, place: int | None) -> str:
    """Name a place where the loop may be broken: its channel, or what there is without channels."""
    if place is None:
        return "actuator"
    return bounds.channels[place].name if bounds.channels else "the sensor"


def _figures(
    loop: LiftedLoop, cascade: Cascade, bounds: Bounds, options: TwoRateOptions
) -> tuple[PlantFigures, dict[str, float]]:
    """A plant's figures, and shares of the bounds."""
    radius = loop.radius
    if not radius < 1.0:
        return PlantFigures(stable=False, stability=radius - 1.0), {}
    own = {c.name: c.S_max or bounds.S_max for c in bounds.channels}
    omega = np.union1d(loop.grid(options.lowest * bounds.omega_low), bounds.omega_low)
    shares, S = {}, omega
    for place in loop.places:
        found, name = loop.sensitivity(place, omega), place_name(bounds, place)
        key = f"S_MAX of {name}" if bounds.channels else "S_MAX"
        shares[key] = float(found.max()) / own.get(name, bounds.S_max)
        S = found if place == cascade.position else S
    peak, peak_at = float(S.max()), float(omega[S.argmax()])
    S = np.abs(loop.fundamental(cascade.position, omega))  # the radius is of all aliases of ω
    shares["S_LOW"] = float(S[np.searchsorted(omega, bounds.omega_low)]) / bounds.S_low
    below = omega < np.pi / (cascade.slower * cascade.period)  # above it the position is aliased
    crossed = np.flatnonzero(2.0 * S**2 > 1.0)
    crossing = float(omega[crossed[0]]) if len(crossed) else float(omega[-1])
    bandwidth = crossing if bounds.shape is None else float(
        (omega / bounds.reached(np.sqrt(2.0) * S))[below].min())  # fmt: skip
    figures = PlantFigures(S_peak=peak, S_peak_frequency=peak_at, bandwidth=bandwidth,
                           S_low=shares["S_LOW"] * bounds.S_low, stable=True,
                           stability=radius - 1.0, crossing=crossing)  # fmt: skip
    return figures, shares
