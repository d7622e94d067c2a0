"""Whether a multiplier h forbids every controller: ∫ σ(v) dv < 0, evaluated as an upper bound.

Where h T is analytic in the right half plane and falls as 1/v², Re ∫ h T dv = 0 for the T of every
stabilising controller. T lies in both discs, |T| <= m_T and |1 - T| <= m_S, so that

    0 = -Re ∫ h T dv <= ∫ σ dv,   σ = max Re(-h T) over T in both discs.

If the right side is negative, there is no such T. On an interval of width w both discs are as large
as they are anywhere on it; h is the line between its ends but for e = w²/8 max|h''|; and σ is
convex in h, so that on that line it is at most the line between its own ends:

    ∫ σ dv <= w (σ(h_low) + σ(h_high))/2 + w e m_T.

Intervals are halved where that is most above the integrand. Rounding, of 1e-12 or so of the
integrals, is covered by a margin of 1e-6 of them.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.limitations.basis import Basis
from ccd_casadi.limitations.discs import discs
from ccd_casadi.limitations.limits import Limits
from ccd_casadi.support.arrays import Array

SPLIT = 0.9  # of what is lost to the intervals' widths: by the intervals that are halved
MOST = 120_000  # intervals
MARGIN = 1e-6  # of ∫ m_T|h|: what rounding may not reach
# An interval of v, h at its ends and its middle, ∫ σ dv from above, what of that the middle denies,
# and ∫ m_T|h| dv.
INTERVAL = [
    *((name, float) for name in ("low", "middle", "high", "upper", "loss", "size")),
    *((name, complex) for name in ("h_low", "h_middle", "h_high")),
]
NEAR = 1e-6  # centres nearer than that, over the radii, are one
TAIL = 1e13  # where the last interval ends, over the largest root of h


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


def support_of(h: np.ndarray, centres: np.ndarray, radii: Array) -> Array:
    """max Re(-h T) in all discs (k, N), or more: the least that two of them leave.

    It is exact where some T is in all: in the plane no more than two discs hold a maximum.
    """
    found = (radii * np.abs(h) - (h * centres).real).min(axis=0)
    for i in range(len(radii)):
        for j in range(i):
            d = centres[j] - centres[i]
            size = np.abs(d)
            apart = size > NEAR * (radii[i] + radii[j])
            size = np.where(apart, size, 1.0)
            both = support(h * d, radii[j] / size, radii[i] / size) - (h * centres[i]).real
            found = np.where(apart, np.minimum(found, both), found)
    return found


@dataclass(frozen=True)
class _Multiplier:
    limits: Limits
    basis: Basis
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


def rules_out(limits: Limits, basis: Basis, weight: Array, omega_b: float, start: Array) -> bool:
    """Whether h = Σ weight_k h_k shows that no controller reaches ω_b (rad/s).

    `start`: frequencies v that the first intervals end at.
    """
    multiplier = _Multiplier(limits, basis, weight, omega_b)
    top = TAIL * max(basis.corner, *basis.reals, *map(abs, basis.pairs))
    steps = [omega_b, limits.ratio * omega_b, limits.bounds.omega_low]
    parts = [start, [limits.variable(omega) for omega in steps], [0.0]]
    ends = np.concatenate([*parts, np.geomspace(start.max(), top, 400)])
    ends = np.unique(ends[ends <= top])
    h = multiplier.at(ends)
    beyond = (1.0 + limits.bounds.S_max) * basis.tail(top, weight)
    found = multiplier.intervals(ends[:-1], ends[1:], h[:-1], h[1:])
    while True:
        total, excess = float(found["upper"].sum()) + beyond, float(found["loss"].sum())
        if total < -MARGIN * float(found["size"].sum()):
            return True
        if not np.isfinite(total) or total - excess > 0.0:
            return False
        found = found[np.argsort(-found["loss"])]
        count = int(np.searchsorted(np.cumsum(found["loss"]), SPLIT * excess)) + 1
        if len(found) + count > MOST:
            return False
        split, rest = found[:count], found[count:]
        halves = (
            multiplier.intervals(*(split[name] for name in names))
            for names in (("low", "middle", "h_low", "h_middle"),
                          ("middle", "high", "h_middle", "h_high"))
        )  # fmt: skip
        found = np.concatenate([rest, *halves])
