"""Variances of the budget and their derivatives to parameters of plant and controller.

A parameter moves the matrices of G and K by (dG, dK). Of a filter's process a step ih along them
gives dA, dQ, dC exactly (no difference is taken, so h = 1e-30), and one adjoint Lyapunov equation
dσ². Of a table it is the derivative of the quadrature's sum, at its nodes:

    dS = -S (dG K + G dK) S,   d‖H‖² = 2 Re tr(H* dH)

    continuous   A P + P A' + Q = 0               A' X + X A + W = 0
    sampled      (1 + A) P (1 + A)' - P + Q = 0   and alike, with A_c = (2 + A)⁻¹A continuous

    d tr(W P) = 2 tr(X dA P) + tr(X dQ)           sampled 2 tr(X dA P (1 + A)') + …
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from ccd_casadi.budget.frequency import integrated, responses
from ccd_casadi.budget.loops import FORCES, Disturbed, Process, closed, disturbed
from ccd_casadi.budget.moving_average import average_gain, average_matrix, average_slope
from ccd_casadi.budget.sources import ErrorBudget, Kind, Source
from ccd_casadi.lti.hold import sampled, tustin
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ

STEP = 1e-30  # along the imaginary axis


@dataclass(frozen=True)
class Change:
    """dG and dK of one parameter, as matrices of the shapes of G and K; None where one stays."""

    plant: StateSpace | None = None
    controller: StateSpace | None = None


@dataclass(frozen=True)
class VarianceSlopes:
    """σ² of error (m²), of its moving average (NaN without a window) and of force (N²), summed.

    `value` (3,) in that order; `gradient` (3, n) to the parameters.
    """

    value: Array
    gradient: Array


def variance_slopes(
    loop: Loop, budget: ErrorBudget, changes: Sequence[Change]
) -> VarianceSlopes | None:
    """The variances of a loop under all sources, and their derivatives; None if it is unstable."""
    if not loop.stable:
        return None
    value, gradient = np.zeros(3), np.zeros((3, len(changes)))
    for source in budget.sources:
        own = of_filter if source.shaped else _of_table
        found = own(loop, source, budget.window, changes)
        value, gradient = value + found[0], gradient + found[1]
    return VarianceSlopes(value, gradient)


def of_filter(
    loop: Loop, source: Source, window: float | None, changes: Sequence[Change]
) -> tuple[Array, Array]:
    """As `VarianceSlopes`, of one shaped source in a stable loop, by Lyapunov's equation."""
    plant = disturbed(loop.plant, source, loop.sampling)
    model = closed(plant, loop.controller)
    scale = model.scales()
    model = model.transformed(scale)
    moved = [_moved(loop, plant, source, change).transformed(scale) for change in changes]
    P = covariance(model.A, model.noise, sampled=model.sampled)
    steps = [(d.A.imag / STEP, d.noise.imag / STEP) for d in moved]
    C, F, V = model.C, model.F, model.V

    after = P @ (model.A.T + np.eye(len(model.A))) if model.sampled else P

    def slopes(weight: Array) -> Array:
        """d tr(W P) at a fixed symmetric W (n, n)."""
        X = covariance(model.A.T, weight, sampled=model.sampled)
        return np.array([2.0 * np.sum(X * (dA @ after).T) + np.sum(X * dQ) for dA, dQ in steps])

    def outputs(name: str, after: Array) -> Array:
        """2 tr(dC after) for outputs C or F."""
        return np.array([2.0 * np.sum(getattr(d, name).imag / STEP * after.T) for d in moved])

    error, force = np.trace(C @ P @ C.T), np.trace(F @ P @ F.T) + (V**2).sum()
    d_error = slopes(C.T @ C) + outputs("C", P @ C.T)
    direct = np.array([2.0 * np.sum(V * d.V.imag / STEP) for d in moved])
    d_force = slopes(F.T @ F) + outputs("F", P @ F.T) + direct
    average, d_average = np.nan, np.full(len(changes), np.nan)
    if window is not None:
        M = average_matrix(model.A, window, loop.period)
        average = np.trace(C @ M @ P @ C.T)
        weight = C.T @ C @ M
        by_matrix = average_slope(model.A, P @ C.T @ C, window, loop.period)
        through = np.array([np.sum(by_matrix * dA) for dA, _ in steps])
        both = 0.5 * (M @ P + P @ M.T) @ C.T
        d_average = slopes(0.5 * (weight + weight.T)) + through + outputs("C", both)
    value = np.array([
        np.inf if model.infinite_error else error, average,
        np.inf if model.infinite_force else force,
    ])  # fmt: skip
    return value, np.array([d_error, d_average, d_force])


