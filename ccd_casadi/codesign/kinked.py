"""The true problem by sequential quadratic programming, every local peak of S a constraint.

    min ∇Jᵀd + ½ dᵀH d   s.t.  g + ∇g d <= 0 (elastic),  |d| <= Δ,  0 <= z + d <= 1

in unit-box variables z. An optimum is often where two peaks of S are equal, or where a peak below
ω_b just stays under -3 dB: ‖S‖∞ has a kink and ω_b a jump there, on which a method that knows
one gradient alone stalls. A step is taken where the merit J + ρ max(0, g) falls, and where the
design is certified; H is the damped BFGS matrix of the Lagrangian (Nocedal and Wright, 18.3).
Nothing is approximated: each step is a certified synthesis with its total derivatives. Every solve
ends with a `polish` of this kind.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from ccd_casadi.codesign.optimality import (
    LiftedKktOptions,
    TrueDesign,
    active_at,
    first_order,
    lagrangian_hessian,
    other_peaks,
)
from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.inner_problem.objective import TrueQuantities
from ccd_casadi.optim.quadratic_programmes import damped_bfgs
from ccd_casadi.optim.step import Iterate, Rows, Step, TrustRegionModel
from ccd_casadi.optim.trust_region import Radius, minimise
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.time_budget import not_searched, time_is_up


def newton_step(here: TrueDesign) -> Array | None:
    """Return the end of a Newton step; None without a positive reduced Hessian, or where the step
    is too long.

    From a design whose certificate is of the plain conditions. The Hessian takes two true designs
    per free direction. Nocedal and Wright, Numerical Optimization, 18.1.
    """
    problem, mu, at = here.problem, here.kkt.multipliers, active_at(here)
    held = np.array([mu[name] > 0.0 for name in at.labels], bool)
    A = at.rows[held]
    inside = np.array([here.options.inside * (name in problem.inner.bounds) for name in at.labels])
    aim = np.where(np.arange(held.size) < at.constraints, -(at.values + inside), 0.0)[held]
    Z = null_space(A)
    if Z.shape[1] == 0:  # a vertex
        return None
    columns = lagrangian_hessian(here, Z, mu)
    if columns is None:
        return None
    H = Z.T @ columns
    H = 0.5 * (H + H.T)
    if np.linalg.eigvalsh(H).min() <= 0.0:
        return None
    d = -Z @ np.linalg.solve(H, Z.T @ at.gradient)
    if A.size:
        d = d + np.linalg.lstsq(A, aim, rcond=None)[0]
    if np.abs(d).max() > here.options.longest_newton_step:
        return None
    bounds = lifted_bounds(problem)
    return np.clip(here.x + bounds.width * d, *bounds)


@dataclass(frozen=True)
class PeakDescentOptions:
    """Numbers of the descent on the true problem and of the polish after it."""

    band: float = 0.25  # ln: peaks this close to their bound are constraints of a step
    first_radius: float = 0.1  # of the box
    largest_radius: float = 0.4
    least_radius: float = 1e-9
    steps: int = 30
    settled: float = 1e-9  # of J: a model that promises less ends the descent
    polish_steps: int = 80
    polish_settled: float = 1e-13  # of J
    # ln per (share of the box)²: how far a peak below -3 dB may depart from its slope
    first_curvature: float = 10.0
    least_curvature: float = 1e-3
    basin: float = 1e-2  # of the box: this close to an end that is known, and no lower, is one
    at_kink: float = 1e-4  # ln: so close to a kink or a jump the Hessian is not that beside it
    stationary: float = 1e-7  # scaled KKT residual below which a descent has nothing to do
    newton_from: float = 1e-4  # stationarity from which Newton's steps start
    newton_to: float = 1e-9  # and where they end
    newton_steps: int = 3


@dataclass(frozen=True)
class _Design:
    """A design with its rows g (m,), their slopes (m, n) per share of the box, and whose they are:
    a name, or "peak" and "shelf" with ln of a frequency and a plant of the set."""

    g: Array
    jacobian: Array
    tags: tuple[tuple[str, float, int], ...]

    def same(self, tag: tuple[str, float, int]) -> int | None:
        """The row of the same constraint; of a peak, the nearest of its plant in frequency."""
        kind, place, member = tag
        rows = [i for i, (name, _, of) in enumerate(self.tags) if (name, of) == (kind, member)]
        if not rows:
            return None
        nearest = min(rows, key=lambda i: abs(self.tags[i][1] - place))
        return (
            nearest if abs(self.tags[nearest][1] - place) <= LiftedKktOptions().same_peak else None
        )


def descend(
    truth: TrueQuantities,
    x: Array,
    *,
    steps: int | None = None,
    settled: float | None = None,
    ended: Sequence[tuple[Array, float]] = (),
    options: PeakDescentOptions = PeakDescentOptions(),
) -> Array:
    """Descend from a certified design to the nearest optimum of the true problem; return the best x
    found.

    At most `steps` designs are evaluated, and none more once it is in the basin of an optimum
    (x, J) where others `ended`. Returns the start where it is not certified.
    """
    steps = options.steps if steps is None else steps
    settled = options.settled if settled is None else settled
    model = _Peaks(truth, ended, options)
    here = model.at(model.box.shares(x))
    if here is None or model.has_ended(here, here):
        return x
    scale = max(float(np.abs(here.gradient).max()), 1e-300)
    radius = Radius(options.first_radius, options.least_radius, options.largest_radius)
    end = minimise(
        model, here, scale * np.eye(x.size), radius, steps=steps, penalty=scale,
        least_gain=settled * abs(here.value),
    )  # fmt: skip
    not_searched("local solve")
    return model.box.lower + model.box.width * end.best.x


class _Peaks(TrustRegionModel[_Design]):
    """The true problem in unit-box variables."""

    growing = True

    def __init__(
        self,
        truth: TrueQuantities,
        known: Sequence[tuple[Array, float]],
        options: PeakDescentOptions,
    ) -> None:
        self.truth, self.options = truth, options
        self.box = lifted_bounds(truth.problem)
        self.low, self.high = np.zeros_like(self.box.lower), np.ones_like(self.box.lower)
        self.known = [(self.box.shares(at), J) for at, J in known]
        self.curvature = options.first_curvature  # of a peak below -3 dB, as learnt so far

    def at(self, x: Array) -> Iterate[_Design] | None:
        """A certified design with ∇J, its constraints and its peaks."""
        if time_is_up():
            return None
        z = np.clip(x, 0.0, 1.0)
        there = TrueDesign(self.truth, self.box.lower + self.box.width * z)
        made = there.design
        if not made.figures.certified or made.made is None:
            return None
        peaks = other_peaks(there.problem, there.x, made, self.options.band)
        rows = first_order(there, peaks, there.options.inside)
        place = float(np.log(made.figures.sensitivity_peak_frequency))
        others = [(name, 0.0, 0) for name in rows.names[1 : len(rows.names) - len(peaks)]]
        tags = (("peak", place, made.made.worst), *others, *(peak.tag for peak in peaks))
        data, violation = _Design(rows.g, rows.jacobian, tags), max(0.0, float(rows.g.max()))
        return Iterate(z, there.objective, rows.gradient, violation, data)

    def rows(self, here: Iterate[_Design], radius: float) -> Rows:
        """Past -3 dB ω_b jumps and the merit with it: keep off by more than the slope is wrong."""
        found = here.data
        shelf = np.array([kind == "shelf" for kind, _, _ in found.tags])
        margin = self.curvature * radius**2 * shelf if shelf.any() else None
        return Rows(found.g, found.jacobian, margin=margin)

    def learn(
        self, H: Array, here: Iterate[_Design], there: Iterate[_Design], step: Step, radius: float
    ) -> Array:
        """Update the Hessian by the change of the Lagrangian's gradient."""
        self.curvature = _curvature(here, there, self.curvature, self.options)
        after = there.gradient.copy()
        for value, tag in zip(step.multipliers, here.data.tags, strict=True):
            row = there.data.same(tag)
            if value > 0.0 and row is None:
                return H  # the peak is gone: there is no difference to learn from
            if value > 0.0:
                after += value * there.data.jacobian[row]
        before = here.gradient + here.data.jacobian.T @ step.multipliers
        return damped_bfgs(H, there.x - here.x, after - before)

    def has_ended(self, here: Iterate[_Design], there: Iterate[_Design]) -> bool:
        """Decide whether the step is in the basin of an end that is known, and no lower."""
        return any(
            there.value >= J and np.abs(there.x - z).max() <= self.options.basin
            for z, J in self.known
        )


