"""The time of a move with its settling on a set of plants, and its derivatives.

At the instants of a sampled loop, hold and delay exact, with the feedforward of `feedforward`. Once
the setpoint has come to rest, at t_0, the error is a sum of the loop's modes,

    e_k = Σ_i ρ_i λ_i^k,   |e_k| <= E(k) = Σ_i √(|ρ_i λ_i^k|² + (r w)²)

The exact time, from which on |e| stays within the window w, jumps by half an oscillation as a peak
falls into it. What is optimised is when the envelope E crosses the window: no less, without jumps,
smooth also where a mode is not excited (r rounds that kink), but not where two real poles meet: ρ
is infinite there. The plants and the end of the setpoint
come together smoothly and from above:

    v = t_0 + t_0/s ln(1 + Σ_plants exp(s (t_i/t_0 - 1))) >= max(t_0, t_i)

Its gradients are by perturbation of the modes, and by one adjoint recursion for each plant:

    dλ_i = D_ii,   dρ_i = -Σ_{j≠i} (c_i D_ij b_j + c_j D_ji b_i)/(λ_i - λ_j) - …,   D = V⁻¹ dA V
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from ccd_casadi.analysis.driven_plant import MotionAt
from ccd_casadi.analysis.motor import MotionOptions
from ccd_casadi.analysis.setpoint_feedforward import forward_force
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Sampling, tustin, zoh
from ccd_casadi.lti.state_space import ClosedLoop, StateSpace, closed_loop
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array, states
from ccd_casadi.support.process_pool import Pool, results


@dataclass(frozen=True)
class MoveTimeOptions:
    """Numbers of the time of a move."""

    sharpness: float = 200.0  # of the largest of the plants: twelve equally late ones add 1.3 %
    rounded: float = 0.005  # of the window, for each mode: r
    most_rounded: float = 0.1  # of the window, for all modes together
    nothing: float = 1e-30  # share of the envelope: a mode with less has died out
    newton_steps: int = 50  # at most
    instants: int = 3000  # of all plants of a task, at least: 3 ms, and 1 ms to hand it over


class _Crossing:
    """The time in s at which the envelope of one plant's error crosses the window, and its
    slopes."""

    def __init__(
        self, G: StateSpace, K: StateSpace, r: Array, f: Array, window: float, period: float,
        options: MoveTimeOptions = MoveTimeOptions(),
    ) -> None:  # fmt: skip
        self.plant, self.r, self.f = G, r, f
        self.loop = loop = closed_loop(G, K)
        self.poles, self.V = np.linalg.eig(loop.A)
        self.stable, self.time = bool(np.abs(self.poles).max() < 1.0), np.inf
        if not self.stable:
            return
        # x less the rest at each setpoint, which begins at 0: at the end what is left of the modes
        self.still = np.eye(len(loop.A)) - loop.A
        rest = np.linalg.solve(self.still, loop.B_r[:, 0])
        driven = np.outer(r - np.append(r[1:], r[-1]), rest)
        driven[:, : len(G.A)] += f @ G.B.T
        moving = states(loop.A, driven)
        self.rest, self.x = rest * r[-1], moving + np.outer(r, rest)
        self.W = np.linalg.inv(self.V)
        self.c, self.b = loop.C_y[0] @ self.V, self.W @ moving[-1]
        self.residues = -self.c * self.b
        with np.errstate(divide="ignore"):
            self.logs = np.log(np.abs(self.residues) / window), np.log(np.abs(self.poles))
        size, rate = self.logs
        # E is convex: Newton's steps from where one mode alone is in the window go up to it
        k = float(np.max(-size / rate))
        for _ in range(options.newton_steps):
            alone = np.exp(size + k * rate)
            rounded = np.hypot(alone, min(options.rounded, options.most_rounded / len(alone)))
            self.shares = np.where(alone > options.nothing, alone**2 / rounded, 0.0)  # d ln of each
            step = float((1.0 - rounded.sum()) / (self.shares @ np.maximum(rate, -1e3)))
            if abs(step) < 1e-12 * len(r):
                break
            k += step
        self.period, self.k = period, k
        self.time = period * (len(r) - 1 + k)

    def with_slopes(self) -> "_Crossing":
        """Add the slopes with respect to the matrices, the setpoint and the feedforward force."""
        there = self.shares > 0.0
        rate = float(self.shares[there] @ self.logs[1][there])
        scale = -self.period / rate
        zero = np.zeros_like(self.poles)
        alpha = scale * np.divide(self.shares, self.residues, out=zero.copy(), where=there)
        beta = scale * self.k * np.divide(self.shares, self.poles, out=zero.copy(), where=there)
        gap = self.poles[:, None] - self.poles + np.eye(len(zero))
        M = -np.outer(self.c, self.b) * (alpha[:, None] - alpha) / gap + np.diag(beta)
        self.to_A = (self.W.T @ M @ self.V.T).real
        self.to_C = -(self.V @ (alpha * self.b)).real
        to_x = -((alpha * self.c) @ self.W).real
        still = np.linalg.solve(self.still.T, to_x)
        self.to_A -= np.outer(still, self.rest)
        driven = np.zeros_like(self.x)
        driven[0] = to_x
        later = states(self.loop.A.T, driven)[:0:-1]  # λ_{k+1} of k = 0 ... N - 2
        x, r, f, n = self.x[:-1], self.r[:-1], self.f[:-1], len(self.plant.A)
        self.to_A += later.T @ x
        self.to_B = later.T @ r - still * self.r[-1]
        self.to_input = later[:, :n].T @ f[:, 0]
        self.to_r = np.append(later @ self.loop.B_r[:, 0], -still @ self.loop.B_r[:, 0])
        self.to_f = np.append(later[:, :n] @ self.plant.B[:, 0], 0.0)
        return self

    def along(self, moved: ClosedLoop, inputs: Array) -> float:
        """dt along the imaginary part of a loop, and of its plant's inputs."""
        found = np.sum(self.to_A * moved.A.imag) + self.to_C @ moved.C_y[0].imag
        found += self.to_B @ moved.B_r[:, 0].imag + self.to_input @ inputs[:, 0].imag
        return float(found / MotionOptions().complex_step)

    def along_controllers(self, moved: StateSpace) -> Array:
        """dt (N,) along the imaginary parts of controllers A (N, k, k), B (N, k, 1), C, D.

        The loop is linear in them: A = [A_p - B_p D C_p, B_p C; -B C_p, A], B_r = [B_p D; B].
        """
        n, B_p, C_p = len(self.plant.A), self.plant.B[:, 0], self.plant.C[0]
        to_A = self.to_A
        to_D = B_p @ (self.to_B[:n] - to_A[:n, :n] @ C_p)
        found = np.tensordot(moved.A.imag, to_A[n:, n:]) + moved.D.imag[:, 0, 0] * to_D
        found += moved.B.imag[..., 0] @ (self.to_B[n:] - to_A[n:, :n] @ C_p)
        found += moved.C.imag[:, 0] @ (B_p @ to_A[:n, n:])
        return np.asarray(found / MotionOptions().complex_step)


