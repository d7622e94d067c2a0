"""Enclosures of S, KS, T and GS over a range of frequencies and a box of uncertain parameters.

At one frequency each mode enters the plant once, with a matrix of rank one, so that the set of
plants is a sum of one region per mode. Each is enclosed by a disc (`mode_discs`); the work grows
with their number and not with that of the boxes' corners. With K = K̂/y and W = M⁻¹,

    S = yW,  KS = K̂W,  T = W GK̂,  GS = yW G,   M = y + GK̂,  G = Σ_i g_i c_i b_iᵀ.

Free bodies are infinite at 0 Hz, and far above all else beside it: up to ω_low what `_at_rest`
finds holds, too.

The largest norms over all discs are those of `largest_norm`: every disc counts along its own
direction, so that modes which move one channel leave the others alone, and to all orders. What y
and K̂ differ by are Δ in M and a factor 1 + E of K̂. With M₁ = M + Δ of any M of the discs,

    S₁ - S = T - T₁ = M₁⁻¹(Δ_y T - Δ_GK S),   S₂ = (1 + T₁E)⁻¹S₁,   T₂ = T₁ + T₁E S₂.

A box is divided along what moves M, of several outputs the figure furthest above its bound.

y is that of `boxes`. Where M is regular on the whole axis for all of a connected set of plants, no
pole crosses it: they are all stable or none is (zero exclusion).
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.fixed_structure.boxes import Axis, Boxes, Chart, axis_of, gain_of
from ccd_casadi.fixed_structure.discs import GUARD, Terms, discs_of, norm
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import ModalSum
from ccd_casadi.support.arrays import Array

Range = tuple[Array, Array]  # not below a figure anywhere on a box, and not above it
RANK = 1e-9  # relative: directions of the outputs that free bodies move by less are not moved
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
        found = self._on_the_way(boxes)
        slow = self.bounds.omega_low / self.unit * (self.period or 1.0)
        near = (boxes.low[0] == 0.0) | (boxes.high[0] <= slow)
        near &= np.isin(boxes.chart, (Chart.LOW, Chart.SAMPLED))
        if not (self.plant.rigid.any() and near.any()):
            return found
        rest = self._at_rest(boxes.only(near))
        better = rest.highest.max(axis=0) < found.highest[:, near].max(axis=0)
        highest, spread, bounded = found.highest.copy(), found.spread.copy(), found.bounded.copy()
        highest[:, near] = np.minimum(rest.highest, highest[:, near])
        spread[:, near] = np.where(better, rest.spread, spread[:, near])
        bounded[near] |= rest.bounded
        return Enclosures(found.names, highest, found.lowest, spread, bounded)

    def _at_rest(self, boxes: Boxes) -> Enclosures:
        """The same, upper bounds alone, on boxes at rest, of a plant with free bodies.

        G = G_r + F, G_r = R/s². With P the projection on what free bodies do not move, P R = 0, and
        q = y²/μ, μ the size of y² G_r K̂, N = q(1 - P) + P, so that N G_r = q G_r is finite, M is
        taken times N:

            M = y N + q G_r K̂ + N F K̂,   |M - y P - (q G_r + P F) K̂| <= |q| (|y| + |F K̂|)

        S = y M⁻¹N,  KS = K̂ M⁻¹N,  T = 1 - S,  GS = y M⁻¹N G;   |N| <= max(|q|, |P|)
        """
        axis = axis_of(boxes, self.period, self.delay, at_rest=True)
        compliance, level = self.bounds.compliance_max, self.bounds.weighted_level
        held, free, damped = discs_of(
            self.plant, self.names, boxes.low[1:], boxes.high[1:], axis, compliance is not None
        )
        gains, loose, faint = self._gains(axis)
        finite = np.isfinite(held.middle + held.radius + free.middle + free.radius).all(axis=0)
        good = finite & np.isfinite(gains).all(axis=1) & damped
        m, r, g, e = (np.where(good, part, 0.0).T
                      for part in (held.middle, held.radius, free.middle, free.radius))  # fmt: skip
        K = np.einsum("mc,Nc,pc->Nmp", self.inputs, np.where(good, gains.T, 0.0).T, self.outputs)
        c, b, rigid = self.plant.reading, self.plant.drive, self.plant.rigid
        U, s, _ = np.linalg.svd(c[rigid].T, full_matrices=False)
        U = U[:, s > RANK * s[0]]
        unit = np.eye(c.shape[1])
        P = unit - U @ U.T
        held_too = float(U.shape[1] < len(unit))  # |P|
        size = norm((c[rigid].T * m[:, None, rigid]) @ (b @ K)[:, rigid])
        good &= size > 0.0
        size = np.where(good, size, 1.0)
        for part in (m, r, g, e):
            part[:, rigid] /= size[:, None]
        q = axis.y.size**2 / size
        n = np.maximum(q, held_too)
        columns = np.where(rigid[:, None], c, c @ P)
        rows, one = b @ K, np.ones(len(good))
        y, most, moved = one, one, 0.0 * one
        if self._integrator:
            y, most, moved = axis.y.centre, axis.y.size, axis.y.reach + axis.y.rest
        M = y[:, None, None] * P + (columns.T * m[:, None]) @ rows
        good &= np.linalg.det(M) != 0.0
        W = np.linalg.inv(np.where(good[:, None, None], M, unit))
        sizes = (np.abs(m) + r) * _lengths(c) * _lengths(rows)
        unknown = q * (most + sizes[:, ~rigid].sum(axis=1)) + held_too * moved
        grain = np.linalg.norm(faint, axis=1) * norm(self.inputs) * norm(self.outputs)
        unknown += grain * ((np.abs(m) + r) * _lengths(c) * _lengths(b)).sum(axis=1)
        total = sizes.sum(axis=1) + held_too * np.abs(y)
        unknown += GUARD * total * (1.0 + total * norm(W))
        ones = np.tile(unit, (len(good), 1, 1))
        a = Terms(columns, rows @ W, r, None).largest(W, W, ones)
        good &= a * unknown < 1.0
        after = np.where(good, a, 1.0) / np.where(good, 1.0 - a * unknown, 1.0)
        loose = loose * max(np.linalg.cond(part) for part in (self.outputs, self.inputs))
        by = loose * (1.0 + most * n * after)  # of T₁E
        good &= by < 1.0
        over = n * after / np.where(good, 1.0 - by, 1.0)  # ‖M⁻¹N‖
        S, none = most * over, 0.0 * one
        found = self._of_S(boxes, (S, none), over)
        if level is not None:
            KS = ((1.0 + loose) * norm(K) + grain) * over
            found += self._weighted(boxes, level, (KS, none), (1.0 + S, none))
        if compliance is not None:
            G = (np.abs(g) + e) * _lengths(c) * _lengths(b)
            NG = G[:, rigid].sum(axis=1) + n * G[:, ~rigid].sum(axis=1)
            GS = most * over / n * NG / (compliance * self._inside(boxes))
            found.append(("GS", GS, none))
        most_at = np.array([most_of for _, most_of, _ in found])
        highest = np.where(good & np.isfinite(most_at), most_at, np.inf)
        weight = np.where(finite[:, None], _lengths(c) * _lengths(rows), 1.0)
        shares = np.where(np.isfinite(held.shares), held.shares, 0.0)
        spread = np.einsum("Ni,ikN->kN", weight, shares)
        # Figures fall with ω; what is not bounded is so by ω, too, unless the discs are wide.
        wide = ~good & ((r * weight).sum(axis=1) > FAR * norm(M))
        spread[0] += np.where(wide, unknown, unknown + spread.sum(axis=0) + 1e-300)
        names = tuple(name for name, *_ in found)
        return Enclosures(names, highest, np.zeros_like(highest), spread, good)

    def _on_the_way(self, boxes: Boxes) -> Enclosures:
        """The same on boxes on which every mode is finite."""
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
        c, b = self.plant.reading, self.plant.drive
        rows = b @ K
        m, r, g, e = (np.where(good, part, 0.0).T
                      for part in (held.middle, held.radius, free.middle, free.radius))  # fmt: skip
        weight = _lengths(c) * _lengths(rows)
        unit = np.tile(np.eye(c.shape[1]), (len(good), 1, 1))
        y_unit = y[:, None, None] * unit
        M = y_unit + (c.T * m[:, None]) @ rows
        sizes = np.abs(y) + ((np.abs(m) + r) * weight).sum(axis=1)
        good &= np.linalg.det(M) != 0.0
        W = np.linalg.inv(np.where(good[:, None, None], M, unit))
        yW, KW = y[:, None, None] * W, K @ W
        # what is left of Δ besides the discs, with the rounding of M and W; then E
        grain = np.linalg.norm(faint, axis=1) * norm(self.inputs) * norm(self.outputs)
        apart = (
            _lengths(c)[:, None] * np.abs(b @ self.inputs) * np.linalg.norm(self.outputs, axis=0)
        )
        faintly = np.einsum("Ni,ic,Nc->N", np.abs(m) + r, apart, faint)
        w, k = norm(W), norm(KW)
        faintly += GUARD * sizes * (1.0 + sizes * w)
        discs = Terms(c, rows @ W, r)
        a = discs.largest(W, W, unit)
        good &= damped & (a * (faintly + moved) < 1.0)
        a = np.where(good, a, 1.0)
        after = a / np.where(good, 1.0 - a * (faintly + moved), 1.0)  # ‖M₁⁻¹‖
        loose = loose * max(np.linalg.cond(part) for part in (self.outputs, self.inputs))
        T_most = discs.largest(unit - yW, -yW, unit) + GUARD * (1.0 + np.abs(y) * w)
        unknown = after * (np.abs(y) * a * faintly + T_most * moved)  # of S and T
        by = loose * (T_most + unknown)  # of T₁E
        good &= by < 1.0
        by = np.where(good, by, 0.0)
        over = after / (1.0 - by)
        unknown += by * most * over
        aside = (r * _lengths(c) * _lengths(discs.rows)).sum(axis=1)
        near = np.abs(y) * a * aside + unknown
        pushes = {"S": (np.abs(y)[:, None] * discs.pushes(W, unit), unknown),
                  "T": (discs.pushes(yW, unit), unknown)}  # fmt: skip
        upper = np.fmin(np.abs(y) * a + unknown, most * over)
        found = self._of_S(boxes, (upper, np.abs(y) * w - near), over)
        if level is not None:
            lost = GUARD * norm(K) * w
            size = discs.largest(KW, KW, unit) + lost
            first = size * (1.0 + after * (faintly + moved))
            turned = loose * over * (norm(K) + first * (most + faintly))  # of K̂T₁E M₂⁻¹
            lower = (1.0 - loose) * (k - lost - size * aside - first + size - turned) - grain * over
            upper = (1.0 + loose) * (first + turned) + grain * over
            T = T_most + unknown, norm(unit - yW) - GUARD * (1.0 + np.abs(y) * w) - near
            found += self._weighted(boxes, level, (upper, lower), T)
            pushes["KS"] = discs.pushes(KW, unit), upper - size
        if compliance is not None:
            G = (c.T * g[:, None]) @ b
            WG, by_all = W @ G, _lengths(c) * _lengths(b)
            lost, other = GUARD * w * (np.abs(g) @ by_all), after * (faintly + moved)
            both = Terms(
                np.concatenate([c, c]), np.concatenate([discs.rows, 0.0 * discs.rows], axis=1),
                np.concatenate([r, e], axis=1), np.concatenate([0.0 * b, b]),
            )  # fmt: skip
            h = both.largest(WG, W, G) + lost
            aside = e @ by_all + (r * _lengths(c) * _lengths(discs.rows @ G)).sum(axis=1)
            lower = np.abs(y) * (norm(WG) - lost - a * aside) - (moved + most * other) * h
            upper, inside = most * h * (1.0 + other), compliance * self._inside(boxes)
            found.append(("GS", upper / (1.0 - by) / inside, lower / (1.0 + by) / inside))
            pushes["GS"] = both.pushes(W, G), (other + by) * h
        names, most_at, least_at = zip(*found, strict=True)
        highest, lowest = np.array(most_at), np.array(least_at)
        highest = np.where(good & ~np.isnan(highest), highest, np.inf)
        lowest = np.where(good & np.isfinite(lowest), lowest, 0.0)
        # what moves the loop: of several outputs the figure that is furthest above its bound
        of = np.array([name if name in pushes else "S" for name in names])
        own = r * np.abs(np.einsum("Nip,ip->Ni", discs.rows, c))  # near 1 a disc moves 1/M less
        weight = weight * np.where(own < 1.0, (1.0 - own) / (1.0 + own), 1.0)
        worst, n = of[np.argmax(highest, axis=0)], len(c)
        weight = np.where(np.tile(finite.T, 2), np.tile(weight, 2), 1.0)
        weight[:, n:], rest = 0.0, moved + most * loose
        for name, (by_disc, beside) in (pushes if len(self.outputs) > 1 else {}).items():
            here, beside = good & (worst == name), np.where(np.isfinite(beside), beside, 0.0)
            weight[here, : by_disc.shape[1]], rest[here] = by_disc[here], beside[here]
        spread = np.zeros_like(held.shares[0])
        for by, own in ((weight[:, :n], held.shares), (weight[:, n:], free.shares)):
            spread += np.einsum("Ni,ikN->kN", by, np.where(np.isfinite(own), own, 0.0))
        spread[0] += rest
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
            ends = [np.clip(omega / self.bandwidth, 1e-300, ENDLESS) for omega in (low, high)]
            room = [b.room(x) * np.sqrt(0.5) / self.bandwidth * until for x in ends]
            # |y| <= ω/unit, so that near 0 |S|/ω is bounded with an integrator
            rising = over / self.unit if self._integrator else S[0] / np.maximum(low, b.omega_low)
            rising = np.minimum(rising, S[0] / np.maximum(low, 1e-300))
            least = S[1] / np.maximum(high, b.omega_low)
            found.append(("SHAPE", rising / room[0], least / room[1]))
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
        if b.shape is None:
            return np.inf
        return float(b.reached(np.array(np.sqrt(2.0) * b.S_max))) * self.bandwidth


def _lengths(rows: np.ndarray) -> Array:
    """|r| of rows r (..., p)."""
    return np.asarray(np.linalg.norm(rows, axis=-1))
