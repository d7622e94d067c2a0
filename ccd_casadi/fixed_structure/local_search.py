"""A local search for the largest ω_b within the bounds, and the conditions of optimality at its
end."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ccd_casadi.fixed_structure.figures import assess, constraints, hessians, to_theta
from ccd_casadi.fixed_structure.loop_problem import Assessment, Constraints, LoopProblem
from ccd_casadi.optim.kkt import non_negative
from ccd_casadi.optim.quadratic_programmes import symmetric_rank_one
from ccd_casadi.optim.step import Data, Iterate, Rows, Step, TrustRegionModel
from ccd_casadi.optim.trust_region import Radius, minimise
from ccd_casadi.support.arrays import Array

Goal = Callable[[Array], tuple[float, Array]]


@dataclass(frozen=True)
class LocalSearchOptions:
    """Numbers of a local search; κ and τ are logarithms, radii are in them."""

    radius: float = 0.2  # the first
    largest_radius: float = 1.5
    penalty: float = 20.0  # ln ω_b per ln of a bound: above the sum of multipliers
    restoring_penalty: float = 400.0  # that of an end that is to be brought within its bounds
    merged: float = 1e-3  # in κ and τ: searches as close as that are one


@dataclass(frozen=True)
class DescentOptions:
    """Numbers of the search for the least value of a goal."""

    radius: float = 0.2  # the first
    least_radius: float = 1e-7
    largest_radius: float = 1.0
    penalties: tuple[float, ...] = (20.0, 200.0, 2000.0)  # the next where a bound is exceeded
    steps: int = 200  # with one penalty
    least_gain: float = 1e-9


@dataclass(frozen=True)
class Point:
    """A controller at a bandwidth, and how it keeps its bounds there.

    Attributes
    ----------
    kappa, tau : array (n,), float
        κ in the problem's units; ln(ω_b/ω₀).
    assessment : Assessment
    """

    kappa: Array
    tau: float
    assessment: Assessment

    def merit(self) -> float:
        """τ - ρ violation, to be made large."""
        return self.tau - LocalSearchOptions.penalty * self.assessment.violation


@dataclass(frozen=True)
class Ascent:
    """The state of a local search: its point, its radius, and how many loops it assessed.

    `done`: further steps do not help.
    """

    point: Point
    radius: float = LocalSearchOptions.radius
    evaluations: int = 1
    done: bool = False


class LoopModel(TrustRegionModel[Assessment]):
    """The bounds of a set of loops as rows over x = (κ, τ).

    Parameters
    ----------
    problem : LoopProblem
    goal : callable or None
        v(κ) and its gradient; None: none.
    reward : float
        Of τ in the objective.
    floor : float
        The least τ.

    Attributes
    ----------
    known : list of array
        x where searches have been; another one ends when it comes there.
    """

    corrected = True

    def __init__(
        self,
        problem: LoopProblem,
        goal: Goal | None = None,
        reward: float = 1.0,
        floor: float = -np.inf,
    ) -> None:
        self.problem, self.goal, self.reward = problem, goal, reward
        self.known: list[Array] = []
        # A step that fails is followed by one from the same place.
        self.all_rows = lru_cache(2)(
            lambda here: all_rows(problem, here.x[:-1], float(here.x[-1]), here.data)
        )
        # Where nothing bounds ω_b it stops at the end of the grid instead of running away.
        top = float(np.log(problem.plants.frequency(problem.base[-1])))
        self.low = np.append(problem.box[0], floor)
        self.high = np.append(problem.box[1], top)

    def at(self, x: Array) -> Iterate[Assessment] | None:
        """Assess x, provided that every loop is stable and v is finite."""
        kappa = np.clip(x[:-1], *self.problem.box)
        return self.make_iterate(kappa, float(x[-1]), assess(self.problem, kappa, float(x[-1])))

    def make_iterate(
        self, kappa: Array, tau: float, found: Assessment
    ) -> Iterate[Assessment] | None:
        """The iterate of an assessment."""
        value, slope = 0.0, np.zeros(len(kappa))
        if found.stable and self.goal is not None:
            value, slope = self.goal(kappa)
        if not found.stable or not np.isfinite(value):
            return None
        x, gradient = np.append(kappa, tau), np.append(slope, -self.reward)
        return Iterate(x, value - self.reward * tau, gradient, found.violation, found)

    def rows(self, here: Iterate[Assessment], radius: float) -> Rows:
        """Peaks with their curvature, and the grid near them without."""
        kappa, tau, peaks = here.x[:-1], float(here.x[-1]), here.data.peaks
        assert peaks is not None
        found = self.all_rows(here)

        def second(index: np.ndarray) -> Array:
            return hessians(self.problem, kappa, tau, found.only(index))

        slopes = np.column_stack([found.to_kappa, found.to_tau])
        return Rows(found.value, slopes, hessians=second, curved=len(peaks.v))

    def learn(
        self,
        H: Array,
        here: Iterate[Assessment],
        there: Iterate[Assessment],
        step: Step,
        radius: float,
    ) -> Array:
        """H by a symmetric rank-one update, where there is a goal v."""
        if self.goal is None:
            return H
        return symmetric_rank_one(H, there.x - here.x, there.gradient - here.gradient)

    def has_ended(self, here: Iterate[Assessment], there: Iterate[Assessment]) -> bool:
        """Decide whether another search has been there."""
        return self.is_known(there.x)

    def is_known(self, x: Array) -> bool:
        """Whether another search has been there."""
        return any(np.abs(x - other).max() <= LocalSearchOptions.merged for other in self.known)


def all_rows(problem: LoopProblem, kappa: Array, tau: float, found: Assessment) -> Constraints:
    """List every row that a step from a point takes into account.

    Parameters
    ----------
    problem, kappa, tau, found : LoopProblem, array (n,), float, Assessment
        The point and its assessment, all loops stable.

    Returns
    -------
    Constraints
        The peaks, and after them the values on the base grid near them.
    """
    assert found.peaks is not None
    assert found.near is not None
    return found.peaks.and_those(constraints(problem, kappa, tau, found.near))


def ascend(
    problem: LoopProblem,
    start: Point,
    *,
    iterations: int,
    radius: float = LocalSearchOptions.radius,
    least_radius: float = 1e-6,
    least_gain: float = 1e-8,
    restoring: bool = False,
    options: LocalSearchOptions = LocalSearchOptions(),
) -> Ascent:
    """Climb to a larger ω_b from a start whose loops are stable, until steps do not help.

    Parameters
    ----------
    problem, start : LoopProblem, Point
    iterations : int
        Steps at most.
    radius, least_radius, least_gain : float
        Of the trust region, in κ and τ; gain of the merit of a step below which it ends.
    restoring : bool
        Bring the point within its bounds first.
    options : LocalSearchOptions

    Returns
    -------
    Ascent
    """
    model = LoopModel(problem)
    model.restoring = restoring
    begin = model.make_iterate(start.kappa, start.tau, start.assessment)
    assert begin is not None
    n = len(begin.x)
    end = minimise(
        model, begin, np.zeros((n, n)), Radius(radius, least_radius, options.largest_radius),
        steps=iterations, penalty=options.restoring_penalty if restoring else options.penalty,
        least_gain=least_gain,
    )  # fmt: skip
    x = end.best.x
    point = Point(x[:-1], float(x[-1]), end.best.data)
    return Ascent(point, end.radius.value, end.evaluations, end.done)


def descend(
    model: TrustRegionModel[Data], start: Iterate[Data], H: Array, within: float,
    options: DescentOptions = DescentOptions(),
) -> tuple[Iterate[Data], int]:  # fmt: skip
    """Descend from a stable start to where steps help no longer, with rising penalties.

    Parameters
    ----------
    model : TrustRegionModel
    start : Iterate
    H : array (n + 1, n + 1)
        The first of v.
    within : float
        A violation that needs no larger penalty.
    options : DescentOptions

    Returns
    -------
    Iterate
        Its end.
    int
        How many loops were assessed.
    """
    end, evaluations = start, 0
    for penalty in options.penalties:
        found = minimise(
            model, end, H, Radius(options.radius, options.least_radius, options.largest_radius),
            steps=options.steps, penalty=penalty, least_gain=options.least_gain,
        )  # fmt: skip
        end, evaluations = found.best, evaluations + found.evaluations
        if end.violation <= within:
            break
    return end, evaluations


@dataclass(frozen=True)
class OptimalityOptions:
    """Numbers of the conditions of optimality.

    Attributes
    ----------
    active : float
        ln of the share of its bound within which a constraint binds.
    near : float
        The same within which it may bind at a kink that is all but reached.
    residual : float
        Of ∇τ, which is 1: above it there is no envelope gradient.
    """

    active: float = 1e-5
    near: float = 1e-3
    residual: float = 1e-3


@dataclass(frozen=True)
class Envelope:
    """Every gradient to θ that the optimality of the controller leaves to its value v:

        {direct + to_thetaᵀ μ :  rowsᵀ μ = goal,  μ >= 0}        in the unit of v

    over what binds.

    Attributes
    ----------
    names : tuple of str
        The kinds of the m constraints, which come first; the ends of κ's box have none.
    direct, to_theta : array (n_θ,), (m, n_θ)
    rows, goal : array (M, n + 1), (n + 1,)
        Slopes to (κ, τ).
    multipliers : array (M,)
        One such μ.
    slack : array (M,)
        ln of the distance of a constraint from its bound; with μ slack a row counts that all but
        binds.
    """

    names: tuple[str, ...]
    direct: Array
    to_theta: Array
    rows: Array
    goal: Array
    multipliers: Array
    slack: Array

    @property
    def gradient(self) -> Array:
        """dv/dθ (n_θ,) by the μ that is given: on one side, where there is a kink."""
        return self.direct + self.multipliers[: len(self.to_theta)] @ self.to_theta

    def times(self, scale: float) -> "Envelope":
        """Scale the envelope to that of `scale` v."""
        return replace(self, direct=scale * self.direct, to_theta=scale * self.to_theta)


@dataclass(frozen=True)
class Optimality:
    """The conditions rowsᵀ μ = goal, μ >= 0, of what binds at a point, and how well they hold.

    `rows` (M, n + 1) are slopes to (κ, τ): first of the `active` bounds, each named in `kinds`,
    then of the ends of κ's box, (name, "lower" or "upper"), and of a least τ. `multipliers` (M,):
    change of the goal per ln of what a row is held against, of which a bound is `shares`: all, but
    for a shape whose room is not open yet; `residual` is over ‖goal‖∞; `violation`: by how much a
    bound is passed (logarithm). `near`: what all but binds, which counts for none of this.
    """

    active: Constraints
    near: Constraints
    kinds: tuple[str, ...]
    box_ends: tuple[tuple[str, str], ...]
    rows: Array
    goal: Array
    multipliers: Array
    residual: float
    violation: float
    shares: Array

    @property
    def ends(self) -> tuple[tuple[str, str, float], ...]:
        """The parameters at an end of their box, with their multipliers."""
        mu = self.multipliers[len(self.kinds) :]
        return tuple((*end, float(value)) for end, value in zip(self.box_ends, mu, strict=False))

    def by_kind(self) -> dict[str, float]:
        """The multipliers by kind of bound, summed over plants and peaks."""
        found: dict[str, float] = {}
        for name, mu in zip(self.kinds, self.multipliers * self.shares, strict=False):
            if mu > 0.0:
                found[name] = found.get(name, 0.0) + float(mu)
        return found


def optimality(
    problem: LoopProblem, point: Point, goal: Array | None = None, floor: float = -np.inf,
    options: OptimalityOptions = OptimalityOptions(),
) -> Optimality:  # fmt: skip
    """Non-negative least squares on the active constraints of a point whose loops are stable.

    `goal` (n + 1,) is the gradient to (κ, τ) of what is made large, by default τ; `floor` the least
    τ.
    """
    peaks = point.assessment.peaks
    assert peaks is not None
    binds = np.abs(peaks.value) <= options.active
    active, near = peaks.only(binds), peaks.only(~binds & (np.abs(peaks.value) <= options.near))
    n = len(point.kappa)
    unit = np.eye(n + 1)
    rows, ends = [np.column_stack([active.to_kappa, active.to_tau])], []
    for i, name in enumerate(problem.structure.names):
        for row, sign, word in ((0, -1.0, "lower"), (1, 1.0, "upper")):
            if abs(point.kappa[i] - problem.box[row, i]) <= options.active:
                rows.append(sign * unit[i : i + 1])
                ends.append((name, word))
    if abs(point.tau - floor) <= options.active:
        rows.append(-unit[n:])
    shares, closed = np.ones(sum(map(len, rows))), problem.closed_share(active, point.tau)
    # ∂ ln(shape x - (shape - 1)/x)/∂ ln shape
    shares[: len(closed)] -= problem.inverse_square(active, point.tau)
    shares[: len(closed)] /= 1.0 - closed
    matrix, goal = np.concatenate(rows), unit[n] if goal is None else goal
    return Optimality(
        active, near, tuple(problem.kinds_of(active)), tuple(ends), matrix, goal,
        *non_negative(matrix, goal), point.assessment.violation, shares,
    )  # fmt: skip


def envelope_of(
    problem: LoopProblem, kappa: Array, optimality: Optimality, direct: Array | None = None,
    options: OptimalityOptions = OptimalityOptions(),
) -> Envelope | None:  # fmt: skip
    """Compute the envelope of ln ω_b*(θ), or of a value made small whose slope at a fixed κ is
    `direct` (n_θ,).

    None where the conditions of optimality do not hold.
    """
    if optimality.residual > options.residual or optimality.violation > options.active:
        return None
    near, count = optimality.near, len(optimality.kinds)
    slopes = np.concatenate([to_theta(problem, kappa, part) for part in (optimality.active, near)])
    if direct is None:
        direct, slopes = np.zeros(slopes.shape[1]), -slopes
    at = np.full(len(near.v), count)  # behind those that bind, before the ends of the box
    rows = np.insert(optimality.rows, at, np.column_stack([near.to_kappa, near.to_tau]), axis=0)
    return Envelope(
        (*optimality.kinds, *problem.kinds_of(near)), direct, slopes, rows, optimality.goal,
        np.insert(optimality.multipliers, at, 0.0),
        np.insert(np.zeros(len(optimality.rows)), at, np.abs(near.value)),
    )  # fmt: skip