def _cross(
    plants: Sequence[StateSpace], K: StateSpace, r: Array, f: Array, window: float,
    options: MoveTimeOptions,
) -> list[_Crossing]:  # fmt: skip
    return [_Crossing(G, K, r, f, window, K.period, options) for G in plants]


def _times(*arguments: Any, moved: StateSpace) -> list[tuple[float, Array]]:
    """The times of `_cross`, each with its slopes (N,) along N controllers; infinite where one of
    the loops is unstable."""
    found = _cross(*arguments)
    if not all(each.stable for each in found):
        return [(np.inf, np.full(len(moved.A), np.nan))] * len(found)
    return [(each.time, each.with_slopes().along_controllers(moved)) for each in found]


@dataclass(frozen=True)
class MoveTime:
    """v of a controller on SISO plants, with derivatives to κ and θ.

    Attributes
    ----------
    plants : tuple of ScaledPlant
        With free rigid bodies.
    structure : Structure
        Of the controller.
    hold : Sampling
        Of the loop.
    motion : MotionAt
        The move at θ.
    options : MoveTimeOptions
        Numbers of the method.
    """

    plants: tuple[ScaledPlant, ...]
    structure: Structure
    hold: Sampling
    motion: MotionAt
    options: MoveTimeOptions = MoveTimeOptions()

    def at(self, kappa: Array, workers: Pool | None = None) -> tuple[float, Array]:
        """ln v (s) at κ in SI, and its gradient; infinite where a loop is unstable.

        Some plants at a time are spread over workers.
        """
        kappa, period, count = np.asarray(kappa, float), self.hold.period, len(self.plants)
        step = 1j * MotionOptions().complex_step
        stepped = self.structure.state_spaces(kappa + step * np.eye(len(kappa)))
        each = [tustin(StateSpace(*parts), period) for parts in zip(*stepped, strict=True)]
        moved = StateSpace(*(np.stack([getattr(K, part) for K in each]) for part in "ABCD"))
        with_slopes, rest = partial(_times, moved=moved), self._arguments(kappa)
        size = -(-count // max(1, count * len(self._time) // self.options.instants))
        tasks = {i: (self._sampled[i : i + size], *rest) for i in range(0, count, size)}
        found = dict(results(workers, with_slopes, tasks))
        times, slopes = zip(*(one for i in tasks for one in found[i]), strict=True)
        if np.inf in times:
            return np.inf, np.full(len(kappa), np.nan)
        value, weights, _ = self._together(times)
        gradient = np.zeros(len(kappa))
        for weight, slope in zip(weights, slopes, strict=True):
            if weight > self.options.nothing:
                gradient += weight * slope
        return float(np.log(value)), gradient / value

    def to_theta(self, kappa: Array, workers: Pool | None = None) -> Array:
        """∂ ln v/∂θ at a fixed κ; as `at`."""
        found, motion = self._crossings(np.asarray(kappa, float)), self.motion
        size = MotionOptions().complex_step
        step = 1j * size
        T, tau = self.hold.period, self.hold.delay
        value, weights, by_duration = self._together([each.time for each in found])
        K = tustin(self.structure.state_space(kappa), T)
        gradient = by_duration * motion.slopes(lambda cycle: cycle.profile.durations.sum())
        signals = [
            forward_force(item.profile, motion.forward + step * slope, self._time, T)
            for item, slope in zip(motion.stepped, motion.forward_slopes, strict=True)
        ]
        for weight, each, plant in zip(weights, found, self.plants, strict=True):
            if not weight > self.options.nothing:
                continue
            back, G = each.with_slopes(), plant.plant_si()
            for i, (dA, dB, dC) in enumerate(plant.changes_si()):
                moved = zoh(
                    StateSpace(G.A + step * dA, G.B + step * dB, G.C + step * dC, G.D), T, tau
                )
                r, f = (signal.imag / size for signal in signals[i])
                dt = back.along(closed_loop(moved, K), moved.B)
                gradient[i] += weight * (dt + back.to_r @ r + back.to_f @ f[:, 0])
        return np.asarray(gradient / value)

    def times(self, kappa: Array) -> list[float]:
        """Compute the times in s at which the envelope of each plant's error crosses the window."""
        return [each.time for each in self._crossings(np.asarray(kappa, float))]

    def format_value(self, value: float) -> str:
        """Format a time in ms."""
        return f"{1e3 * value:.5g} ms of move and settling"

    @cached_property
    def _sampled(self) -> tuple[StateSpace, ...]:
        hold = self.hold
        return tuple(zoh(p.plant_si(), hold.period, hold.delay) for p in self.plants)

    @cached_property
    def _time(self) -> Array:
        """Instants until setpoint and force ahead rest, s."""
        T = self.hold.period
        return T * np.arange(int(np.ceil(self.motion.cycle.profile.duration / T)) + 2, dtype=float)

    @cached_property
    def _signals(self) -> tuple[Array, Array]:
        """The setpoint and the force ahead at these instants."""
        motion = self.motion
        return forward_force(motion.cycle.profile, motion.forward, self._time, self.hold.period)

    def _arguments(self, kappa: Array) -> tuple[StateSpace, Array, Array, float, MoveTimeOptions]:
        """Of `_cross`, but for the plants."""
        K = tustin(self.structure.state_space(kappa), self.hold.period)
        return K, *self._signals, self.motion.motion.window, self.options

    def _crossings(self, kappa: Array) -> list[_Crossing]:
        return _cross(self._sampled, *self._arguments(kappa))

    def _together(self, times: Sequence[float]) -> tuple[float, Array, float]:
        """v, ∂v/∂t_i and ∂v/∂t_0."""
        t_0, sharpness = self.motion.cycle.profile.duration, self.options.sharpness
        late = np.array(times) / t_0
        top = max(1.0, float(late.max()))
        shares = np.exp(sharpness * (late - top))
        whole = np.exp(sharpness * (1.0 - top)) + shares.sum()
        value = t_0 * (top + np.log(whole) / sharpness)
        weights = shares / whole
        return float(value), weights, float(value / t_0 - weights @ late)
