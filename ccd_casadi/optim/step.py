"""The model of a trust region around an iterate, and the best step that it knows.

    min ∇f·p + ½ pᵀ H p + ρ σ   s.t.  c + ∇c p + ½ pᵀ ∇²c p <= σ,  |p| <= Δ,  0 <= σ,

by convex programmes around the step before (`best_step`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from ccd_casadi.optim.quadratic_programmes import convex, solve_elastic
from ccd_casadi.support.arrays import Array

Data = TypeVar("Data")


@dataclass(frozen=True)
class StepOptions:
    """Numbers of a step: of its quadratic programmes and their merit.

    Attributes
    ----------
    programmes : int
        Around each other, for one step.
    little : float
        Share of the gain that one more programme has to add.
    shares : tuple of float
        Of the way to a programme's solution.
    settled : float
        Share of the radius: a programme that moves less is the last.
    holds : float
        Share of the penalty: multiplier of a row that holds the step.
    bends : float
        Share of the sizes of a row's parts by which its unknown curvature may move it.
    flat : float
        Share of the slopes: least curvature, which makes a linear programme definite.
    convexifying : float
        Times AᵀA of the rows that hold, which changes nothing along them.
    fading : float
        Share of a penalty that a larger sum of multipliers left, at each step.
    curved_penalty : float
        Over the sum of multipliers and slope, where rows are curved.
    elastic_penalty : float
        Of the programme over the merit's, where that grows.
    """

    programmes: int = 12
    little: float = 1e-2
    shares: tuple[float, ...] = (1.0, 0.5, 0.25, 0.125)
    settled: float = 1e-2
    holds: float = 1e-7
    bends: float = 0.2
    flat: float = 1e-4
    convexifying: float = 10.0
    fading: float = 0.1
    curved_penalty: float = 2.0
    elastic_penalty: float = 10.0


@dataclass(frozen=True)
class Rows:
    """The constraints of a step at an iterate.

    Attributes
    ----------
    value, slopes : array (m,), (m, n)
        c and ∇c, in the unit of the violation.
    hard : array (m,) of bool, optional
        Rows that a step keeps without σ.
    margin : array (m,), optional
        By how much a step keeps further inside; less as the radius shrinks.
    hessians : callable, optional
        (k, n, n) of rows given by index, for the first `curved` of them.
    curved : int
    """

    value: Array
    slopes: Array
    hard: np.ndarray | None = None
    margin: Array | None = None
    hessians: Callable[[np.ndarray], Array] | None = None
    curved: int = 0


@dataclass(frozen=True, eq=False)
class Iterate(Generic[Data]):
    """A point of the search.

    Attributes
    ----------
    x, value, gradient : array (n,), float, array (n,)
        x, f and ∇f.
    violation : float
        The largest c above 0.
    data : object
        What its rows are made from.
    """

    x: Array
    value: float
    gradient: Array
    violation: float
    data: Data


@dataclass(frozen=True)
class Step:
    """A step of the model.

    Attributes
    ----------
    change : array (n,)
        p.
    predicted, straight : float
        Gain of merit that the model predicts, and that with linear rows.
    hessian : array (n, n)
        Of the last programme.
    multipliers, rows : array (m,), Rows
    penalty : float
        Of the merit.
    """

    change: Array
    predicted: float
    straight: float
    hessian: Array
    multipliers: Array
    rows: Rows
    penalty: float

    @property
    def size(self) -> float:
        """The size |p|∞."""
        return float(np.abs(self.change).max())


class TrustRegionModel(ABC, Generic[Data]):
    """The model of a trust-region method: what is minimised over `low` <= x <= `high`, and how its
    curvature is learnt.

    Attributes
    ----------
    low, high : array (n,)
    carried : bool
        σ >= 0 falls away: f is the largest row.
    corrected : bool
        A trial that gains too little is corrected to second order.
    growing : bool
        The penalty grows with the multipliers.
    restoring : bool
        The merit counts the whole penalty: the rows go before the goal.
    bending : bool
        A row that ends below its bound by little of what it moves counts with its curvature, as it
        may bend over it. Searches over K alone end in better optima without.
    step_options : StepOptions
    """

    low: Array
    high: Array
    carried = False
    corrected = False
    growing = False
    restoring = False
    bending = False
    step_options = StepOptions()

    @abstractmethod
    def at(self, x: Array) -> Iterate[Data] | None:
        """The iterate at x (n,) or near it; None where it cannot be used."""

    @abstractmethod
    def rows(self, here: Iterate[Data], radius: float) -> Rows:
        """Return the rows that a step of this radius has to keep."""

    def learn(
        self, H: Array, here: Iterate[Data], there: Iterate[Data], step: Step, radius: float
    ) -> Array:
        """The Hessian (n, n) of f, or of the Lagrangian where rows have none, after a trial."""
        return H

    def has_ended(self, here: Iterate[Data], there: Iterate[Data]) -> bool:
        """Whether a trial shows that further steps are of no use."""
        return False


@dataclass(frozen=True)
class _CurvedRows:
    """The rows c(p) = c + ∇c p + ½ pᵀ ∇²c p that a step may lift over their bounds.

    Attributes
    ----------
    value, slopes : array (k,), (k, n)
        c and ∇c.
    elastic : array (k,)
        1 where σ may lift the bound, 0 of a row that must hold.
    bending : array (b,) of int
        The rows whose ∇²c is known.
    hessians : array (b, n, n)
        Theirs; of the others ∇²c counts as 0.
    """

    value: Array
    slopes: Array
    elastic: Array
    bending: np.ndarray
    hessians: Array

    def levels(self, ends: Array) -> Array:
        """c(p) at p (j, n): (j, k)."""
        found = self.value + ends @ self.slopes.T
        found[:, self.bending] += 0.5 * ((ends @ self.hessians) * ends).sum(axis=2).T
        return found

    def tangent(self, p: Array) -> tuple[Array, Array]:
        """Slopes A (k, n) and offset (k,) of the rows linear at p, so that c(p) = A p + offset."""
        A, offset, bend = self.slopes.copy(), self.value.copy(), self.hessians @ p
        A[self.bending] += bend
        offset[self.bending] -= 0.5 * bend @ p
        return A, offset

    def curved_along(self, way: Array, offset: Array) -> Array:
        """An offset, with what the rows bend along a way from where they are linear."""
        found = offset.copy()
        found[self.bending] += 0.5 * (self.hessians @ way) @ way
        return found

    def with_hessians(self, rows: np.ndarray, hessians: Array) -> "_CurvedRows":
        """With those of further rows."""
        return replace(self, bending=np.concatenate([self.bending, rows]),
                       hessians=np.concatenate([self.hessians, hessians]))  # fmt: skip


@dataclass(frozen=True)
class _StepProgramme:
    """A quadratic programme of a step around p, with rows A p + offset <= σ.

    Attributes
    ----------
    p : array (n,)
        Around which it is: M acts on what a solution differs from it.
    near : float
        How far from p a solution may be.
    M : array (n, n)
        Positive definite.
    A, offset : array (k, n), (k,)
    """

    p: Array
    near: float
    M: Array
    A: Array
    offset: Array


def best_step(
    model: TrustRegionModel[Data], here: Iterate[Data], H: Array, radius: float, penalty: float
) -> Step | None:
    """Find the best step that the model knows.

    It minimises the model of the merit, φ(p) = ∇f·p + ½ pᵀ H p + ρ max(0, max c(p)), by programmes
    around each other, the first one around 0:

    1. The solution w of the programme around p, and the multipliers μ of its rows.
    2. Rows that hold w, or may bend over their bounds there, get their Hessians.
    3. The best by φ of some shares of the way from p to w. If it is not the whole way, a programme
       whose rows bend as they do on it gives one point more.
    4. The next programme is around that point: its rows are linear there, its Hessian is that of
       the Lagrangian, H + Σ μ ∇²c, made convex. Where φ does not fall, it is nearer to p instead.

    Parameters
    ----------
    model, here : TrustRegionModel, Iterate
    H : array (n, n)
    radius, penalty : float
        Δ and ρ.

    Returns
    -------
    Step or None
        None where the first programme has no solution.
    """
    rows, options = model.rows(here, radius), model.step_options
    chosen, curved = _rows_in_reach(model, rows, len(here.x), radius)
    soft = slice(None) if rows.hard is None else curved.elastic > 0.0
    unit = unit_of_step(here, penalty if model.carried else 0.0)
    weight = options.elastic_penalty * (unit + penalty) if model.growing else penalty
    low, high = ends_of_step(model, here, radius)

    def solution(at: _StepProgramme, offset: Array) -> tuple[Array, Array] | None:
        cost = here.gradient + (H - at.M) @ at.p
        ends = np.maximum(low, at.p - at.near), np.minimum(high, at.p + at.near)
        return solve_elastic(at.M, cost, at.A, offset, curved.elastic, *ends, weight, radius, unit,
                             free=model.carried)  # fmt: skip

    def gains(ends: Array) -> Array:
        """φ(0) - φ(p) at p (j, n)."""
        most = curved.levels(ends)[:, soft].max(axis=1, initial=-np.inf if model.carried else 0.0)
        curve = 0.5 * ((ends @ H) * ends).sum(axis=1)
        return np.asarray(penalty * (here.violation - most) - ends @ here.gradient - curve)

    margin = 0.0 if rows.margin is None else rows.margin[chosen]
    M = convex(H, options.flat * unit)
    at = _StepProgramme(np.zeros(len(here.x)), radius, M, curved.slopes, curved.value + margin)
    best, straight = None, 0.0
    for turn in range(options.programmes):
        if (found := solution(at, at.offset)) is None:
            break
        w, mu = found
        if model.growing:
            penalty = max(options.fading * penalty, 2.0 * float(mu.sum()))
        elif rows.curved and not model.restoring:
            penalty = min(weight, options.curved_penalty * float(mu.sum() + unit))
        if turn == 0:
            straight = float(gains((w - at.p)[None])[0])
        holds = mu > options.holds * weight
        fresh = _rows_to_bend(model, curved, at, w, holds, chosen < rows.curved)
        if len(fresh) and rows.hessians is not None:
            curved = curved.with_hessians(fresh, rows.hessians(chosen[fresh]))
        # The rows bend less on part of the way: a whole one may lead further and further out.
        shares = np.array(options.shares if rows.curved else options.shares[:1])
        way = w - at.p
        tried = at.p + shares[:, None] * way
        known, *reached = gains(np.vstack([at.p, tried])).tolist()
        if turn and reached[0] < max(reached):
            other = solution(at, curved.curved_along(way, at.offset))
            if other is not None:
                tried = np.vstack([tried, other[0]])
                reached += gains(other[0][None]).tolist()
        predicted, size = max(reached), float(np.abs(way).max())
        better = predicted - known
        if better > 0.0 or not rows.curved:
            end = tried[reached.index(predicted)]
            at = replace(at, p=end, near=2.0 * float(np.abs(end - at.p).max()))
        else:
            at, predicted = replace(at, near=0.5 * options.shares[-1] * size), known
        if rows.curved:
            A, offset = curved.tangent(at.p)
            of_rows = np.where(holds, mu, 0.0)[curved.bending]
            lagrangian = H + np.einsum("m,mij->ij", of_rows, curved.hessians)
            M = lagrangian + options.convexifying * A[holds].T @ A[holds]
            at = replace(at, A=A, offset=offset, M=convex(M, options.flat * unit))
        multipliers = np.zeros(len(rows.value))
        multipliers[chosen] = mu
        best = Step(at.p, predicted, straight, at.M, multipliers, rows, penalty)
        settled = size < options.settled * radius
        little = better < options.little * predicted if better > 0.0 else settled
        if not rows.curved or (turn and little and not len(fresh)):
            break
    return best


def _rows_in_reach(
    model: TrustRegionModel[Data], rows: Rows, n: int, radius: float
) -> tuple[np.ndarray, _CurvedRows]:
    """The rows that a step of this radius may lift over their bounds, by index, and as they are."""
    chosen = np.arange(len(rows.value))
    if not model.carried:
        margin = np.zeros(len(rows.value)) if rows.margin is None else rows.margin
        chosen = rows_within_reach(rows.value + margin, rows.slopes, radius)
    elastic = np.ones(len(chosen)) if rows.hard is None else 1.0 - rows.hard[chosen]
    none = np.zeros(0, int), np.zeros((0, n, n))
    return chosen, _CurvedRows(rows.value[chosen], rows.slopes[chosen], elastic, *none)


def _rows_to_bend(
    model: TrustRegionModel[Data], curved: _CurvedRows, at: _StepProgramme, w: Array,
    holds: np.ndarray, known: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """The rows whose Hessians are `known` and not used yet: they hold w, or are so near to their
    bounds there that they may bend over them."""
    counts = holds.copy()
    if model.bending:
        moved = np.abs(curved.slopes) @ np.abs(w)
        counts |= at.offset + at.A @ w > -model.step_options.bends * moved
    counts[curved.bending] = False
    return np.flatnonzero(counts & known)


def rows_within_reach(value: Array, slopes: Array, radius: float) -> np.ndarray:
    """The rows that a step can lift over their bounds: those that are over them first, by how far,
    then those that the shortest step lifts."""
    away = -value / np.maximum(np.abs(slopes).sum(1), 1e-300)
    over = value > 0.0
    order = np.lexsort((np.where(over, -value, away), ~over))
    return np.asarray(order[away[order] < radius])


def unit_of_step(here: Iterate[Data], carried: float) -> float:
    """The size of what is minimised, per unit of a variable."""
    return max(float(np.abs(here.gradient).max()), carried, 1e-300)


def ends_of_step(
    model: TrustRegionModel[Data], here: Iterate[Data], radius: float
) -> tuple[Array, Array]:
    low = np.minimum(np.maximum(model.low - here.x, -radius), 0.0)
    return low, np.maximum(np.minimum(model.high - here.x, radius), 0.0)
