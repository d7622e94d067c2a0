"""The fastest cascade within its bounds: steps of linear programmes on the parameters' logarithms.

ω_b is one more variable, which the rows of the shape hold back. A step solves

    max ln ω_b - ρ σ    s.t.  c + ∇c p <= σ,  |p| <= Δ,  0 <= σ

and counts where the merit grows and every plant's loop stays stable. Fixed parameters do not move:
so a rounded one is kept while the others make up for it. Values are put on the drive's grid one
after the other, each on its better neighbour; then single steps count as long as one of them helps.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from ccd_casadi.extensions.drives.cascade_rows import CascadeRows
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import HZ


@dataclass(frozen=True)
class Candidate:
    """Values of a cascade's parameters, ω_b in rad/s, and the largest ln of a figure over its
    bound."""

    values: Array
    bandwidth: float
    excess: float


class Search(CascadeRows):
    """Climbs from stable starts on the rows of a cascade."""

    def start(self, rng: np.random.Generator) -> Array | None:
        """Values at which every loop is stable, filters next to 1; None where none was found."""
        o, unit = self.options, self.options.bandwidth * HZ
        low, high = np.log(o.frequencies)
        gains = np.array([o.gains * unit * 4.0, self.mass * unit * 6.0]) * np.exp(
            o.spread * rng.standard_normal(2)
        )
        values = [*gains, 1.0 / unit * 4.0]
        for slot in self.cascade.slots:
            f = float(np.exp(rng.uniform(low, high)))
            own = {"f_Z": f, "f_N": f * 1.02, "f": f, "D_Z": o.dampings[0], "D_N": o.dampings[1],
                   "D": o.dampings[1]}  # fmt: skip
            values += [own[name] for name in slot.settings]
        kappa = np.clip(np.log(values), self.low, self.high)
        for _ in range(o.retreats):
            if self.stable(np.exp(kappa)):
                return np.exp(kappa)
            kappa[:3] += -0.3, -0.5, 0.3
        return None

    def climb(
        self, values: Array, fixed: np.ndarray | None = None, steps: int | None = None,
        bandwidth: float | None = None,
    ) -> Candidate:  # fmt: skip
        """The best values that steps from a stable start find; `fixed` ones stay."""
        o = self.options
        kappa = np.log(values)
        first = o.bandwidth * HZ if bandwidth is None else bandwidth
        here, radius = np.append(kappa, np.log(first)), o.radius
        low, high = np.append(self.low, -np.inf), np.append(self.high, np.inf)
        free = np.ones(len(here), bool)
        if fixed is not None:
            free[:-1] = ~fixed
        low, high = np.where(free, low, here), np.where(free, high, here)
        here = np.clip(here, low, high)
        c, J = self.rows(here[:-1], here[-1])
        merit = -here[-1] + o.penalty * max(0.0, c.max())
        for _ in range(steps or o.steps):
            n = len(here)
            ends = np.maximum(-radius, low - here), np.minimum(radius, high - here)
            step = self._step(c, J, *ends)
            if step is None:
                break
            there = np.clip(here + step[:n], low, high)
            promised = merit - (-there[-1] + o.penalty * step[n])
            if promised < 1e-7:
                break
            c_new, J_new = self.rows(there[:-1], there[-1])
            gain = merit - (-there[-1] + o.penalty * max(0.0, c_new.max()))
            if gain > 0.0 and not self.stable(np.exp(there[:-1])):
                gain = -1.0
            if gain > 0.0:
                here, c, J, merit = there, c_new, J_new, merit - gain
            if gain > 0.7 * promised:
                radius = min(1.0, o.grow * radius)
            elif gain < 0.25 * promised:
                radius *= o.shrink
            if radius < o.least_radius:
                break
        return Candidate(np.exp(here[:-1]), float(np.exp(here[-1])), float(c.max()))

    def _step(self, c: Array, J: Array, low: Array, high: Array) -> Array | None:
        """p and σ of one programme, its rows added as they are violated; None where it failed."""
        o, n = self.options, len(low)
        cost, bounds = np.zeros(n + 1), [*zip(low, high, strict=True), (0.0, None)]
        cost[n - 1], cost[n] = -1.0, o.penalty
        used = np.zeros(len(c), bool)
        used[np.argsort(-c)[: o.rows]] = True
        while True:
            A = np.column_stack([J[used], -np.ones(used.sum())])
            found = linprog(cost, A_ub=A, b_ub=-c[used], bounds=bounds, method="highs")
            if found.x is None:
                return None
            over = np.where(used, -np.inf, c + J @ found.x[:n] - found.x[n])
            if over.max() < o.violated:
                return np.asarray(found.x)
            worst = np.argsort(-over)[: o.rows]
            used[worst[over[worst] > o.violated]] = True

    def fastest(self, seed: int = 0, progress: Log = silent) -> Candidate | None:
        """The best of several starts; None where no start is stable or none meets the bounds."""
        o, rng = self.options, np.random.default_rng(seed)
        starts = [values for _ in range(o.starts) if (values := self.start(rng)) is not None]
        left = [Candidate(values, o.bandwidth * HZ, 0.0) for values in starts]
        others: list[Candidate] = []
        for stage, (share, steps) in enumerate(o.stages, 1):
            climbed: list[Candidate] = []
            for number, one in enumerate(left, 1):
                climbed.append(self.climb(one.values, None, steps, one.bandwidth))
                progress(f"stage {stage} of {len(o.stages)}: climb {number} of {len(left)}")
            left = climbed
            left.sort(key=lambda one: max(one.excess, 0.0) * o.penalty - np.log(one.bandwidth))
            left, others = left[: (n := max(1, round(share * len(starts))))], left[n:]
        found = [self.settle(one) for one in left]
        for one in others:  # where none of the best meets the bounds between the grid's points
            if any(made.excess < o.met for made in found):
                break
            found.append(self.settle(one))
        good = [one for one in found if one.excess < o.met]
        return max(good, key=lambda one: one.bandwidth, default=None)

    def settle(self, candidate: Candidate, fixed: np.ndarray | None = None) -> Candidate:
        """Steps from a candidate on, with the peaks that lie between the grid's points added."""
        found = candidate
        for _ in range(self.options.refinements):
            found = self.climb(found.values, fixed, bandwidth=found.bandwidth)
            if not self.refine(found.values):
                break
        bandwidth, excess = self.judge(found.values)
        return Candidate(found.values, bandwidth, excess)


