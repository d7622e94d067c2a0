"""Enclosures of S, KS, T and GS over a range of frequencies and a box of uncertain parameters.

At one frequency each mode enters the plant once, with a matrix of rank one, so that the set of
plants is a sum of one region per mode. Each is enclosed by a disc (`discs_of`); the work grows
with their number and not with that of the boxes' corners. With K = K̂/y and W = M⁻¹,

    S = yW,  KS = K̂W,  T = W GK̂,  GS = yW G,   M = y + GK̂,  G = Σ_i g_i c_i b_iᵀ.

`LoopFamily.enclose` has the chain of inequalities from the discs to the figures. y is s over `unit`
(sampled and in the upper chart as `boxes` has it), or 1 where no channel has an integrator, so that
K̂ = yK is finite at 0 Hz. Free bodies are infinite there, and far above all else beside it: up to
ω_low what `_at_rest` finds holds, too. Where M is regular on the whole axis for all of a connected
set of plants, no pole crosses it: they are all stable or none is (zero exclusion).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.fixed_structure.boxes import Boxes, Chart, FrequencyAxis, axis_of, gain_of
from ccd_casadi.fixed_structure.discs import GUARD, Discs, RankOneDiscs, discs_of, norm
from ccd_casadi.fixed_structure.loop_discs import FigureBounds, ForceDiscs, LoopDiscs, row_lengths
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import ModalSum
from ccd_casadi.support.arrays import Array

Range = tuple[Array, Array]  # not below a figure anywhere on a box, and not above it


@dataclass(frozen=True)
class EnclosureOptions:
    """Numbers of the enclosures."""

    rank: float = 1e-9  # relative: free bodies do not move outputs along directions below it
    followed_gain: float = 0.5  # relative: a gain that moves more over a box is bounded only
    wide_discs: float = 0.5  # their sum over ‖M‖ above which parameters are divided before ω
    largest_frequency: float = 1e100  # rad/s: weights and shapes are at their ends there


@dataclass(frozen=True)
class Enclosures:
    """Figures over their bounds on N boxes, between `lowest` and `highest`.

    Attributes
    ----------
    names : tuple of str
        M bounds.
    highest, lowest : array (M, N)
    spread : array (1 + n_p, N)
        How much each coordinate moves the loop over the box.
    bounded : array (N,) of bool
        Where the loop has no pole on the axis and the plant none right of it.
    """

    names: tuple[str, ...]
    highest: Array
    lowest: Array
    spread: Array
    bounded: np.ndarray

    def improve(self, near: np.ndarray, rest: "Enclosures") -> "Enclosures":
        """Lower the upper bounds of the boxes `near` to those that `rest` has."""
        better = rest.highest.max(axis=0) < self.highest[:, near].max(axis=0)
        highest, spread, bounded = self.highest.copy(), self.spread.copy(), self.bounded.copy()
        highest[:, near] = np.minimum(rest.highest, highest[:, near])
        spread[:, near] = np.where(better, rest.spread, spread[:, near])
        bounded[near] |= rest.bounded
        return Enclosures(self.names, highest, self.lowest, spread, bounded)


@dataclass(frozen=True)
class LoopFamily:
    """One option's loops with one controller over a box of parameters; time in 1/`unit`.

    Attributes
    ----------
    plant : ModalSum
    names : tuple of str
        Of the parameters.
    parts : tuple of (Structure, array (n,))
        Structure and κ of each channel.
    outputs, inputs : array (p, p), (m, p)
        The channels' directions.
    bounds, bandwidth : Bounds, float
        rad/s.
    unit : float
        rad/s; `plant`, κ, `period` and `delay` are in time of 1/`unit`, gains in N/m.
    period, delay : float or None, float
    low_pass : tuple of complex
        The poles, in that time, of what actuators and sensors do to every channel.
    options : EnclosureOptions
    """

    plant: ModalSum
    names: tuple[str, ...]
    parts: tuple[tuple[Structure, Array], ...]
    outputs: Array
    inputs: Array
    bounds: Bounds
    bandwidth: float
    unit: float
    period: float | None
    delay: float
    low_pass: tuple[complex, ...] = ()
    options: EnclosureOptions = EnclosureOptions()

    def enclose(self, boxes: Boxes) -> Enclosures:
        """Enclose every figure over its bound on every box.

        On one box y = y_c + Δ_y, g_i lies in the disc of middle m_i and radius r_i, and
        K̂ = K_c(1 + E) + F, or (1 + E')K_c + F, where F has the channels whose gain is bounded
        only; E is 0 there, F elsewhere. M₂ = y + GK̂ is reached from the discs alone in two steps:

            M_d = y_c + Σ g_i c_i b_iᵀK_c,   M₁ = M_d + Δ_y + Δ_GK,   M₂ = M₁(1 + T₁E)

        with Δ_GK = GF and the rounding of M and W, S_d = y_c M_d⁻¹, S₁ = yM₁⁻¹, S₂ = yM₂⁻¹ and
        T = 1 - S of each. Largest singular values then keep, on the box,

            (1)   W = M_d⁻¹ at the middles of all discs,   w = ‖W‖
            (2)   ‖M_d⁻¹‖ <= a                                        `RankOneDiscs.largest`
            (3)   |Δ_y| <= δ_y,   ‖Δ_GK‖ <= δ_GK,   δ = δ_y + δ_GK
            (4)   ‖M₁⁻¹‖ <= a₁ = a/(1 - aδ)                           where aδ < 1
            (5)   ‖T_d‖ <= t                                          `RankOneDiscs.largest`
            (6)   ‖S₁ - S_d‖ = ‖T₁ - T_d‖ <= u₁ = a₁(|y_c| a δ_GK + t δ_y)
            (7)   ‖T₁E‖ <= q = ε(t + u₁),   ‖E‖, ‖E'‖ <= ε             where q < 1
            (8)   ‖M₂⁻¹‖ <= a₂ = a₁/(1 - q)
            (9)   ‖S₂ - S_d‖ = ‖T₂ - T_d‖ <= u₂ = u₁ + q max|y| a₂
            (10)  ‖M_d⁻¹ - W‖ <= ad,   d = Σ r_i |c_i| |b_iᵀK_c W|

        by (4) a Neumann series, (6) S₁ - S_d = M₁⁻¹(Δ_y T_d - Δ_GK S_d), (8) M₂⁻¹ =
        (1 + T₁E)⁻¹M₁⁻¹, (9) S₁ - S₂ = T₁E S₂, (10) M_d⁻¹ - W = M_d⁻¹(M_c - M_d)W with M_c = W⁻¹;
        M₂ = M₁(1 + T₁E) as M₁T₁ = G(K_c + F) and FE = 0. The figures:

            (11)  |y_c| w - |y_c| ad - u₂ <= ‖S₂‖ <= min(|y_c| a + u₂, max|y| a₂)
            (12)  ‖1 - y_c W‖ - |y_c| ad - u₂ <= ‖T₂‖ <= t + u₂
            (13)  ‖K_c M_d⁻¹‖ <= k                                    `RankOneDiscs.largest`
            (14)  ‖K_c M₁⁻¹‖ <= k₁ = k(1 + a₁δ)
            (15)  ‖K_c T₁E M₂⁻¹‖ <= v = ε a₂(‖K_c‖ + k₁ max|y|)
            (16)  ‖K̂M₂⁻¹‖ <= (1 + ε)(k₁ + v) + ‖F‖a₂,
                  ‖K̂M₂⁻¹‖ >= (1 - ε)(‖K_c W‖ - kd - (k₁ - k) - v) - ‖F‖a₂
            (17)  ‖M_d⁻¹G‖ <= h,   G = Σ g_i c_i f_iᵀ, discs e_i      `RankOneDiscs.largest`
            (18)  ‖yM₂⁻¹G‖ <= max|y| h(1 + a₁δ)/(1 - q)
            (19)  ‖yM₂⁻¹G‖ >= (|y_c|(‖WG_c‖ - a d_G) - (δ_y + max|y| a₁δ)h)/(1 + q),
                  d_G = Σ e_i |c_i| |f_i| + Σ r_i |c_i| |b_iᵀK_c W G_c|

        by (15) K_c T₁ = K_c - yK_c M₁⁻¹, (16) M₂⁻¹ = M₁⁻¹ - T₁E M₂⁻¹, (18) yM₂⁻¹G =
        y(1 + T₁E)⁻¹(1 - M₁⁻¹(Δ_y + Δ_GK))M_d⁻¹G; each lower bound, k and h less or more the
        rounding of its matrix, `GUARD` times its size.

        Parameters
        ----------
        boxes : Boxes
            N boxes of frequency (by their charts) and of the parameters `names`.

        Returns
        -------
        Enclosures
            Infinite above and 0 below where an inequality above does not hold.
        """
        found = self._with_finite_modes(boxes)
        near = self.near_rest(boxes)
        if not near.any():
            return found
        return found.improve(near, self._at_rest(boxes.only(near)))

    def near_rest(self, boxes: Boxes) -> np.ndarray:
        """The boxes up to ω_low of a plant with free bodies, which are infinite at 0 Hz."""
        slow = self.bounds.omega_low / self.unit * (self.period or 1.0)
        near = (boxes.low[0] == 0.0) | (boxes.high[0] <= slow)
        near &= np.isin(boxes.chart, (Chart.LOW, Chart.SAMPLED))
        return np.asarray(near & self.plant.rigid.any())

    def _with_finite_modes(self, boxes: Boxes) -> Enclosures:
        """The figures of (11) to (19) over their bounds, on boxes on which every mode is finite."""
        loop = self._loop_discs(boxes)
        compliance, level = self.bounds.compliance_max, self.bounds.weighted_level
        figures = {"S": loop.S(), "T": loop.T()}
        found = self._of_S(boxes, figures["S"][:2], loop.a2)
        if level is not None:
            figures["KS"] = loop.KS()
            found += self._enclose_weighted(boxes, level, figures["KS"][:2], figures["T"][:2])
        if compliance is not None:
            elsewhere = self.plant.counted is not None
            figures["GS"] = self._moved(loop) if elsewhere else loop.GS()
            upper, lower, *_ = figures["GS"]
            limit = self._inside(boxes) * (1.0 if elsewhere else compliance)
            least, most = self._strength(boxes)
            found.append(("GS", upper / (limit * least), lower / (limit * most)))
        names, most_at, least_at = zip(*found, strict=True)
        highest, lowest = np.array(most_at), np.array(least_at)
        highest = np.where(loop.good & ~np.isnan(highest), highest, np.inf)
        lowest = np.where(loop.good & np.isfinite(lowest), lowest, 0.0)
        of = np.array([name if name in figures else "S" for name in names])
        several = figures if len(self.outputs) > 1 or self.plant.counted is not None else {}
        spread = loop.spread(of[np.argmax(highest, axis=0)], several)
        size = figures["GS"].upper if several and compliance is not None else 1.0 / loop.w
        self._add_strength(spread, names, highest, boxes, np.where(loop.good, size, 1.0))
        return Enclosures(names, highest, lowest, spread, loop.good)

    def _loop_discs(self, boxes: Boxes) -> LoopDiscs:
        """(1) to (10) on boxes; where one of them does not hold it is one that does."""
        axis = axis_of(boxes, self.period, self.delay, low_pass=self.low_pass)
        held, free, damped = self._discs(boxes, axis)
        gains, epsilon, bounded, grain = self._gains(axis)
        finite = np.isfinite(held.middle + held.radius + free.middle + free.radius)
        good = finite.all(axis=0) & np.isfinite(gains).all(axis=1) & np.isfinite(axis.y.rest)
        y, y_max, delta_y = self._y(axis)
        m, r, g, e, K = self._middles(good, held, free, gains)
        c, b = self.plant.reading, self.plant.drive
        rows = b @ K
        unit = np.tile(np.eye(c.shape[1]), (len(good), 1, 1))
        M = y[:, None, None] * unit + (c.T * m[:, None]) @ rows
        good &= np.linalg.det(M) != 0.0
        W = np.linalg.inv(np.where(good[:, None, None], M, unit))
        w, yW = norm(W), y[:, None, None] * W
        terms = RankOneDiscs(c, rows @ W, r)
        # (3): what is bounded only, and the rounding of M and W
        each = (
            row_lengths(c)[:, None] * np.abs(b @ self.inputs) * np.linalg.norm(self.outputs, axis=0)
        )
        sizes = np.abs(y) + ((np.abs(m) + r) * (row_lengths(c) * row_lengths(rows))).sum(axis=1)
        delta_GK = np.einsum("Ni,ic,Nc->N", np.abs(m) + r, each, bounded)
        delta_GK += GUARD * sizes * (1.0 + sizes * w)
        a = terms.largest(W, W, unit)  # (2)
        good &= damped & (a * (delta_GK + delta_y) < 1.0)
        a = np.where(good, a, 1.0)
        a1 = a / np.where(good, 1.0 - a * (delta_GK + delta_y), 1.0)  # (4)
        t = terms.largest(unit - yW, -yW, unit) + GUARD * (1.0 + np.abs(y) * w)  # (5)
        u1 = a1 * (np.abs(y) * a * delta_GK + t * delta_y)  # (6)
        q = epsilon * (t + u1)  # (7)
        good &= q < 1.0
        q = np.where(good, q, 0.0)
        a2 = a1 / (1.0 - q)  # (8)
        u2 = u1 + q * y_max * a2  # (9)
        d = (r * row_lengths(c) * row_lengths(terms.rows)).sum(axis=1)  # (10)
        return LoopDiscs(
            held, free, m, r, g, e, c, b, self.plant.pushed, K, finite, good, y, y_max, delta_y,
            epsilon, grain, terms, W, w, a, delta_GK, a1, t, u1, q, a2, u2, d,
        )  # fmt: skip

    def _moved(self, loop: LoopDiscs) -> FigureBounds:
        """Enclose what a force moves over its bound, where not the sensor counts."""
        of_gain = loop.epsilon * np.abs(loop.K[:, 0, 0]) + loop.grain
        y = loop.y, loop.y_max, loop.delta_y
        return FigureBounds(
            *self._force_discs((loop.m, loop.r, loop.g, loop.e), loop.K, of_gain, y, None)
        )

    def _force_discs(
        self, modes: tuple[np.ndarray, ...], K: np.ndarray, of_gain: Array,
        y: tuple[np.ndarray, Array, Array], at_rest: Array | None,
    ) -> tuple[Array, Array, Array, Array]:  # fmt: skip
        """`ForceDiscs.enclosed` of modes (m, r, g, e), K̂ and y."""
        m, r, g, e = modes
        plant, alike = self.plant, self.period is None and not self.low_pass
        assert plant.counted is not None
        assert self.bounds.compliance_max is not None
        numbers = ForceDiscs(m, r, g, e, alike, K[:, 0, 0], of_gain, y[0], y[2], at_rest,
                             plant.rigid)  # fmt: skip
        z = plant.counted / self.bounds.compliance_max
        return numbers.enclosed(plant.reading[:, 0], plant.drive[:, 0], z, plant.pushed)

    def _at_rest(self, boxes: Boxes) -> Enclosures:
        """The same, upper bounds alone, on boxes at rest, of a plant with free bodies.

        G = R/s² + G_F with R = Σ c_i b_iᵀ of the free bodies. The discs hold y²/s², which is finite
        at 0 Hz, in place of 1/s². With P the projection on what free bodies do not move, PR = 0,
        and μ the size of y²R/s² K_c at the middles, M is taken times

            N = (y²/μ)(1 - P) + P,   NG = G_R + N G_F,   G_R = y²R/(μs²),
            ‖1 - P‖ |y²|/μ <= q = max|y|²/μ,   ‖N‖ <= n = max(q, ‖P‖)

            NM₂ = yN + (G_R + N G_F)K̂,   M_d = y_c P + (G_R + P G_F)K_c on the discs
            NM₁ = yN + (G_R + N G_F)(K_c + F),   with K̂ = K_c(1 + E) + F as in `enclose`

            (1)  W = M_d⁻¹ at the middles,   ‖M_d⁻¹‖ <= a
            (2)  ‖NM₁ - M_d‖ <= δ = q(max|y| + Σ_F (|m_i| + r_i) |c_i| |b_iᵀK_c|) + ‖P‖δ_y
                                    + ‖F‖(Σ_R + n Σ_F)(|m_i| + r_i) |c_i| |b_i| + rounding
            (3)  ‖(NM₁)⁻¹‖ <= a₁ = a/(1 - aδ)                         where aδ < 1
            (4)  ‖T₁E‖ <= ε(1 + max|y| n a₁),   T₁ = 1 - y(NM₁)⁻¹N     where that is below 1
            (5)  ‖(NM₂)⁻¹N‖ <= a₂ = n a₁/(1 - ε(1 + max|y| n a₁))

            ‖S‖ <= max|y| a₂,  ‖K̂S/y‖ <= ((1 + ε)‖K_c‖ + ‖F‖)a₂,  ‖T‖ <= 1 + ‖S‖,
            ‖GS‖ <= max|y| a₂/n (‖G_R‖ + n‖G_F‖), with f_i in the place of b_i

        Σ_R and Σ_F are sums over the free and the other modes.
        """
        axis = axis_of(boxes, self.period, self.delay, True, self.low_pass)
        compliance, level = self.bounds.compliance_max, self.bounds.weighted_level
        held, free, damped = self._discs(boxes, axis)
        gains, epsilon, _, grain = self._gains(axis)
        finite = np.isfinite(held.middle + held.radius + free.middle + free.radius).all(axis=0)
        good = finite & np.isfinite(gains).all(axis=1) & damped
        m, r, g, e, K = self._middles(good, held, free, gains)
        c, b, rigid = self.plant.reading, self.plant.drive, self.plant.rigid
        U, s, _ = np.linalg.svd(c[rigid].T, full_matrices=False)
        U = U[:, s > self.options.rank * s[0]]
        unit = np.eye(c.shape[1])
        P = unit - U @ U.T
        P_norm = float(U.shape[1] < len(unit))
        mu = norm((c[rigid].T * m[:, None, rigid]) @ (b @ K)[:, rigid])
        good &= mu > 0.0
        mu = np.where(good, mu, 1.0)
        m_y, r_y, g_y, e_y = (part.copy() for part in (m, r, g, e))
        for part in (m, r, g, e):  # from here on those of G_R
            part[:, rigid] /= mu[:, None]
        q = axis.y.size**2 / mu
        n = np.maximum(q, P_norm)
        columns = np.where(rigid[:, None], c, c @ P)
        rows, one = b @ K, np.ones(len(good))
        y, y_max, delta_y = self._y(axis)
        M = y[:, None, None] * P + (columns.T * m[:, None]) @ rows
        good &= np.linalg.det(M) != 0.0
        W = np.linalg.inv(np.where(good[:, None, None], M, unit))
        sizes = (np.abs(m) + r) * row_lengths(c) * row_lengths(rows)
        delta = q * (y_max + sizes[:, ~rigid].sum(axis=1)) + P_norm * delta_y  # (2)
        driven = (np.abs(m) + r) * row_lengths(c) * row_lengths(b)
        delta += grain * (driven[:, rigid].sum(axis=1) + n * driven[:, ~rigid].sum(axis=1))
        total = sizes.sum(axis=1) + P_norm * np.abs(y)
        delta += GUARD * total * (1.0 + total * norm(W))
        ones = np.tile(unit, (len(good), 1, 1))
        a = RankOneDiscs(columns, rows @ W, r, None).largest(W, W, ones)  # (1)
        good &= a * delta < 1.0
        a1 = np.where(good, a, 1.0) / np.where(good, 1.0 - a * delta, 1.0)  # (3)
        T1E = epsilon * (1.0 + y_max * n * a1)  # (4)
        good &= T1E < 1.0
        a2 = n * a1 / np.where(good, 1.0 - T1E, 1.0)  # (5)
        S, none = y_max * a2, 0.0 * one
        found = self._of_S(boxes, (S, none), a2)
        if level is not None:
            KS = ((1.0 + epsilon) * norm(K) + grain) * a2
            found += self._enclose_weighted(boxes, level, (KS, none), (1.0 + S, none))
        if compliance is not None and self.plant.counted is not None:
            y_most = axis.y.size**2
            grain_of = epsilon * np.abs(K[:, 0, 0]) + grain
            most, *_ = self._force_discs((m_y, r_y, g_y, e_y), K, grain_of, self._y(axis), y_most)
            found.append(("GS", most / self._inside(boxes) / self._strength(boxes)[0], none))
        elif compliance is not None:
            G = (np.abs(g) + e) * row_lengths(c) * row_lengths(self.plant.pushed)
            NG = G[:, rigid].sum(axis=1) + n * G[:, ~rigid].sum(axis=1)
            GS = y_max * a2 / n * NG / (compliance * self._inside(boxes))
            GS /= self._strength(boxes)[0]
            found.append(("GS", GS, none))
        most_at = np.array([most_of for _, most_of, _ in found])
        highest = np.where(good & np.isfinite(most_at), most_at, np.inf)
        weight = np.where(finite[:, None], row_lengths(c) * row_lengths(rows), 1.0)
        shares = np.where(np.isfinite(held.shares), held.shares, 0.0)
        spread = np.einsum("Ni,ikN->kN", weight, shares)
        # Figures fall with ω; what is not bounded is so by ω, too, unless the discs are wide.
        wide = ~good & ((r * weight).sum(axis=1) > self.options.wide_discs * norm(M))
        spread[0] += np.where(wide, delta, delta + spread.sum(axis=0) + 1e-300)
        names = tuple(name for name, *_ in found)
        self._add_strength(spread, names, highest, boxes, total)
        return Enclosures(names, highest, np.zeros_like(highest), spread, good)

    @property
    def _integrator(self) -> bool:
        """Whether an integrator holds the outputs: of one output any channel's does, of several
        each has its own."""
        known = [own.integrator for own, _ in self.parts]
        return any(known) if len(self.outputs) == 1 else all(known)

    def _discs(self, boxes: Boxes, axis: FrequencyAxis) -> tuple[Discs, Discs, np.ndarray]:
        """`discs_of` the modes on boxes, those without hold and delay where GS is bounded."""
        compliance = self.bounds.compliance_max is not None
        return discs_of(self.plant, self.names, boxes.low[1:], boxes.high[1:], axis, compliance)

    def _middles(
        self, good: np.ndarray, held: Discs, free: Discs, gains: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """m, r, g, e (N, n) and K_c (N, m, p), 0 where a box is not `good`."""
        m, r, g, e, k = (
            np.where(good, part, 0.0).T
            for part in (held.middle, held.radius, free.middle, free.radius, gains.T)
        )
        return m, r, g, e, np.einsum("mc,Nc,pc->Nmp", self.inputs, k, self.outputs)

    def _y(self, axis: FrequencyAxis) -> tuple[np.ndarray, Array, Array]:
        """y_c, max |y| and δ_y (N,); y is 1 without an integrator."""
        if self._integrator:
            return axis.y.centre, axis.y.size, axis.y.reach + axis.y.rest
        one = np.ones(len(axis.y.rest))
        return one, one, 0.0 * one

    def _gains(self, axis: FrequencyAxis) -> tuple[np.ndarray, Array, Array, Array]:
        """K̂ of every channel in the middle (N, c); ε (N,), by the largest relative distance of K̂
        from it; and where that is far, as at infinity, the middle is 0 and |K̂| is in the third
        (N, c), whose norm, that of F, is the last (N,).

        Where several channels share an output, E would not be a factor of theirs alone: how far
        they lie from the middle is in the third too."""
        found, bounded, epsilon = [], [], np.zeros(len(axis.x.centre))
        own = self.outputs.shape[0] == self.outputs.shape[1]
        for structure, kappa in self.parts:
            K = gain_of(structure, kappa, axis, self._integrator)
            radius = K.reach + K.rest
            near = radius < self.options.followed_gain * np.abs(K.centre)
            found.append(np.where(near, K.centre, 0.0))
            bounded.append(np.where(near, 0.0 if own else radius, np.abs(K.centre) + radius))
            epsilon = np.maximum(epsilon, np.where(near & own, radius / np.abs(K.centre), 0.0))
        epsilon = epsilon * max(np.linalg.cond(part) for part in (self.outputs, self.inputs))
        rest = np.array(bounded).T
        grain = np.linalg.norm(rest, axis=1) * norm(self.inputs) * norm(self.outputs)
        return np.array(found).T, epsilon, rest, grain

    def _inside(self, boxes: Boxes) -> Array:
        """1, and infinite at the point that is not part of the axis."""
        return np.where(boxes.chart == Chart.POINT, np.inf, 1.0)

    def _strength(self, boxes: Boxes) -> tuple[Array, Array]:
        """1 + p_gain at least and at most: what a force moves is enclosed as that many times as
        large, as `ModalSum.strength` is of both b_i and f_i."""
        if "gain" not in self.names:
            one = np.ones(len(boxes.chart))
            return one, one
        row = 1 + self.names.index("gain")
        return (1.0 + boxes.low[row]) * (1.0 - GUARD), (1.0 + boxes.high[row]) * (1.0 + GUARD)

    def _add_strength(
        self, spread: Array, names: Sequence[str], highest: Array, boxes: Boxes, size: Array,
        times: float = 2.0,
    ) -> None:  # fmt: skip
        """Count p_gain as often more (`times`) where GS is furthest above its bound: G and 1/M are
        enclosed apart, and so is the strength. `size`: of what spreads are measured on."""
        if "gain" not in self.names or "GS" not in names:
            return
        least, most = self._strength(boxes)
        worst = np.argmax(highest, axis=0) == list(names).index("GS")
        moved = times * 0.5 * (most - least) / least * size
        spread[1 + self.names.index("gain")] += np.where(worst, moved, 0.0)

    def _of_S(self, boxes: Boxes, S: Range, a2: Array) -> list[tuple[str, Array, Array]]:
        """(name, figure over its bound at most, at least) of every bound on S; ‖S/y‖ <= `a2`.

        Of the boxes that a bound is not of, as those beyond ω_b of LEVEL, it is infinite. SHAPE is
        (|S|/ω) / (room(ω/ω_b) √½/ω_b), from ω_low on; its room does not fall with ω.
        """
        b, inside = self.bounds, self._inside(boxes)
        low, high = boxes.omega(self.unit, self.period)
        point = boxes.chart == Chart.POINT
        below = np.where(~point & (high <= self.bandwidth * (1.0 + 1e-12)), 1.0, np.inf)
        limits = {
            "S_MAX": b.S_max * inside,
            "S_LOW": np.where(point, b.S_low, np.inf),
            "LEVEL": np.sqrt(0.5) * below,
        }
        found = [(name, S[0] / limit, S[1] / limit) for name, limit in limits.items()]
        if b.shape is not None:
            until = below if b.shape_ends is ShapeEnd.CROSSING else inside
            until = np.where(low >= self.corner * (1.0 - 1e-12), np.inf, until)
            top = self.options.largest_frequency
            ends = [np.clip(omega / self.bandwidth, 1e-300, top) for omega in (low, high)]
            room = [b.room(x) * np.sqrt(0.5) / self.bandwidth * until for x in ends]
            # |y| <= ω/unit, so that near 0 |S|/ω is bounded with an integrator
            rising = a2 / self.unit if self._integrator else S[0] / np.maximum(low, b.omega_low)
            rising = np.minimum(rising, S[0] / np.maximum(low, 1e-300))
            least = S[1] / np.maximum(high, b.omega_low)
            found.append(("SHAPE", rising / room[0], least / room[1]))
        return found

    def _enclose_weighted(
        self, boxes: Boxes, level: float, KS: Range, T: Range
    ) -> list[tuple[str, Array, Array]]:
        """The same of KS and T; |W_KS| and |W_T| are monotone in ω: the ends of a box suffice."""
        assert self.bounds.weights is not None
        top = self.options.largest_frequency
        ends = [np.minimum(omega, top) for omega in boxes.omega(self.unit, self.period)]
        weights = np.abs([self.bounds.weights.responses(omega) for omega in ends])[:, 1:]
        limit = level * self._inside(boxes)
        return [(name, weights[:, i].max(axis=0) * most / limit,
                 weights[:, i].min(axis=0) * least / limit)
                for i, (name, (most, least)) in enumerate((("KS", KS), ("T", T)))]  # fmt: skip

    @property
    def corner(self) -> float:
        """The ω in rad/s from which on the shape is above S_max; infinite without a shape."""
        b = self.bounds
        if b.shape is None:
            return np.inf
        return float(b.reached(np.array(np.sqrt(2.0) * b.S_max))) * self.bandwidth
