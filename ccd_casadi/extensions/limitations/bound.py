"""The largest ω_b that no multiplier forbids, and the certificate on intervals that it does."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ccd_casadi.extensions.limitations.multiplier import (
    Limits,
    MultiplierBasis,
    discs,
    greatest_multiplier,
    least_scaling,
)
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class IntervalOptions:
    """Numbers of the certificate on intervals of v."""

    split: float = 0.9  # of what is lost to the intervals' widths: by those that are halved
    most: int = 120_000  # intervals
    margin: float = 1e-6  # of ∫ m_T|h|: what rounding may not reach
    last: float = 1e13  # where the last interval ends, over the largest root of h


# An interval of v, h at its ends and its middle, ∫ σ dv from above, what of that the middle denies,
# and ∫ m_T|h| dv.
INTERVAL = [
    *((name, float) for name in ("low", "middle", "high", "upper", "loss", "size")),
    *((name, complex) for name in ("h_low", "h_middle", "h_high")),
]


def support(h: np.ndarray, m_S: Array, m_T: Array) -> Array:
    """max Re(-h T) over |T| <= m_T, |1 - T| <= m_S; -∞ where no T is in both.

    In the direction of -h the farthest point of one disc, where the other holds it, else a corner.
    """
    g, size = -h, np.abs(h)
    unit = np.conj(g) / np.where(size > 0.0, size, 1.0)
    one, two = m_T * unit, 1.0 + m_S * unit
    x = 0.5 * (1.0 + m_T**2 - m_S**2)
    y = np.sqrt(np.maximum(m_T**2 - x**2, 0.0))
    corner = g.real * x + np.abs(g.imag) * y
    found = np.where(np.abs(two) <= m_T, g.real + m_S * size, corner)
    found = np.where(np.abs(one - 1.0) <= m_S, m_T * size, found)
    return np.where(m_S + m_T < 1.0, -np.inf, found)


def support_of(h: np.ndarray, centres: np.ndarray, radii: Array, near: float = 1e-6) -> Array:
    """max Re(-h T) in all discs (k, N), or more: the least that two of them leave.

    It is exact where some T is in all: in the plane no more than two discs hold a maximum. Centres
    that are nearer than `near`, over the radii, are one.
    """
    found = (radii * np.abs(h) - (h * centres).real).min(axis=0)
    for i in range(len(radii)):
        for j in range(i):
            d = centres[j] - centres[i]
            size = np.abs(d)
            apart = size > near * (radii[i] + radii[j])
            size = np.where(apart, size, 1.0)
            both = support(h * d, radii[j] / size, radii[i] / size) - (h * centres[i]).real
            found = np.where(apart, np.minimum(found, both), found)
    return found


@dataclass(frozen=True)
class _Multiplier:
    limits: Limits
    basis: MultiplierBasis
    weight: Array
    omega_b: float

    def at(self, v: Array) -> np.ndarray:
        return np.asarray(self.basis.values(v) @ self.weight)

    def _discs(self, low: Array, high: Array) -> tuple[np.ndarray, Array]:
        centres, radii = discs(self.limits, low, high, self.omega_b)
        radii[0] = np.minimum(radii[0], 1.0 + radii[1])  # |T| <= 1 + |S|
        return centres, radii

    def intervals(
        self, low: Array, high: Array, h_low: np.ndarray, h_high: np.ndarray
    ) -> np.ndarray:
        """A row of `INTERVAL` for each."""
        w, middle = high - low, 0.5 * (low + high)
        h = self.at(middle)
        where = self._discs(low, high)
        m_T = where[1][0]
        line = 0.5 * (support_of(h_low, *where) + support_of(h_high, *where))
        curved = self.basis.most_curved(low, high, self.weight) * w**2 / 8.0
        found = np.empty(len(low), INTERVAL)
        found["low"], found["high"], found["middle"] = low, high, middle
        found["h_low"], found["h_high"], found["h_middle"] = h_low, h_high, h
        found["upper"], found["size"] = w * (line + m_T * curved), w * m_T * np.abs(h)
        value = w * support_of(h, *self._discs(middle, middle))
        found["loss"] = found["upper"] - np.maximum(value, -found["size"])
        return found


def rules_out(
    limits: Limits,
    basis: MultiplierBasis,
    weight: Array,
    omega_b: float,
    start: Array,
    options: IntervalOptions = IntervalOptions(),
) -> bool:
    """Whether h = Σ weight_k h_k shows that no controller reaches ω_b (rad/s).

    `start`: frequencies v that the first intervals end at.
    """
    multiplier = _Multiplier(limits, basis, weight, omega_b)
    top = options.last * max(basis.corner, *basis.reals, *map(abs, basis.pairs))
    steps = [omega_b, limits.ratio * omega_b, limits.bounds.omega_low]
    parts = [start, [limits.variable(omega) for omega in steps], [0.0]]
    ends = np.concatenate([*parts, np.geomspace(start.max(), top, 400)])
    ends = np.unique(ends[ends <= top])
    h = multiplier.at(ends)
    beyond = (1.0 + limits.bounds.S_max) * basis.tail(top, weight)
    found = multiplier.intervals(ends[:-1], ends[1:], h[:-1], h[1:])
    while True:
        total, excess = float(found["upper"].sum()) + beyond, float(found["loss"].sum())
        if total < -options.margin * float(found["size"].sum()):
            return True
        if not np.isfinite(total) or total - excess > 0.0:
            return False
        found = found[np.argsort(-found["loss"])]
        count = int(np.searchsorted(np.cumsum(found["loss"]), options.split * excess)) + 1
        if len(found) + count > options.most:
            return False
        split, rest = found[:count], found[count:]
        halves = (
            multiplier.intervals(*(split[name] for name in names))
            for names in (("low", "middle", "h_low", "h_middle"),
                          ("middle", "high", "h_middle", "h_high"))
        )  # fmt: skip
        found = np.concatenate([rest, *halves])


@dataclass(frozen=True)
class BoundOptions:
    """Numbers of the search for the bound on every controller.

    A size of a programme is how many times the repeated pole is in the basis, and how many
    frequencies the grid has in a decade.
    """

    repeated_pole: float = 2.0  # of the basis, over ω_b
    single_poles: tuple[float, ...] = (10.0, 30.0, 100.0)  # likewise
    fine: tuple[int, int] = (60, 120)  # sizes
    coarse: tuple[int, int] = (60, 80)
    small: tuple[int, int] = (16, 40)
    multiplier_corner: float = 100.0  # of the roll-off of h, over ω_b
    controller_corner: float = 5.0  # of that of T
    controller_grid: int = 1500  # frequencies in a decade, at which T is checked
    excess: float = 0.002  # by how much the scaling is above one where the certificate is tried
    tries: int = 5  # of it, each at a larger excess
    # of ω_b: where roots of the plant have their own functions and grid
    band: tuple[float, float] = (0.2, 40.0)
    most_pairs: int = 16  # of these roots
    same: float = 1e-3  # relative distance of two roots that count as one
    first: float = 0.65  # of what one frequency alone forbids: where the search begins
    secants: int = 10  # programmes at most
    largest_step: float = 1.0  # in ln ω_b
    accuracy: float = 1e-3  # of the scaling: to what aims are met, and T may exceed a bound


def upper_bound(
    limits: Limits, known: float = np.inf, options: BoundOptions = BoundOptions()
) -> float:
    """An ω_b (rad/s) that no controller reaches, near the least; `known` where that is less.

    Infinite where nothing forbids any bandwidth.
    """
    aim = 1.0 + options.excess
    if known < np.inf and _Search(limits, known, -1, options).multiplier(known)[0] <= aim:
        return known
    most = pointwise(limits, options)
    begin = min(_first(limits, most, options), known)
    if not np.isfinite(begin):
        return np.inf
    search = _Search(limits, begin, -1, options, options.small)  # where to make the basis
    omega_b, _, met = _where(search.multiplier, begin, most, aim, options, solved=True)
    if not met:
        search = _Search(limits, begin, -1, options)
        omega_b = _where(search.multiplier, begin, most, aim, options)[0]
    found = _certify(limits, omega_b, most, options.coarse, options) if met else 0.0
    found = found or _certify(limits, omega_b, most, options.fine, options)
    return min(found or most, known)


def forbids(
    limits: Limits,
    omega_b: float,
    near: float | None = None,
    options: BoundOptions = BoundOptions(),
) -> bool:
    """Whether one coarse programme and its certificate show that no controller has ω_b (rad/s).

    `near`: where the bounds are tight, by default at ω_b; that none at all is possible is shown
    there with an ω_b far below.
    """
    search = _Search(limits, near or omega_b, -1, options, options.coarse)
    g, weight = search.multiplier(omega_b, near)
    grid = _grid(limits, omega_b, options.fine[1], options, near)
    return bool(1.0 < g < np.inf) and rules_out(limits, search.basis, weight, omega_b, grid)


def _certify(
    limits: Limits, omega_b: float, most: float, size: tuple[int, int], options: BoundOptions
) -> float:
    """The least ω_b that a certificate was found for, next to `omega_b`; 0: none below `most`.

    Coarse programmes are not always solved, or certified.
    """
    search, coarse = _Search(limits, omega_b, -1, options, size), size != options.fine
    aim = 1.0 + options.excess
    omega_b, weight, met = _where(search.multiplier, omega_b, most, aim, options, solved=coarse)
    for number in range(options.tries if met or not coarse else 0):
        if omega_b >= most:
            break
        grid = _grid(limits, omega_b, options.fine[1], options)
        if rules_out(limits, search.basis, weight, omega_b, grid):
            return omega_b
        omega_b = min(omega_b * (1.0 + options.excess * 2.0 ** (number + 1)), most)
        weight = search.multiplier(omega_b)[1]
    return 0.0


def forbids_most(candidates: Sequence[Limits], options: BoundOptions = BoundOptions()) -> Limits:
    """The one whose discs need the largest scaling at one ω_b, by small programmes."""
    omega_b = _first(candidates[0], pointwise(candidates[0], options), options)

    def scaling(limits: Limits) -> float:
        found = _Search(limits, omega_b, -1, options, options.small).multiplier(omega_b)[0]
        return found if np.isfinite(found) else 0.0  # ∞: a programme not solved

    return max(candidates, key=scaling) if np.isfinite(omega_b) else candidates[0]


def _first(limits: Limits, most: float, options: BoundOptions) -> float:
    """Return where a search begins, rad/s; infinite where nothing is known."""
    zeros = [float(limits.omega(np.array(abs(z)))) for z in limits.beyond]
    return min([options.first * most, *zeros])


def lower_bound(limits: Limits, most: float, options: BoundOptions = BoundOptions()) -> float:
    """The ω_b (rad/s) of a T that keeps every bound on a fine grid, near `most`; 0: none found.

    Of one plant without others: the discs leave out what others forbid besides.
    """
    if not most < np.inf:
        return 0.0
    search, off = _Search(limits, most, 1, options), options.accuracy
    found = _where(search.controller, 0.98 * most, most, 1.0 - off, options)[0]
    return found if search.controller(found)[0] <= 1.0 + off else 0.0


def pointwise(limits: Limits, options: BoundOptions = BoundOptions()) -> float:
    """The least ω_b at which some frequency alone forbids it: m_S + m_T < 1."""

    def slack(log_omega: float) -> float:
        v = _grid(limits, float(np.exp(log_omega)), 400, options)
        m_S, m_T = limits.radii(v, v, float(np.exp(log_omega)))
        return float((m_S + m_T).min()) - 1.0

    low = np.log(limits.bounds.omega_low)
    high = low + np.log(1e6) if not limits.period else np.log(np.pi / limits.period) - 1e-3
    if slack(high) >= 0.0:
        return np.inf if not limits.period else float(np.exp(high))
    if slack(low) < 0.0:
        return float(np.exp(low))
    found = scipy.optimize.brentq(slack, low, high, xtol=1e-4)
    while slack(found) >= 0.0:
        found += 1e-3
    return float(np.exp(found))


def _roots(limits: Limits, omega_b: float, options: BoundOptions) -> list[complex]:
    """-p̄ of the oscillating poles and zeros p next to ω_b, each once."""
    v = limits.variable(omega_b)
    found: list[complex] = []
    low, high = (share * v for share in options.band)
    for r in sorted(filter(None, limits.roots.tolist()), key=lambda r: abs(np.log(abs(r) / v))):
        p = complex(abs(r.real), r.imag)
        known = any(abs(p - other) < options.same * abs(p) for other in found)
        if r.imag > 0.0 and low < abs(r) < high and not known:
            found.append(p)
    return found[: options.most_pairs]


def _grid(
    limits: Limits,
    omega_b: float,
    per_decade: int,
    options: BoundOptions,
    near: float | None = None,
) -> Array:
    """Frequencies v: fine around ω_b, or `near`, and at every lightly damped root, both sides of a
    step."""
    v = limits.variable(near or omega_b)
    parts = [
        np.geomspace(0.02 * v, 40.0 * v, int(3.3 * per_decade)),
        np.geomspace(1e-4 * v, 0.02 * v, per_decade),
        np.geomspace(40.0 * v, 1e4 * v, per_decade),
    ]
    for r in _roots(limits, near or omega_b, options):
        spread = np.sinh(np.linspace(-5.0, 5.0, max(per_decade // 3, 21)))
        parts.append(r.imag + max(r.real, 1e-4 * abs(r)) * spread)
    for step in (omega_b, limits.ratio * omega_b):
        parts.append(limits.variable(step) * np.array([1.0 - 1e-9, 1.0 + 1e-9]))
    grid = np.unique(np.concatenate(parts))
    return grid[(grid > 0.0) & np.isfinite(grid)]


class _Search:
    """ω_b with a basis that stays; `turned` -1: of multipliers h, 1: of T."""

    def __init__(
        self,
        limits: Limits,
        omega_b: float,
        turned: int,
        options: BoundOptions,
        size: tuple[int, int] | None = None,
    ) -> None:
        self.options = options
        count, self.grid = size or options.fine
        self.limits, self.unit = limits, limits.variable(omega_b)
        excess = len(limits.row[0].poles) - len(limits.row[0].zeros)
        poles = (*[options.repeated_pole] * count, *options.single_poles)
        corner = options.multiplier_corner if turned < 0 else options.controller_corner
        self.basis = MultiplierBasis(
            reals=tuple(self.unit * a for a in poles),
            pairs=tuple(_roots(limits, omega_b, options)),
            corner=corner * self.unit,
            order=1 if turned < 0 else max(excess - 1, 0),
            zeros=limits.beyond,
            turned=turned,
            constant=turned > 0 and excess == 0,
        )

    def multiplier(self, omega_b: float, near: float | None = None) -> tuple[float, Array]:
        """The scaling that some h shows, on a grid, and the coefficients of h."""
        v = _grid(self.limits, omega_b, self.grid, self.options, near)
        width = np.gradient(v)
        width[0] += v[0]
        values = self.basis.values(v) * np.sqrt(self.unit)
        return greatest_multiplier(values, width / self.unit, *discs(self.limits, v, v, omega_b))

    def controller(self, omega_b: float) -> tuple[float, Array]:
        """The scaling that some T needs, on a finer grid, and its coefficients."""
        v = _grid(self.limits, omega_b, self.grid, self.options)
        g, weight = least_scaling(self.basis.values(v), *discs(self.limits, v, v, omega_b))
        v = _grid(self.limits, omega_b, self.options.controller_grid, self.options)
        centres, radii = discs(self.limits, v, v, omega_b)
        shares = np.abs(self.basis.values(v) @ weight - centres) / radii
        return max(g, float(shares.max())), weight


def _where(
    scaling: Callable[[float], tuple[float, Array]],
    begin: float,
    most: float,
    aim: float,
    options: BoundOptions,
    solved: bool = False,
) -> tuple[float, Array, bool]:
    """The ω_b at which the scaling is as aimed at, and whether it is; secants in ln, bracketed.

    `solved`: give up at a programme that is not solved, which is infinite.
    """
    x, low, high, slope = float(np.log(begin)), -np.inf, float(np.log(most)), 0.8
    before: tuple[float, float] | None = None
    tried: list[float] = []
    for _ in range(options.secants):
        g, weight = scaling(float(np.exp(x)))
        if solved and not np.isfinite(g):
            break
        error = float(np.log(np.clip(g / aim, 0.1, 10.0)))
        if abs(error) < options.accuracy:
            return float(np.exp(x)), weight, True
        low, high = (max(low, x), high) if error < 0.0 else (low, min(high, x))
        if before is not None and x != before[0]:
            slope = float(np.clip((error - before[1]) / (x - before[0]), 0.3, 5.0))
        before = x, error
        tried.append(x)
        if low >= high:  # below the aim at `most`
            break
        x += float(np.clip(-error / slope, -options.largest_step, options.largest_step))
        if not low < x < high:
            x = high if high not in tried else 0.5 * (low + high)
    return float(np.exp(x)), weight, False