def _moved(loop: Loop, plant: Disturbed, source: Source, change: Change) -> Process:
    """The process a step along the imaginary axis away."""
    if change.plant is not None:
        plant = disturbed(_stepped(loop.plant, change.plant), source, loop.sampling)
    return closed(plant, _stepped(loop.controller, change.controller))


def _stepped(system: StateSpace, change: StateSpace | None) -> StateSpace:
    if change is None:
        return system
    return StateSpace(
        *(getattr(system, name) + 1j * STEP * getattr(change, name) for name in "ABCD")
    )


def _of_table(
    loop: Loop, source: Source, window: float | None, changes: Sequence[Change]
) -> tuple[Array, Array]:

    def weight(hz: Array) -> Array:
        return np.full_like(hz, np.nan) if window is None else average_gain(hz, window, loop.period)

    whole = integrated(loop, source, lambda hz: np.nan_to_num(weight(hz)))
    hz, weights = whole.nodes, whole.weights
    averaging = weight(hz)
    at = responses(loop, hz)
    H_e, H_u = at.of(source.kind)
    seen = at.seen(source.kind)
    density = source.density(hz) * weights
    error, force = ((np.abs(H) ** 2).sum((1, 2)) for H in (H_e, H_u))
    value = np.array([density @ error, (density * averaging) @ error, density @ force])
    gradient = np.zeros((3, len(changes)))
    moving = _ResponseChanges(loop, hz)
    for i, change in enumerate(changes):
        dG, dK, dfree = moving.of(change)
        dS = -at.S @ (dG @ at.K + at.G @ dK) @ at.S
        d = dS if source.kind is Kind.SETPOINT else -dS
        if source.kind in FORCES:
            d = -dS @ at.free - at.S @ dfree
        slope = 2.0 * (H_e.conj() * d).real.sum((1, 2))
        other = 2.0 * (H_u.conj() * (dK @ seen + at.K @ d)).real.sum((1, 2))
        gradient[:, i] = density @ slope, (density * averaging) @ slope, density @ other
    return value, gradient


class _ResponseChanges:
    """dG and dK as in the loop, and d of the disturbed G, at frequencies in Hz.

    d(C X) = C R dA X + dC X + C R dB + dD,   R = (s - A)⁻¹,  X = R B
    """

    def __init__(self, loop: Loop, hz: Array) -> None:
        self.loop, self.hz = loop, hz
        omega = HZ * np.asarray(hz, float)
        self.s = loop.as_run[0].variable(omega)
        self.known: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def of(self, change: Change) -> tuple[Any, Any, Any]:
        hold = self.loop.sampling
        dG = dK = dfree = np.zeros((len(self.hz), 1, 1))
        if change.plant is not None:
            G = _stepped(self.loop.plant, change.plant)
            dG = dfree = self._change("free", G, 1j * HZ * self.hz)
            if hold is not None:
                dG = self._change("G", sampled(G, hold.period, hold.delay), self.s)
        if change.controller is not None:
            K = _stepped(self.loop.controller, change.controller)
            dK = self._change("K", K if hold is None else tustin(K, hold.period), self.s)
        return dG, dK, dfree

    def _change(self, name: str, system: StateSpace, s: np.ndarray) -> np.ndarray:
        """By the imaginary parts of a system's matrices over the step."""
        A, B, C = (np.real(part) for part in (system.A, system.B, system.C))
        dA, dB, dC, dD = (np.imag(part) / STEP for part in (system.A, system.B, system.C, system.D))
        if name not in self.known:
            R = np.linalg.inv(s[:, None, None] * np.eye(len(A)) - A)
            self.known[name] = (R @ B, C @ R)
        X, Y = self.known[name]
        return np.asarray((Y @ dA + dC) @ X + Y @ dB + dD)


def covariance(A: Array, Q: Array, *, sampled: bool) -> Array:
    """P of a stable process with Q symmetric; a sampled one's A is the change over a period."""
    if sampled:
        inverse = np.linalg.inv(2.0 * np.eye(len(A)) + A)
        A, Q = inverse @ A, 2.0 * inverse @ Q @ inverse.T
    P = solve_continuous_lyapunov(A, -Q)
    return np.asarray(0.5 * (P + P.T))
