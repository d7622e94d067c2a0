"""Enclosures of S, KS, T and GS over a range of frequencies and a box of uncertain parameters.

At one frequency each mode enters the plant once, with a matrix of rank one, so that the set of
plants is a sum of one region per mode. Each is enclosed by a disc (`mode_discs`); the work grows
with their number and not with that of the boxes' corners. With K = K̂/y and W = M⁻¹,

    S = yW,  KS = K̂W,  T = W GK̂,  GS = yW G,   M = y + GK̂,  G = Σ_i g_i c_i b_iᵀ.

The mode with the largest disc is taken as it is (`rank_one`), the others at their centres. These,
y and K̂ differ by Δ in M and by a factor 1 + E of K̂, so that with M₁ = M + Δ

    S₁ - S = T - T₁ = M₁⁻¹(Δ_y T - Δ_GK S),   S₂ = (1 + T₁E)⁻¹S₁,   T₂ = T₁ + T₁E S₂,
    M₁⁻¹ = W - W Δ W + W Δ W Δ M₁⁻¹,
    ‖Σ δ_i c_i b_iᵀ‖² <= ‖Σ r_i a_i c_i c_iᵀ‖ ‖Σ r_i/a_i b_i b_iᵀ‖   for all |δ_i| <= r_i, a_i > 0.

To first order every disc counts along its own direction (`norm_with`), so that modes which move
one channel leave the others alone; what is of higher order counts by its norm.

y is that of `boxes`. Where M is regular on the whole axis for all of a connected set of plants, no
pole crosses it: they are all stable or none is (zero exclusion).
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.fixed_structure.boxes import Axis, Boxes, Chart, axis_of, gain_of
from ccd_casadi.fixed_structure.mode_discs import discs_of
from ccd_casadi.fixed_structure.rank_one import (
    Range,
    Turned,
    inverses,
    norm,
    norm_of_any,
    norm_with,
)
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import ModalSum
from ccd_casadi.support.arrays import Array

FAR = 0.5  # relative: a gain that moves more over a box is bounded, not followed
ENDLESS = 1e100  # rad/s: where weights are at their ends


@dataclass(frozen=True)
class Enclosures:
    """Per bound (M, N): the figure over its bound lies between `lowest` and `highest` on a box.

    `spread` (1 + n_p, N) says how much each coordinate moves the loop over the box. `bounded`
    where the loop has no pole on the axis and the plant none right of it.
    """

    names: tuple[str, ...]
    highest: Array
    lowest: Array
    spread: Array
    bounded: np.ndarray


@dataclass(frozen=True)
class LoopFamily:
    """One option's loops with one controller over the box of `names`; time in 1/`unit`.

    `parts`: structure and κ of each channel, `outputs` (p, p) and `inputs` (m, p) their directions.
    `plant`, κ, `period` and `delay` in that time, gains in N/m; `bandwidth` in rad/s.
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

    def enclose(self, boxes: Boxes) -> Enclosures:
        """All bounds on all boxes."""
        axis = axis_of(boxes, self.period, self.delay)
        compliance, level = self.bounds.compliance_max, self.bounds.weighted_level
        held, free, damped = discs_of(
            self.plant, self.names, boxes.low[1:], boxes.high[1:], axis, compliance is not None
        )
        gains, loose, faint = self._gains(axis)
        finite = np.isfinite(held.middle + held.radius + free.middle + free.radius)
        good = finite.all(axis=0) & np.isfinite(gains).all(axis=1) & np.isfinite(axis.y.rest)
        one = np.ones(len(good))
        y, moved, most = one, 0.0 * one, one
        if self._integrator:
            y, moved, most = axis.y.centre, axis.y.reach + axis.y.rest, axis.y.size
        K = np.einsum("mc,Nc,pc->Nmp", self.inputs, np.where(good, gains.T, 0.0).T, self.outputs)
        c, b = (
            np.repeat(part[:, None], len(good), axis=1)
            for part in (self.plant.reading, self.plant.drive)
        )
        rows = np.einsum("iNm,Nmp->iNp", b, K)
        m, r = np.where(good, held.middle, 0.0), np.where(good, held.radius, 0.0)
        weight, at = _sizes(c, rows), np.arange(len(good))
        strong = np.argmax(r * weight, axis=0)
        others = np.arange(len(c))[:, None] != strong
        unit = np.tile(np.eye(c.shape[2]), (len(good), 1, 1))
        y_unit = y[:, None, None] * unit
        M = y_unit + _total(others * m, c, rows)
        terms = np.abs(y) + (others * np.abs(m) * weight).sum(axis=0)
        W = inverses(M, terms, c[strong, at], rows[strong, at], m[strong, at], r[strong, at])
        w, T = W.norms(), W.from_one(y).norms()
        # what is left: Δ, of which `known` by discs and `faintly` by gains not followed; then E
        grain = np.linalg.norm(faint, axis=1) * norm(self.inputs) * norm(self.outputs)
        apart = (
            np.linalg.norm(self.plant.reading, axis=1)[:, None]
            * np.abs(self.plant.drive @ self.inputs)
            * np.linalg.norm(self.outputs, axis=0)
        )
        faintly = np.einsum("iN,ic,Nc->N", np.abs(m) + r, apart, faint)
        known = norm_of_any(c, rows, others * r)
        off = known + faintly + moved
        good &= damped & W.good & (w[0] * off < 1.0)
        after = w[0] / np.where(good, 1.0 - w[0] * off, 1.0)  # ‖M₁⁻¹‖
        loose = loose * max(np.linalg.cond(part) for part in (self.outputs, self.inputs))
        unknown = after * (np.abs(y) * w[0] * faintly + T[0] * moved)  # of S and T
        apart = unknown + after * np.abs(y) * w[0] * known
        by = loose * (T[0] + apart)  # of T₁E
        good &= by < 1.0
        by = np.where(good, by, 0.0)
        over = after / (1.0 - by)
        unknown, apart = unknown + by * most * over, apart + by * most * over
        # each disc along its own direction, W c_i and b_iᵀK̂W
        u, v = np.einsum("Npq,iNq->iNp", W.middle, c), np.einsum("iNp,Npq->iNq", rows, W.middle)
        radius = others * r
        radius[strong, at] = W.reach / np.maximum(_sizes(u, v)[strong, at], 1e-300)

        def near(A: Turned, left: np.ndarray, size: Array) -> Array:
            """‖A - L W D W‖ of the discs' D, and what is of higher order; `size`: of L W."""
            p = np.einsum("Nkp,iNp->iNk", left, u)
            aside = (radius * _sizes(p, v))[strong, at]
            rest = known * (aside * w[0] + size * (W.reach + w[0] * off * after))
            return norm_with(A.middle, p, v, radius) + A.lost + rest

        upper = near(W.between(y_unit, unit), y_unit, np.abs(y) * w[0]) + unknown
        upper = np.fmin(upper, np.minimum(most * over, np.abs(y) * w[0] + apart))
        found = self._of_S(boxes, (upper, np.abs(y) * w[1] - apart), over)
        if level is not None:
            KW = W.between(K, unit)
            k = KW.norms()
            more = k[0] * after * off
            turned = loose * over * (norm(K) + (k[0] + more) * (most + faintly))  # of K̂T₁E M₂⁻¹
            upper = np.fmin(k[0] + more, near(KW, K, k[0]) + k[0] * after * (faintly + moved))
            upper = (1.0 + loose) * (upper + turned) + grain * over
            lower = (1.0 - loose) * (k[1] - more - turned) - grain * over
            T_most = near(W.from_one(y), y_unit, np.abs(y) * w[0]) + unknown
            T_most = np.fmin(T_most, T[0] + apart)
            found += self._weighted(boxes, level, (upper, lower), (T_most, T[1] - apart))
        if compliance is not None:
            g, e = np.where(good, free.middle, 0.0), np.where(good, free.radius, 0.0)
            WG = W.between(unit, _total(g, c, b))
            h, apart = WG.norms(), most * after * norm_of_any(c, b, e)
            apart += (np.abs(y) * after * off + moved * (1.0 + after * off)) * h[0]
            p, q = (
                np.concatenate([u, u]),
                np.concatenate([b, np.einsum("iNp,Npm->iNm", rows, WG.middle)]),
            )
            upper = norm_with(WG.middle, p, q, np.concatenate([e, radius])) + WG.lost
            upper += known * (W.reach * h[0] + w[0] * WG.reach) + w[0] * (faintly + moved) * h[0]
            along = np.abs(np.einsum("iNp,Np->iN", c, v[strong, at]))
            aside = (e * along * np.linalg.norm(b, axis=2)).sum(axis=0)  # of W's disc on those of G
            aside *= (radius * np.linalg.norm(u, axis=2))[strong, at]
            upper += aside + after * off * (w[0] * off * h[0] + norm_of_any(u, b, e) + aside)
            upper = np.fmin(most * upper, np.abs(y) * h[0] + apart)
            lower = np.abs(y) * h[1] - apart
            inside = compliance * self._inside(boxes)
            found.append(("GS", upper / (1.0 - by) / inside, lower / (1.0 + by) / inside))
        weight[strong, at] = np.where(
            W.good, W.reach / (w[0] ** 2 * np.maximum(r[strong, at], 1e-300)), weight[strong, at]
        )
        shares = np.where(np.isfinite(held.shares), held.shares, 0.0)
        spread = np.einsum("iN,ikN->kN", np.where(finite, weight, 1.0), shares)
        spread[0] += moved + most * loose
        names, most_at, least_at = zip(*found, strict=True)
        highest, lowest = np.array(most_at), np.array(least_at)
        highest = np.where(good & ~np.isnan(highest), highest, np.inf)
        lowest = np.where(good & np.isfinite(lowest), lowest, 0.0)
        return Enclosures(names, highest, lowest, spread, good)

    @property
    def _integrator(self) -> bool:
        """Of one output any channel's holds it, of several each has its own."""
        known = [own.integrator for own, _ in self.parts]
        return any(known) if len(self.outputs) == 1 else all(known)

    def _gains(self, axis: Axis) -> tuple[np.ndarray, Array, Array]:
        """K̂ of every channel in the middle (N, c), and how far K̂ lies from it at most, relative
        (N,); where that is far, as at infinity, the middle is 0 and |K̂| is in the last (N, c).

        Where several channels share an output, E would not be a factor of theirs alone: how far
        they lie from the middle is in the last too."""
        found, faint, loose = [], [], np.zeros(len(axis.x.centre))
        own = self.outputs.shape[0] == self.outputs.shape[1]
        for structure, kappa in self.parts:
            K = gain_of(structure, kappa, axis, self._integrator)
            radius = K.reach + K.rest
            near = radius < FAR * np.abs(K.centre)
            found.append(np.where(near, K.centre, 0.0))
            faint.append(np.where(near, 0.0 if own else radius, np.abs(K.centre) + radius))
            loose = np.maximum(loose, np.where(near & own, radius / np.abs(K.centre), 0.0))
        return np.array(found).T, loose, np.array(faint).T

    def _inside(self, boxes: Boxes) -> Array:
        """1, and infinite at the point that is not part of the axis."""
        return np.where(boxes.chart == Chart.POINT, np.inf, 1.0)

    def _of_S(self, boxes: Boxes, S: Range, over: Array) -> list[tuple[str, Array, Array]]:
        """(name, figure over its bound at most, at least) of every bound on S; `over`: ‖S/y‖."""
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
            top = b.shape * np.sqrt(0.5) / self.bandwidth
            # |y| <= ω/unit, so that near 0 |S|/ω is bounded with an integrator
            rising = over / self.unit if self._integrator else S[0] / np.maximum(low, b.omega_low)
            rising = np.minimum(rising, S[0] / np.maximum(low, 1e-300))
            least = S[1] / np.maximum(high, b.omega_low)
            found.append(("SHAPE", rising / (top * until), least / (top * until)))
        return found

    def _weighted(
        self, boxes: Boxes, level: float, KS: Range, T: Range
    ) -> list[tuple[str, Array, Array]]:
        """The same of KS and T; |W_KS| and |W_T| are monotone in ω."""
        assert self.bounds.weights is not None
        ends = [np.minimum(omega, ENDLESS) for omega in boxes.omega(self.unit, self.period)]
        weights = np.abs([self.bounds.weights.responses(omega) for omega in ends])[:, 1:]
        limit = level * self._inside(boxes)
        return [(name, weights[:, i].max(axis=0) * most / limit,
                 weights[:, i].min(axis=0) * least / limit)
                for i, (name, (most, least)) in enumerate((("KS", KS), ("T", T)))]  # fmt: skip

    @property
    def corner(self) -> float:
        """The ω in rad/s from which on the shape is above S_max; infinite without a shape."""
        b = self.bounds
        return np.inf if b.shape is None else b.S_max * np.sqrt(2.0) / b.shape * self.bandwidth


def _total(g: np.ndarray, c: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Σ g_i c_i row_iᵀ (N, p, q) of g (n, N), c (n, N, p) and rows (n, N, q)."""
    return np.asarray(np.einsum("iN,iNp,iNq->Npq", g, c, rows))


def _sizes(p: np.ndarray, q: np.ndarray) -> Array:
    """Of the matrices p_i q_iᵀ (n, N)."""
    return np.asarray(np.linalg.norm(p, axis=2) * np.linalg.norm(q, axis=2))
