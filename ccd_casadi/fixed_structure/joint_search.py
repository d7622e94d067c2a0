"""Hardware and controller together: J over θ, κ and ω_b within the bounds of every loop.

    min cost(z) - reward e^(τ - τ₀),   c(κ, τ; z) <= 0,  λ(z) <= 0,      z: θ in shares of its box

by `optim.trust_region`, with the rows of `local_search` and their slopes to z. Where c bends, it
bends most where a resonance that moves with z meets a notch that moves with κ: its Hessian is that
of (z, κ, τ), by differences of exact slopes along z.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import cast

import numpy as np

from ccd_casadi.fixed_structure.composite import CompositeProblem
from ccd_casadi.fixed_structure.figures import STEP, assess, evaluate_rows, hessians, to_theta
from ccd_casadi.fixed_structure.local_search import all_rows
from ccd_casadi.fixed_structure.loop_problem import Assessment, Constraints, LoopProblem
from ccd_casadi.kernels.limits import Curve
from ccd_casadi.optim.trust_region import Iterate, Model, Rows
from ccd_casadi.support.arrays import Array

BESIDE = 1e-6  # of the box of θ: differences, much less than the half width of a resonance
UNLIKE = 0.1  # relative: mixed differences that a smooth row has alike
FAR = 3.0  # radii of κ and τ by which a row may lie below its bound and still be looked at

ToFirstOrder = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class Goal:
    """The cost of z and its slopes (n,), λ (m,) and its slopes (m, n), what e^(τ - τ₀) is worth."""

    cost: Callable[[Array], tuple[float, Array]]
    constraints: ToFirstOrder
    reward: float
    tau: float


@dataclass(frozen=True)
class Joint:
    """The loops at a point x = (z, κ, τ)."""

    problem: LoopProblem
    assessment: Assessment


class JointModel(Model[Joint]):
    """`family` gives the loops of the set at z, in the same units at every z; `low` and `high`
    bound z. J counts in its reward."""

    corrected = True

    def __init__(
        self, family: Callable[[Array], LoopProblem], goal: Goal, low: Array, high: Array
    ) -> None:
        self.family, self.goal, self.count = family, goal, len(low)
        kappa = family(0.5 * (low + high)).box
        self.low = np.concatenate([low, kappa[0], [-np.inf]])
        self.high = np.concatenate([high, kappa[1], [np.inf]])

    def at(self, x: Array) -> Iterate[Joint] | None:
        """With every loop stable."""
        x = np.clip(x, self.low, self.high)
        z, kappa, tau = self._parts(x)
        problem = self.family(z)
        found = assess(problem, kappa, tau)
        if not found.stable:
            return None
        cost, slope = self.goal.cost(z)
        worth = float(np.exp(tau - self.goal.tau))
        gradient = np.concatenate([slope / self.goal.reward, np.zeros(len(kappa)), [-worth]])
        violation = max(found.violation, float(self.goal.constraints(z)[0].max(initial=0.0)))
        value = cost / self.goal.reward - worth
        return Iterate(x, value, gradient, violation, Joint(problem, found))

    def rows(self, here: Iterate[Joint], radius: float) -> Rows:
        """Peaks, λ, and the grid near the peaks."""
        z, kappa, tau = self._parts(here.x)
        problem, found = here.data.problem, all_rows(here.data.assessment)
        peaks = here.data.assessment.peaks
        assert peaks is not None
        steep = np.abs(found.to_kappa).sum(1) + np.abs(found.to_tau)
        kept = np.flatnonzero(found.value + FAR * radius * np.maximum(steep, 1.0) > 0.0)
        curved = int((kept < len(peaks.v)).sum())
        found = found.only(kept)
        own = to_theta(problem, kappa, found)
        value, slope = self.goal.constraints(z)
        slopes = np.zeros((len(found.v) + len(value), len(here.x)))
        slopes[: len(found.v)] = np.column_stack([own, found.to_kappa, found.to_tau])
        slopes[len(found.v) :, : self.count] = slope

        def second(index: np.ndarray) -> Array:
            others = [self.family(z + BESIDE * unit) for unit in np.eye(self.count)]
            return joint_hessians(problem, others, kappa, tau, found.only(index))

        return Rows(
            np.concatenate([found.value, value]), slopes,
            hard=np.arange(len(slopes)) >= len(found.v), hessians=second, curved=curved,
        )  # fmt: skip

    def _parts(self, x: Array) -> tuple[Array, Array, float]:
        return x[: self.count], x[self.count : -1], float(x[-1])


@singledispatch
def joint_hessians(
    problem: LoopProblem, others: Sequence[LoopProblem], kappa: Array, tau: float, rows: Constraints
) -> Array:
    """(M, k + n + 1, k + n + 1): ∂²c_j to (z, κ, τ); `others` (k,) are the loops `BESIDE` along z.

    At a fixed frequency by differences of exact slopes; a peak moves as z and κ do (`hessians`).
    """
    k, n, m = len(others), len(kappa), len(rows.v)
    out = np.zeros((m, k + n + 1, k + n + 1))
    if not m:
        return out
    out[:, k:, k:] = hessians(problem, kappa, tau, rows)

    def at(place: LoopProblem, v: Array) -> tuple[Array, Array]:
        return evaluate_rows(place, kappa, tau, rows.curve, rows.plant, v)[1:3]

    slope, to_kappa = at(problem, rows.v)
    (up, kappa_up), (down, kappa_down) = (at(problem, rows.v * np.exp(s)) for s in (STEP, -STEP))
    c_xx, c_xk = (up - down) / (2.0 * STEP), (kappa_up - kappa_down) / (2.0 * STEP)
    to_z, c_xz = to_theta(problem, kappa, rows), np.zeros((m, k))
    for i, other in enumerate(others):
        moved, kappa_moved = at(other, rows.v)
        c_xz[:, i] = (moved - slope) / BESIDE
        out[:, i, k:-1] = out[:, k:-1, i] = (kappa_moved - to_kappa) / BESIDE
        out[:, i, :k] = (to_theta(other, kappa, rows) - to_z) / BESIDE
    out[:, :k, :k] = 0.5 * (out[:, :k, :k] + out[:, :k, :k].transpose(0, 2, 1))
    end = rows.curve == Curve.CROSSING
    fixed = end | (rows.curve == Curve.S_LOW)
    top = ~fixed & (c_xx < 0.0) & (np.abs(slope) < 1e-3 * np.sqrt(np.abs(c_xx)))
    shift = c_xz / np.where(top, -c_xx, np.inf)[:, None]
    cross = shift[:, :, None] * c_xk[:, None, :]
    out[:, :k, :k] += shift[:, :, None] * c_xz[:, None, :]
    out[:, :k, k:-1] += cross
    out[:, k:-1, :k] += cross.transpose(0, 2, 1)
    # Where singular values cross no difference means anything: the two orders of it disagree.
    aside = [to_theta(problem, kappa, replace(rows, v=rows.v * np.exp(s))) for s in (STEP, -STEP)]
    c_zx = (aside[0] - aside[1]) / (2.0 * STEP)
    out[np.abs(c_xz - c_zx).max(axis=1) > UNLIKE * (1.0 + np.abs(c_zx).max(axis=1))] = 0.0
    if end.any():
        chain = rows.to_tau[end] / np.where(slope[end] == 0.0, 1.0, slope[end])
        out[end, :k, -1] = out[end, -1, :k] = chain[:, None] * c_xz[end]
    return out


@joint_hessians.register
def _(
    problem: CompositeProblem, others: Sequence[LoopProblem], kappa: Array, tau: float,
    rows: Constraints,
) -> Array:  # fmt: skip
    k, n = len(others), len(kappa)
    out = np.zeros((len(rows.v), k + n + 1, k + n + 1))
    beside = [cast(CompositeProblem, other).parts for other in others]
    for number, (part, at, own) in enumerate(problem.split(rows)):
        place = np.concatenate([np.arange(k), k + part.place, [k + n]])
        near = [parts[number].problem for parts in beside]
        inner = joint_hessians(part.problem, near, kappa[part.place], tau + part.lead, own)
        spread = np.zeros((len(place), k + n + 1))
        spread[range(len(place)), place] = 1.0
        out[at] = spread.T @ inner @ spread
    return out
