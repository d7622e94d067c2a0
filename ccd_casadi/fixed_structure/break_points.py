"""Enclosures of |S| wherever the loop of several sensors on one actuator may be broken.

With L = Σ_j G_j K_j, j over the sensors, the loop broken at sensor i or at the actuator has

    S_i = 1/(1 + L_i) = (1 + L - G_i K_i)/(1 + L),   S_u = 1/(1 + L),

fractions of numbers, whatever the number of sensors. Numerator and denominator are sums over the
same discs: modes of the plant, gains of the channels and y of `boxes`, K_j = K̂_j/y.
`Fraction.enclose` has the one inequality that all figures rest on.
"""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure.boxes import Boxes, FrequencyAxis, axis_of, gain_of
from ccd_casadi.fixed_structure.discs import GUARD, Discs, Fraction
from ccd_casadi.fixed_structure.enclosure import Enclosures, LoopFamily
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class LoopNumbers:
    """The quantities that the fractions of B boxes are made of, each as a middle and a radius.

    Attributes
    ----------
    y, delta_y : array (B,)
        y of `boxes`; 1 and 0 without an integrator.
    middle, radius : array (B, n)
        Modes; `at_rest` those of `rigid` ones are of y² times them.
    gains, of_gains : array (B, c)
        K̂_j and its radius.
    plain, of_plain : array (B, c)
        K_j of channels without an integrator.
    terms : array (n, c)
        b_i u_jᵀc_i, mode i as sensor j sees it.
    rigid : bool array (n,) or None
        At rest: the modes that count, everything else being small beside them; None: all.
    """

    y: np.ndarray
    delta_y: Array
    middle: np.ndarray
    radius: Array
    gains: np.ndarray
    of_gains: Array
    plain: np.ndarray
    of_plain: Array
    terms: Array
    rigid: np.ndarray | None

    @property
    def counted(self) -> Array:
        """1 of modes that count, 0 of others (n,)."""
        return np.ones(len(self.terms)) if self.rigid is None else self.rigid.astype(float)

    @property
    def most_of_y(self) -> Array:
        """|y| at most (B,)."""
        return np.asarray(np.abs(self.y) + self.delta_y)

    def seen(self, counted: Array) -> Array:
        """|Σ of these modes| at most, by sensor (B, c)."""
        middle = np.abs((self.middle * counted) @ self.terms)
        return np.asarray(middle + (self.radius * counted) @ np.abs(self.terms))

    def beside(self, gains: Array) -> Array:
        """Bound what modes that do not count add at rest with gains (B, c), times y² (B,)."""
        if self.rigid is None:
            return 0.0 * self.delta_y
        return np.asarray(self.most_of_y**2 * (self.seen(1.0 - self.counted) * gains).sum(axis=1))

    def fraction(self, kept: Array, of_y: bool, ahead: bool = True) -> Fraction:
        """N/D with D = y + Σ G_j K̂_j, both times y² at rest.

        Parameters
        ----------
        kept : array (c,)
            1 for the sensors that N has, else 0.
        of_y : bool
            N = y + Σ_kept G_j K̂_j; else N = 1 + Σ_kept G_j K_j.
        ahead : bool
            Whether N has that y or 1.
        """
        gains, moved = (self.gains, self.of_gains) if of_y else (self.plain, self.of_plain)
        counted, seen = self.counted, self.seen(self.counted)
        of_above = ((gains * kept) @ self.terms.T) * counted
        of_below = (self.gains @ self.terms.T) * counted
        one, at_rest = np.ones((len(seen), 1)), self.rigid is not None
        sizes = np.abs(self.middle) + self.radius
        total = (sizes * counted * (np.abs(self.gains) @ np.abs(self.terms.T))).sum(axis=1)
        above = (sizes * counted * ((np.abs(gains) * kept) @ np.abs(self.terms.T))).sum(axis=1)
        begin = (self.y if of_y else one[:, 0]) * float(ahead)
        beside = GUARD * (total + above + np.abs(self.y) + np.abs(begin))
        beside += self.beside(np.abs(self.gains) + self.of_gains)
        if not of_y:  # K_j of N moves apart from K̂_j of D
            beside += (moved * kept * seen).sum(axis=1) + self.beside(
                (np.abs(gains) + moved) * kept
            )
        first, last = (begin, self.y) if not at_rest else (0.0, 0.0)
        if at_rest:
            beside += self.most_of_y**2 * (self.most_of_y + (0.0 if of_y else 1.0))
        in_y = 0.0 if at_rest else 1.0
        y_above = in_y * float(of_y and ahead) * one
        return Fraction(
            first + (self.middle * of_above).sum(axis=1),
            last + (self.middle * of_below).sum(axis=1),
            np.concatenate([of_above, kept * float(of_y) * one, y_above], axis=1),
            np.concatenate([of_below, np.ones_like(seen), in_y * one], axis=1),
            np.concatenate([self.radius, self.of_gains * seen, self.delta_y[:, None]], axis=1),
            beside,
        )  # fmt: skip