@dataclass(frozen=True)
class RoundingOptions:
    """Numbers of the rounding."""

    steps: int = 6  # of the other values, for each neighbour
    passes: int = 8  # over all values, at most
    hops: tuple[int, ...] = (-3, -1, 1, 3)  # steps at once
    fine: float = 1e-5  # of a value: a step as small is rounded without a search


def on_the_grid(
    search: Search, candidate: Candidate, options: RoundingOptions = RoundingOptions()
) -> Candidate:
    """Put every value on the drive's grid; ω_b and the excess are on the search's plants."""
    settings = search.cascade.settings
    values, band = candidate.values.copy(), candidate.bandwidth
    coarse = np.array([setting.step / (value * setting.per_si)
                       for setting, value in zip(settings, values, strict=True)])  # fmt: skip
    fixed = np.zeros(len(values), bool)
    for i in np.argsort(-coarse).tolist():
        own, fixed[i] = settings[i], True
        near = {own.round_value(values[i], by) for by in (-1, 0, 1)}
        if coarse[i] < options.fine:
            near = {own.round_value(values[i])}
        search.refine(values)
        found = []
        for value in sorted(near):
            there = values.copy()
            there[i] = value
            if search.inside(there) and search.stable(there):
                found.append(search.climb(there, fixed, options.steps, band))
        if not found:
            break
        best = min(found, key=lambda one: _merit(search, one))
        values, band = best.values.copy(), best.bandwidth
    values = np.array([own.round_value(value) for own, value in zip(settings, values, strict=True)])
    return _by_steps(search, values, options)


def _by_steps(search: Search, values: Array, options: RoundingOptions) -> Candidate:
    """Single steps of single values, each kept if it helps and keeps the loops stable."""

    def of(values: Array) -> Candidate:
        return Candidate(values, *search.judge(values))

    here = of(values)
    for _ in range(options.passes):
        moved = False
        for i, own in enumerate(search.cascade.settings):
            for by in options.hops:
                there = here.values.copy()
                there[i] = own.round_value(there[i], by)
                if search.inside(there) and there[i] != here.values[i]:
                    found = of(there)
                    if _merit(search, found) < _merit(search, here) and search.stable(there):
                        here, moved = found, True
        if not search.refine(here.values) and not moved:
            break
        here = of(here.values)
    return here


def _merit(search: Search, candidate: Candidate) -> float:
    over = max(candidate.excess, 0.0)
    return float(search.options.penalty * over - np.log(candidate.bandwidth))
