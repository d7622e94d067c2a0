"""The true problem by sequential quadratic programming, every local peak of S a constraint.

    min ∇Jᵀd + ½ dᵀH d   s.t.  g + ∇g d <= 0 (elastic),  |d| <= Δ,  0 <= z + d <= 1

in unit-box variables z. An optimum is often where two peaks of S are equal, or where a peak below
ω_b just stays under -3 dB: ‖S‖∞ has a kink and ω_b a jump there, on which a method that knows
one gradient alone stalls. A step is taken where the merit J + ρ Σ max(0, g) falls, and where the
design is certified; H is the damped BFGS matrix of the Lagrangian (Nocedal and Wright, 18.3).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.codesign.kkt import lagrangian_parts
from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.codesign.peak_constraints import OTHER_PEAK, SAME_PEAK, other_peaks
from ccd_casadi.inner_problem.constraints import constraint_sizes
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.true_function import TrueQuantities
from ccd_casadi.optim.quadratic import solve_quadratic
from ccd_casadi.optim.quasi_newton import damped_bfgs
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.derivatives import Sensitivities

BAND = 0.25  # ln: peaks this close to their bound are constraints of a step
INSIDE = 2e-9  # ln: what a step aims inside S_max and S_low, so that its end is feasible as given
FIRST, LARGEST, LEAST = 0.1, 0.4, 1e-9  # of the box: radii of the trust region
SETTLED = 1e-9  # of J: a model that promises less has nothing left to give
SHELF = 10.0  # ln per (share of the box)²: how far a first step stays from where ω_b jumps
FLATTEST = 1e-3  # the least it comes down to, where a shelf turns out to be straight
ZOOM = 4.0  # steps of the radius to which it comes down where they are too small for it
BASIN = 1e-2  # of the box: this close to an end that is known, and no lower, is its basin


@dataclass(frozen=True)
class _Point:
    z: Array
    design: Sensitivities
    J: float
    gradient: Array
    g: Array
    jacobian: Array
    tags: tuple[tuple[str, float, int], ...]

    @property
    def by_shelf(self) -> bool:
        """Whether ω_b may jump near by."""
        return any(kind == "shelf" for kind, _, _ in self.tags)


@dataclass(frozen=True)
class _Step:
    """d, the multipliers of g, and by how much the model of the merit falls."""

    change: Array
    multipliers: Array
    model: float

    @property
    def size(self) -> float:
        """The largest share of the box."""
        return float(np.abs(self.change).max())


def descend(
    problem: CoDesignProblem,
    quantities: TrueQuantities,
    x: Array,
    *,
    steps: int = 30,
    radius: float = FIRST,
    settled: float = SETTLED,
    ended: Sequence[tuple[Array, float]] = (),
) -> Array:
    """From a certified design to the nearest optimum of the true problem; the best x found.

    At most `steps` designs are asked for; none more once it is in the basin of an optimum (x, J)
    where others `ended`. Returns the start where it is not certified.
    """
    lower, upper = lifted_bounds(problem)
    width = upper - lower
    size = x.size

    def at(z: Array) -> _Point | None:
        where = lower + width * np.clip(z, 0.0, 1.0)
        design = quantities.at(where)
        return _point(problem, where, np.clip(z, 0.0, 1.0), design)

    here = at((x - lower) / width)
    if here is None:
        return x
    scale = max(float(np.abs(here.gradient).max()), 1e-300)
    H = scale * np.eye(size)
    rho = scale
    bend = SHELF
    for _ in range(steps):
        if any(_in_basin(here, (known - lower) / width, J) for known, J in ended):
            break
        least = settled * abs(here.J)
        step = _step(here, H, radius, rho, bend)
        while step is not None and step.model <= least and here.by_shelf and radius > LEAST:
            radius *= 0.35  # a smaller step may go nearer to where ω_b jumps
            step = _step(here, H, radius, rho, bend)
        if step is not None and step.model <= least and LEAST < ZOOM * step.size < radius:
            # The quadratic program is solved to a share of the radius, and the merit counts what
            # it leaves of a violation: next to an optimum that is more than is left to gain.
            radius = ZOOM * step.size
            step = _step(here, H, radius, rho, bend)
        if radius < LEAST:
            break
        if step is None:  # that tells nothing of an optimum: a programme of its own, nearer by
            H, radius = scale * np.eye(size), 0.35 * radius
            continue
        d, mu, model = step.change, step.multipliers, step.model
        rho = max(rho, 2.0 * float(mu.max(initial=0.0)))
        if model <= least:
            break
        there = at(here.z + d)
        gained = -np.inf if there is None else _merit(here, rho) - _merit(there, rho)
        if there is not None:
            H = _updated(H, here, there, mu)
            bend = _bend(here, there, bend)
        if there is None or gained < 0.1 * model:
            radius = min(radius, step.size) * 0.35
        elif gained > 0.7 * model and step.size > 0.9 * radius:
            radius = min(2.0 * radius, LARGEST)
        if there is not None and gained > 1e-4 * model:
            here = there
    return lower + width * here.z


def _in_basin(here: _Point, z: Array, J: float) -> bool:
    return bool(here.J >= J and np.abs(here.z - z).max() <= BASIN)


def _point(problem: CoDesignProblem, x: Array, z: Array, design: Sensitivities) -> _Point | None:
    if not design.figures.certified or design.made is None:
        return None
    gradient, g, jacobian, names = lagrangian_parts(problem, x, design)
    first, sizes = len(problem.inner.bounds), constraint_sizes(problem)
    g = np.append(g[:first] + INSIDE, g[first:] / sizes)
    jacobian = np.vstack([jacobian[:first], jacobian[first:] / sizes[:, None]])
    peaks = other_peaks(problem, x, design, BAND)
    tags = [(name, 0.0, 0) for name in names]
    place = float(np.log(design.figures.sensitivity_peak_frequency))
    tags[0] = ("peak", place, design.made.worst)
    if peaks:
        g = np.append(g, [peak.value + INSIDE for peak in peaks])
        jacobian = np.vstack([jacobian, *(peak.row for peak in peaks)])
        tags += [
            (
                "peak" if peak.name.startswith(OTHER_PEAK) else "shelf",
                np.log(peak.omega),
                peak.member,
            )
            for peak in peaks
        ]
    cost = hardware_cost(plant_of(problem), x[: len(problem.names)])
    J = problem.w1 * cost + problem.w2 * design.figures.bandwidth
    return _Point(z, design, J, gradient, g, jacobian, tuple(tags))


def _merit(point: _Point, rho: float) -> float:
    """J + ρ Σ max(0, g); a -3 dB shelf that is passed shows in J itself, as a jump."""
    return point.J + rho * float(np.maximum(point.g, 0.0).sum())


def _bend(here: _Point, there: _Point, bend: float) -> float:
    """How far a shelf may depart from its slope, ln per (share of the box)², after a step.

    Twice what was seen, but at least a quarter of what was feared before; four times what was
    feared where a shelf was passed.
    """
    d = there.z - here.z
    size = float(np.abs(d).max())
    seen = []
    for value, row, tag in zip(here.g, here.jacobian, here.tags, strict=True):
        if tag[0] == "shelf" and size > 1e-6:
            same = _same(tag, there)
            if same is None and value + row @ d > -BAND:
                return min(4.0 * bend, SHELF)
            if same is not None:
                seen.append(abs(there.g[same] - value - float(row @ d)) / size**2)
    return max(0.25 * bend, 2.0 * max(seen), FLATTEST) if seen else bend


def _step(here: _Point, H: Array, radius: float, rho: float, bend: float) -> _Step | None:
    """None where the programme is not solved."""
    n, m = here.z.size, here.g.size
    unit = max(float(np.abs(here.gradient).max()), 1e-300)
    # Past -3 dB ω_b jumps and the merit with it: keep off by more than the slope is wrong.
    shelf = np.array([kind == "shelf" for kind, _, _ in here.tags])
    g = here.g + np.where(shelf, bend * radius**2, 0.0)
    # In steps of one radius, so that the solver's tolerances mean the same at every radius.
    hessian = np.zeros((n + m, n + m))
    hessian[:n, :n] = radius * (H / unit + 1e-9 * np.trace(H) / (n * unit) * np.eye(n))
    hessian[n:, n:] = 1e-6 * np.eye(m)
    linear = np.append(here.gradient / unit, np.full(m, 10.0 * (1.0 + rho / unit)))
    A = np.hstack([here.jacobian, -np.eye(m)])
    low = np.append(np.maximum(-1.0, -here.z / radius), np.zeros(m))
    high = np.append(np.minimum(1.0, (1.0 - here.z) / radius), np.full(m, np.inf))
    found = solve_quadratic(hessian, linear, A, -g / radius, low, high, singular=True)
    if found is None:
        return None
    d = radius * np.clip(found.x[:n], low[:n], high[:n])
    mu = unit * found.multipliers
    weight = max(rho, 2.0 * float(mu.max(initial=0.0)))
    before = weight * float(np.maximum(here.g, 0.0).sum())
    after = weight * float(np.maximum(here.g + here.jacobian @ d, 0.0).sum())
    model = before - after - float(here.gradient @ d + 0.5 * d @ H @ d)
    return _Step(d, mu, model)


def _updated(H: Array, here: _Point, there: _Point, mu: Array) -> Array:
    """H with the change of the Lagrangian's gradient."""
    s = there.z - here.z
    after = there.gradient.copy()
    for value, tag in zip(mu, here.tags, strict=True):
        row = _same(tag, there)
        if value > 0.0 and row is None:
            return H  # the peak is gone: there is no difference to learn from
        if value > 0.0:
            after += value * there.jacobian[row]
    return damped_bfgs(H, s, after - here.gradient - here.jacobian.T @ mu)


def _same(tag: tuple[str, float, int], there: _Point) -> int | None:
    """The row of the same constraint there; of a peak, the nearest of its plant in frequency."""
    kind, place, member = tag
    rows = [i for i, (name, _, of) in enumerate(there.tags) if (name, of) == (kind, member)]
    if not rows:
        return None
    nearest = min(rows, key=lambda i: abs(there.tags[i][1] - place))
    return nearest if abs(there.tags[nearest][1] - place) <= SAME_PEAK else None