@dataclass(frozen=True)
class SensorFamily(LoopFamily):
    """One option's loops of several sensors on one actuator; see `Bounds.error`."""

    @property
    def _error(self) -> int:
        assert self.bounds.error is not None
        return self.bounds.error

    @property
    def _integrator(self) -> bool:
        """Whether the sensor whose error counts has one; no other may."""
        return self.parts[self._error][0].integrator

    def enclose(self, boxes: Boxes) -> Enclosures:
        """Enclose every figure over its bound on every box, as `LoopFamily.enclose` does.

        Up to ω_low free bodies are infinite beside all else: there every fraction is taken times
        y², of which each mode 1/s² makes y²/s², and what does not move freely counts as beside.
        """
        found = self._enclose(boxes, at_rest=False)
        near = self.near_rest(boxes)
        if not near.any():
            return found
        return found.improve(near, self._enclose(boxes.only(near), at_rest=True))

    def _enclose(self, boxes: Boxes, at_rest: bool) -> Enclosures:
        axis = axis_of(boxes, self.period, self.delay, at_rest, self.low_pass)
        held, free, damped = self._discs(boxes, axis)
        numbers, finite = self._numbers(axis, held, at_rest)
        finite &= np.isfinite(free.middle + free.radius).all(axis=0) & damped
        count, error, inside = len(self.parts), self._error, self._inside(boxes)
        each = [numbers.fraction((np.arange(count) != i).astype(float), True)
                for i in range(count)]  # fmt: skip
        at_actuator = numbers.fraction(np.zeros(count), True)
        figures = [one.enclose() for one in (*each, at_actuator)]
        S, over_y = figures[error][:2], figures[error][0]
        if self._integrator:  # S/y, near 0 Hz
            over_y = numbers.fraction((np.arange(count) != error).astype(float), False).enclose()[0]
        found = self._of_S(boxes, S, over_y)
        for own, figure in zip(self.bounds.channels, figures, strict=True):
            limit = (own.S_max or self.bounds.S_max) * inside
            found.append((f"S_MAX of {own.name}", figure[0] / limit, figure[1] / limit))
        if self.bounds.weighted_level is not None:
            own = (np.arange(count) == error).astype(float)
            T = numbers.fraction(own, True, ahead=False).enclose()[:2]
            KS = _force(numbers, at_actuator, self.outputs)
            found += self._enclose_weighted(boxes, self.bounds.weighted_level, KS, T)
        if self.bounds.compliance_max is not None:
            upper, lower = _compliance(numbers, at_actuator, free, error)
            limit = self.bounds.compliance_max * inside
            weakest, strongest = self._strength(boxes)
            found.append(("GS", upper / (limit * weakest), lower / (limit * strongest)))
        names, tops, least = zip(*found, strict=True)
        good = finite & figures[-1][3]
        highest = np.where(good & ~np.isnan(tops), tops, np.inf)
        lowest = np.where(good & np.isfinite(least) & (not at_rest), least, 0.0)
        moved = np.max([figure[2] for figure in figures], axis=0)
        spread = self._spread(held, finite, moved, at_actuator)
        self._add_strength(spread, names, highest, boxes, np.ones(len(finite)))
        return Enclosures(names, highest, lowest, spread, good)

    def _numbers(
        self, axis: FrequencyAxis, held: Discs, at_rest: bool
    ) -> tuple[LoopNumbers, np.ndarray]:
        """Compute what the loops are made of, and the boxes on which all of it is finite; 0 on
        others."""
        one = np.ones(len(axis.y.rest))
        y = (axis.y.centre, axis.y.reach + axis.y.rest) if self._integrator else (one, 0.0 * one)
        gains = [gain_of(*part, axis, self._integrator) for part in self.parts]
        plain = [own if structure.integrator else gain_of(structure, kappa, axis, False)
                 for own, (structure, kappa) in zip(gains, self.parts, strict=True)]  # fmt: skip
        K, P = ((np.array([own.centre for own in rows]).T,
                 np.array([own.reach + own.rest for own in rows]).T)
                for rows in (gains, plain))  # fmt: skip
        finite = np.isfinite(held.middle + held.radius).all(axis=0) & np.isfinite(y[0] + y[1])
        finite &= np.isfinite(K[0] + K[1] + P[0] + P[1]).all(axis=1)
        known = (*y, held.middle.T, held.radius.T, *K, *P)
        y_c, delta_y, m, r, k, of_k, p, of_p = (
            np.asarray(np.where(finite, part.T, 0.0).T) for part in known
        )
        terms = (self.plant.drive @ self.inputs) * (self.plant.reading @ self.outputs)
        rigid = self.plant.rigid if at_rest else None
        return LoopNumbers(y_c, delta_y, m, r, k, of_k, p, of_p, terms, rigid), finite

    def _spread(self, held: Discs, finite: np.ndarray, moved: Array, of_all: Fraction) -> Array:
        """Bound how much each coordinate moves the loop (1 + n_p, N)."""
        n = len(held.middle)
        weight = np.where(finite[:, None], moved[:, :n], 1.0)
        shares = np.where(np.isfinite(held.shares), held.shares, 0.0)
        found = np.einsum("Ni,ikN->kN", weight, shares)
        size = np.maximum(np.abs(of_all.below), 1e-300)
        rest = (moved[:, n:] * of_all.radius[:, n:]).sum(axis=1) + of_all.beside / size
        found[0] += np.where(finite, rest, 1.0)
        return np.asarray(found)