def _curvature(
    here: Iterate[_Design], there: Iterate[_Design], before: float, options: PeakDescentOptions
) -> float:
    """Estimate how far a peak below -3 dB may depart from its slope, ln per (share of the box)².

    After a step twice what it showed, but at least a quarter of what was assumed `before`; four
    times that where such a peak was lost.
    """
    d = there.x - here.x
    size = float(np.abs(d).max())
    seen = []
    for value, row, tag in zip(here.data.g, here.data.jacobian, here.data.tags, strict=True):
        if tag[0] == "shelf" and size > 1e-6:
            same = there.data.same(tag)
            if same is None and value + row @ d > -options.band:
                return 4.0 * before
            if same is not None:
                seen.append(abs(there.data.g[same] - value - float(row @ d)) / size**2)
    return max(0.25 * before, 2.0 * max(seen), options.least_curvature) if seen else before


def polish(
    truth: TrueQuantities, x: Array, options: PeakDescentOptions = PeakDescentOptions()
) -> TrueDesign:
    """Polish a nearly optimal design to the nearest stationary point of the true problem.

    A descent past kinks, every peak of S a constraint (some ten designs where IPOPT
    takes a hundred), then Newton's steps as long as the residual falls, where no other peak is
    near. Returns the start itself where neither finds better that is certified and feasible.
    """
    here = TrueDesign(truth, x)
    if not (here.acceptable and here.residual <= options.stationary):
        steps, settled = options.polish_steps, options.polish_settled
        end = TrueDesign(truth, descend(truth, x, steps=steps, settled=settled, options=options))
        if end.acceptable and (not here.acceptable or _improves(here, end)):
            here = end
    for _ in range(options.newton_steps if here.acceptable else 0):
        near = options.newton_to < here.kkt.stationarity <= options.newton_from
        if not near or other_peaks(here.problem, here.x, here.design, options.at_kink):
            break
        step = newton_step(here)
        end = here if step is None else TrueDesign(truth, step)
        falls = end.acceptable and end.kkt.stationarity < here.kkt.stationarity
        if not falls or here.rise(end) > 1.0:
            break
        here = end
    return here


def _improves(here: TrueDesign, end: TrueDesign) -> bool:
    """Whether J falls, or stays and the residual falls."""
    rise = here.rise(end)
    return rise < -1.0 or (rise <= 1.0 and end.residual < here.residual)
