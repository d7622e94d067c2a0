"""Steps for the largest of several smooth pieces within a box.

Each piece is known by its value and gradient where it was met; a step solves the linear or
quadratic model of the largest of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ccd_casadi.optim.quadratic_programmes import damped_bfgs
from ccd_casadi.optim.step import Iterate, Rows, Step, TrustRegionModel, best_step
from ccd_casadi.optim.trust_region import Radius, minimise
from ccd_casadi.support.arrays import Array


class Box(NamedTuple):
    """The box lower <= x <= upper.

    Attributes
    ----------
    lower, upper : array (n,)
    """

    lower: Array
    upper: Array

    @property
    def width(self) -> Array:
        """The widths of its sides (n,)."""
        return self.upper - self.lower

    def shares(self, x: ArrayLike) -> Array:
        """z of points x (…, n)."""
        return np.asarray(np.subtract(x, self.lower) / self.width)

    def point(self, z: Array) -> Array:
        """x of points z (…, n), kept in the box against rounding."""
        return np.clip(self.lower + self.width * z, self.lower, self.upper)

    def away(self, x: ArrayLike, other: ArrayLike) -> Array:
        """The largest component of x - other (…, n), in shares."""
        return np.asarray(np.abs(np.subtract(x, other) / self.width).max(axis=-1))

    def around(self, x: Array | Sequence[float], radius: float) -> "Box":
        """The part of it within `radius` shares of x."""
        half = radius * self.width
        return Box(np.maximum(self.lower, x - half), np.minimum(self.upper, x + half))


Constraints = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class PiecesOptions:
    """Numbers of the descent on pieces; lengths are shares of the box.

    Attributes
    ----------
    radius : float
        The first.
    least_radius : float
    largest_radius : float
    near : float
        Radii from the best point within which a piece counts.
    pieces : int
        Per variable, at most.
    lowering : float
        Of the largest slope, per length: by what a piece is lowered at least.
    restorations : int
        Newton steps back to λ <= 0.
    inside : float
        Of λ.
    held : float
        Share of a piece in the combination above which it counts.
    straight : float
        Of the change of slope: how far J may be off the mean slope.
    jump : float
        Times the slopes on both sides: what is steeper is not a kink.
    jump_length : float
        Within which no other piece is as steep.
    basin : float
        Of an optimum that is known: this close and no lower is its basin.
    """

    radius: float = 1e-2
    least_radius: float = 1e-10
    largest_radius: float = 0.2
    near: float = 4.0
    pieces: int = 8
    lowering: float = 0.5
    restorations: int = 5
    inside: float = 1e-10
    held: float = 1e-3
    straight: float = 0.05
    jump: float = 10.0
    jump_length: float = 1e-3
    basin: float = 1e-2


@dataclass(frozen=True)
class Local:
    """J at a point of the unit box.

    Attributes
    ----------
    z, value, gradient : array (n,), float, array (n,)
        ∇J is that of one piece, where there is a kink.
    """

    z: Array
    value: float
    gradient: Array


def jumps(a: Local, b: Local, options: PiecesOptions = PiecesOptions()) -> bool:
    """Whether J is not continuous between two points near by, by the slopes at both."""
    away = float(np.abs(b.z - a.z).max())
    steepest = max(float(np.abs(one.gradient).sum()) for one in (a, b))
    rise = abs(b.value - a.value)
    return away < options.jump_length and rise > options.jump * steepest * away


def descend(
    at: Callable[[Array], Local | None],
    start: Local,
    known: Callable[[], Sequence[Local]],
    constraints: Constraints,
    *,
    steps: int,
    settled: float,
    first: float = PiecesOptions.radius,
    ended: Sequence[tuple[Array, float]] = (),
    options: PiecesOptions = PiecesOptions(),
) -> Local:
    """Minimise the largest of several smooth pieces over the unit box, with λ <= 0.

    Parameters
    ----------
    at : callable
        J at z; None where it is not known.
    start : Local
        With λ <= 0.
    known : callable
        All points that were met, at any time, each as it is known by then.
    constraints : callable
        λ (m,) and ∇λ (m, n) at z.
    steps, settled : int, float
        New points at most; gain relative to J that ends the descent.
    first : float
        The first radius, a share of the box.
    ended : sequence of (z, J)
        Optima where others ended.
    options : PiecesOptions

    Returns
    -------
    Local
        The best point, where the pieces predict no more, beside a jump of J, or in the basin of one
        that `ended`.
    """
    n, radius = start.z.size, Radius(first, options.least_radius, options.largest_radius)
    model = _Pieces(at, start, known, constraints, ended, options)
    end = minimise(
        model, model.iterate(start), np.zeros((n, n)), radius, steps=steps,
        penalty=model.size, least_gain=settled * abs(start.value),
    )  # fmt: skip
    return end.best.data


class _Pieces(TrustRegionModel[Local]):
    """The pieces as rows in the unit `size`, the slope of the first."""

    carried = True

    def __init__(
        self, J: Callable[[Array], Local | None], start: Local,
        known: Callable[[], Sequence[Local]], constraints: Constraints,
        optima: Sequence[tuple[Array, float]], numbers: PiecesOptions,
    ) -> None:  # fmt: skip
        self.J, self.known, self.constraints, self.optima = J, known, constraints, optima
        self.numbers = numbers
        self.low, self.high = np.zeros(start.z.size), np.ones(start.z.size)
        self.size = max(float(np.abs(start.gradient).max()), 1e-300)

    def iterate(self, here: Local) -> Iterate[Local]:
        """J counts in the merit, and of the model the pieces alone."""
        return Iterate(here.z, here.value, np.zeros(here.z.size), 0.0, here)

    def at(self, x: Array) -> Iterate[Local] | None:
        """A point with λ <= 0, and one piece more."""
        z = _restore(np.clip(x, 0.0, 1.0), self.constraints, self.numbers)
        there = None if z is None else self.J(z)
        return None if there is None else self.iterate(there)

    def rows(self, here: Iterate[Local], radius: float) -> Rows:
        """The pieces near by less J, and λ, which no σ pays for."""
        best, n, numbers = here.data, here.x.size, self.numbers
        pieces = [best, *(one for one in self.known() if (one.z != best.z).any())]
        away = np.array([best.z - piece.z for piece in pieces])
        far = np.abs(away).max(axis=1)
        near = np.argsort(far, kind="stable")[: numbers.pieces * n]
        chosen = near[far[near] <= numbers.near * radius]
        slopes, away = np.array([pieces[i].gradient for i in chosen]), away[chosen]
        value = np.array([pieces[i].value for i in chosen]) + (slopes * away).sum(axis=1)
        steepest = float(np.abs(best.gradient).max())
        lowered = numbers.lowering * steepest * (away**2).sum(axis=1)
        below = np.maximum(best.value - value, lowered)
        g, jacobian = self.constraints(best.z)
        return Rows(
            np.append(-below / self.size, np.minimum(g + numbers.inside, 0.0)),
            np.vstack([slopes / self.size, jacobian.reshape(-1, n)]),
            hard=np.arange(len(chosen) + len(g)) >= len(chosen),
        )

    def learn(
        self, H: Array, here: Iterate[Local], there: Iterate[Local], step: Step, radius: float
    ) -> Array:
        """Update the Hessian of the pieces' combination; after a step too far along one piece, of
        that one."""
        a, b, moved, numbers = here.data, there.data, there.x - here.x, self.numbers
        change = b.gradient - a.gradient
        if b.value >= a.value:
            # A kink between would have to lie in the middle for the mean slope to give the rise.
            bend = b.value - a.value - 0.5 * float((a.gradient + b.gradient) @ moved)
            kink = abs(bend) > numbers.straight * abs(float(change @ moved))
            if kink or H.any() or self._shares(step)[0] < 1.0 - numbers.held:
                return H
        else:
            after = best_step(self, there, H, radius, self.size)
            if after is None:
                return H
            counts = (self._shares(one) > numbers.held for one in (step, after))
            held, holding = (int(count.sum()) for count in counts)
            if held != holding:
                return H  # across a kink that has just been met the slopes show no curvature
            change = self._combine(after) - self._combine(step)
        if not H.any():
            seen = abs(float(moved @ change)) / float(moved @ moved)
            H = max(seen, 1e-3 * float(np.abs(there.data.gradient).max())) * np.eye(len(H))
        return damped_bfgs(H, moved, change) if H.any() else H

    def has_ended(self, here: Iterate[Local], there: Iterate[Local]) -> bool:
        """Decide whether the step is beside a jump, or in the basin of an optimum that is known,
        and no lower."""
        if there.value > here.value and jumps(here.data, there.data, self.numbers):
            return True
        basin = self.numbers.basin
        return any(there.value >= J and np.abs(there.x - z).max() <= basin for z, J in self.optima)

    def _shares(self, step: Step) -> Array:
        """Return the share of each piece in the combination that holds a step."""
        assert step.rows.hard is not None
        mu = np.where(step.rows.hard, 0.0, step.multipliers)
        return np.asarray(mu / max(float(mu.sum()), 1e-300))

    def _combine(self, step: Step) -> Array:
        return np.asarray(self._shares(step) @ (self.size * step.rows.slopes))


def _restore(z: Array, constraints: Constraints, options: PiecesOptions) -> Array | None:
    """The point, moved to λ <= 0 by the least that its slopes require; None where that fails."""
    for _ in range(options.restorations):
        g, jacobian = constraints(z)
        broken = g > 0.0
        if not broken.any():
            return z
        shift = np.linalg.lstsq(jacobian[broken], g[broken] + options.inside, rcond=None)[0]
        z = np.clip(z - shift, 0.0, 1.0)
    return None