def _force(numbers: LoopNumbers, whole: Fraction, outputs: Array) -> tuple[Array, Array]:
    """‖KS‖ at most and at least, by the plant's own outputs: the root of Σ_i |Σ_j U_ij K_j S_u|²,
    D times K_j S_u being K̂_j. Channels' directions U need not be orthogonal."""
    parts = []
    at_rest = 1.0 if numbers.rigid is None else numbers.most_of_y**2
    gains, of_gains = outputs @ numbers.gains.T, np.abs(outputs) @ numbers.of_gains.T
    for gain, radius in zip(gains, of_gains, strict=True):
        N = np.abs(gain) * at_rest
        upper, lower, _, good = replace(whole, above=N, of_above=0.0 * whole.of_above).enclose()
        left = _least_of(whole, good)
        parts.append((upper + at_rest * radius / left, np.maximum(lower - radius / left, 0.0)))
    most, least = (np.linalg.norm(side, axis=0) for side in zip(*parts, strict=True))
    return most, least


def _least_of(whole: Fraction, good: np.ndarray) -> Array:
    """|D| at least; 1 where nothing is known."""
    R = (whole.radius * np.abs(whole.of_below)).sum(axis=1) + whole.beside
    return np.asarray(np.where(good, np.abs(whole.below) - R, 1.0))


def _compliance(
    numbers: LoopNumbers, whole: Fraction, free: Discs, error: int
) -> tuple[Array, Array]:
    """|S_u G_e| at most and at least, G_e without hold and delay: N = y G_e, D as of S_u."""
    seen, counted = numbers.terms[:, error], numbers.counted
    m, e = (np.where(np.isfinite(part), part, 0.0).T for part in (free.middle, free.radius))
    most = np.abs(m) + e
    left = numbers.delta_y * ((most * counted) @ np.abs(seen))  # of y in N
    if numbers.rigid is not None:
        left += numbers.most_of_y**3 * ((most * (1.0 - counted)) @ np.abs(seen))
    left += GUARD * numbers.most_of_y * (most @ np.abs(seen))
    of_above = numbers.y[:, None] * (seen * counted)
    upper, lower, _, good = Fraction(
        (m * of_above).sum(axis=1), whole.below,
        np.concatenate([0.0 * whole.of_above, of_above], axis=1),
        np.concatenate([whole.of_below, 0.0 * of_above], axis=1),
        np.concatenate([whole.radius, e], axis=1), whole.beside,
    ).enclose()  # fmt: skip
    left = np.where(good, left / _least_of(whole, good), np.inf)
    return upper + left, np.maximum(lower - left, 0.0)
