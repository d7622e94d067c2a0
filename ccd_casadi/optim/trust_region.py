"""A trust region for a smooth goal within elastic rows.

    min f(x) + ρ max(0, max c(x))   over   low <= x <= high,

or min f(x) + ρ max c(x), where the rows carry the goal (the pieces of a largest function). A step p
solves

    min ∇f·p + ½ pᵀ H p + ρ σ   s.t.  c + ∇c p (+ ½ pᵀ ∇²c p) <= σ,  |p| <= Δ,  0 <= σ,

with ½ pᵀ ∇²c p by programmes around the step before, whose Hessian is that of the Lagrangian, made
convex (Fletcher and Sainz de la Maza 1989), each within a region of its own and corrected to second
order, so that what the model promises grows from one to the next. A trial counts where the merit
falls. What is minimised and how its curvature is learnt is the `TrustRegionModel`'s; `Radius` is
how far a step is trusted.
"""

from dataclasses import dataclass, replace
from typing import Generic, NamedTuple

import numpy as np

from ccd_casadi.optim.quadratic_programmes import solve_elastic
from ccd_casadi.optim.step import (
    Data,
    Iterate,
    Step,
    TrustRegionModel,
    best_step,
    ends_of_step,
    rows_within_reach,
    unit_of_step,
)
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class RadiusOptions:
    """Numbers of the radius of a trust region."""

    good: float = 0.7  # of the predicted gain, above which a model is trusted further
    poor: float = 0.2  # of the predicted gain, below which it is trusted less far
    shrink: float = 0.5  # of the radius, after a poor step
    grow: float = 1.4  # lengths of a good step: the radius after it
    steady: int = 3  # steps at one radius, each of a middling gain, after which it is widened
    widen: float = 10.0
    zoom: float = 4.0  # lengths of a step to which a radius is reduced that is too large for it


@dataclass(frozen=True)
class Radius:
    """The radius of the trust region: how far a step may go in each variable.

    Attributes
    ----------
    value, least, largest : float
        In the unit of the variables; a search ends below `least`.
    steady : int
        Steps since it changed.
    options : RadiusOptions
    """

    value: float
    least: float
    largest: float
    steady: int = 0
    options: RadiusOptions = RadiusOptions()

    def times(self, factor: float) -> "Radius":
        """A smaller or larger one."""
        return replace(self, value=min(factor * self.value, self.largest), steady=0)

    def after(self, gained: float, step: Step) -> "Radius":
        """Update the radius after a step of this predicted gain."""
        options = self.options
        if gained > options.good * step.predicted:
            value = min(max(self.value, options.grow * step.size), self.largest)
            return replace(self, value=value, steady=0)
        if gained < options.poor * step.predicted:
            return replace(self, value=options.shrink * min(self.value, step.size), steady=0)
        if self.steady + 1 == options.steady:
            # What a small step gains less than predicted may be a violation so small that the
            # linear rows overshoot it, whatever the radius: it is the gain that requires more.
            return self.times(options.widen)
        return replace(self, steady=self.steady + 1)


class Minimum(NamedTuple, Generic[Data]):
    """The best iterate, the radius left, the trials, and whether further steps do not help."""

    best: Iterate[Data]
    radius: Radius
    evaluations: int
    done: bool


def minimise(
    model: TrustRegionModel[Data],
    start: Iterate[Data],
    H: Array,
    radius: Radius,
    *,
    steps: int,
    penalty: float,
    least_gain: float,
) -> Minimum[Data]:
    """Minimise f(x) + ρ max(0, max c(x)) by steps in a trust region.

    Parameters
    ----------
    model, start : TrustRegionModel, Iterate
    H : array (n, n)
        The first Hessian, also after a programme without a solution.
    radius : Radius
    steps : int
        Iterations at most.
    penalty : float
        ρ.
    least_gain : float
        Of the merit, below which a step that the model predicts ends the search.

    Returns
    -------
    Minimum
        The best iterate, the radius that is left, the number of trials, and whether further steps
        do not help.

    References
    ----------
    R. Fletcher and E. Sainz de la Maza, Mathematical Programming 43 (1989) 235-256.
    """
    here, first, evaluations = start, H, 0
    for _ in range(steps):
        if radius.value < radius.least:
            return Minimum(here, radius, evaluations, True)
        step = best_step(model, here, H, radius.value, penalty)
        if step is None:  # which says nothing of an optimum
            H, radius = first, radius.times(0.3)
            continue
        if step.predicted <= least_gain or step.straight <= least_gain:
            zoomed = radius.options.zoom * step.size
            if step.straight > least_gain or step.rows.margin is not None:
                radius = radius.times(0.3)  # so curved that nothing is found as far as this
            elif model.growing and radius.least < zoomed < radius.value:
                # The programme is solved to a share of the radius, and the merit counts what it
                # leaves of a violation: next to an optimum that is more than is left to gain.
                radius = radius.times(zoomed / radius.value)
            else:
                return Minimum(here, radius, evaluations, True)
            continue
        penalty = step.penalty if model.growing else penalty
        there = model.at(here.x + step.change)
        evaluations += 1
        gained = _gain(here, there, step.penalty)
        if gained < radius.options.good * step.predicted and there is not None and model.corrected:
            change = _correct(model, here, there, step, H, radius.value)
            other = None if change is None else model.at(here.x + change)
            evaluations += change is not None
            if _gain(here, other, step.penalty) > gained:
                there, gained = other, _gain(here, other, step.penalty)
        radius = radius.after(gained, step)
        if there is not None:
            if model.has_ended(here, there):
                return Minimum(there if gained > 0.0 else here, radius, evaluations, True)
            H = model.learn(H, here, there, step, radius.value)
            here = there if gained > 0.0 else here
    return Minimum(here, radius, evaluations, False)


def _correct(
    model: TrustRegionModel[Data],
    here: Iterate[Data],
    there: Iterate[Data],
    step: Step,
    H: Array,
    radius: float,
) -> Array | None:
    """The second-order correction: the same model with the rows as they are at the trial."""
    rows = model.rows(there, radius)
    offset = rows.value - rows.slopes @ step.change
    chosen = rows_within_reach(rows.value, rows.slopes, radius)
    cost = here.gradient + (H - step.hessian) @ step.change
    found = solve_elastic(
        step.hessian, cost, rows.slopes[chosen], offset[chosen], np.ones(len(chosen)),
        *ends_of_step(model, here, radius), step.penalty, radius, unit_of_step(here, 0.0),
    )  # fmt: skip
    return None if found is None else found[0]


def _gain(here: Iterate[Data], there: Iterate[Data] | None, penalty: float) -> float:
    """Compute by how much the merit falls; -∞ where there is nothing."""
    if there is None:
        return -np.inf
    return here.value - there.value + penalty * (here.violation - there.violation)
