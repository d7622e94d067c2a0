"""The loops of boxes with every mode in a disc, and what bounds one of their norms."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ccd_casadi.fixed_structure.discs import GUARD, Discs, RankOneDiscs, norm
from ccd_casadi.support.arrays import Array


class FigureBounds(NamedTuple):
    """A norm on N boxes: at most `upper`, at least `lower` (N,), and what makes it uncertain: each
    disc by `by_disc` per radius (N, n), to first order, and all else by `beside` (N,)."""

    upper: Array
    lower: Array
    by_disc: Array
    beside: Array


@dataclass(frozen=True)
class LoopDiscs:
    """The loops of N boxes with every mode in a disc, by the numbers of `LoopFamily.enclose`.

    Attributes
    ----------
    held, free : Discs
        The n modes with and without hold and delay, as `discs_of` has them.
    m, r, g, e : array (N, n)
        Middles and radii of `held`, then of `free`; 0 where a box is not `good`.
    c, b, f : array (n, p), (n, m), (n, q)
        The modes' directions of outputs, inputs and disturbing forces.
    K : array (N, m, p)
        K_c.
    finite, good : array (n, N), (N,)
        Which discs are finite; where every inequality of the chain holds.
    y, y_max, delta_y : array (N,)
        y_c, max |y|, and δ_y of (3).
    epsilon, grain : array (N,)
        ε of (7); the norm of the part of K̂ that is bounded only.
    terms : RankOneDiscs
        M_d = y_c + Σ g_i c_i b_iᵀK_c as M_c and its discs; `rows` are b_iᵀK_c W.
    W, w : array (N, p, p), (N,)
        (1)
    a, delta_GK, a1, t, u1, q, a2, u2, d : array (N,)
        (2) to (10)
    """

    held: Discs
    free: Discs
    m: Array
    r: Array
    g: np.ndarray
    e: Array
    c: Array
    b: Array
    f: Array
    K: np.ndarray
    finite: np.ndarray
    good: np.ndarray
    y: np.ndarray
    y_max: Array
    delta_y: Array
    epsilon: Array
    grain: Array
    terms: RankOneDiscs
    W: np.ndarray
    w: Array
    a: Array
    delta_GK: Array
    a1: Array
    t: Array
    u1: Array
    q: Array
    a2: Array
    u2: Array
    d: Array

    @property
    def unit(self) -> Array:
        """1 (N, p, p)."""
        return np.tile(np.eye(self.W.shape[1]), (len(self.w), 1, 1))

    @property
    def yW(self) -> np.ndarray:
        """S at the middles of all discs (N, p, p)."""
        return np.asarray(self.y[:, None, None] * self.W)

    @property
    def off_middle(self) -> Array:
        """‖S₂ - y_c W‖ and ‖T₂ - (1 - y_c W)‖ (N,) at most, by (9) and (10)."""
        return np.asarray(np.abs(self.y) * self.a * self.d + self.u2)

    def S(self) -> FigureBounds:
        """Enclose ‖S₂‖ by (11)."""
        size = np.abs(self.y)
        upper = np.fmin(size * self.a + self.u2, self.y_max * self.a2)
        by_disc = size[:, None] * self.terms.pushes(self.W, self.unit)
        return FigureBounds(upper, size * self.w - self.off_middle, by_disc, self.u2)

    def T(self) -> FigureBounds:
        """Enclose ‖T₂‖ by (12)."""
        rounding = GUARD * (1.0 + np.abs(self.y) * self.w)
        lower = norm(self.unit - self.yW) - rounding - self.off_middle
        return FigureBounds(self.t + self.u2, lower, self.terms.pushes(self.yW, self.unit), self.u2)

    def KS(self) -> FigureBounds:
        """Enclose ‖K̂M₂⁻¹‖ by (13) to (16)."""
        KW, rounding = self.K @ self.W, GUARD * norm(self.K) * self.w
        k = self.terms.largest(KW, KW, self.unit) + rounding
        k1 = k * (1.0 + self.a1 * (self.delta_GK + self.delta_y))
        v = self.epsilon * self.a2 * (norm(self.K) + k1 * self.y_max)
        least = norm(KW) - rounding - k * self.d - k1 + k - v
        lower = (1.0 - self.epsilon) * least - self.grain * self.a2
        upper = (1.0 + self.epsilon) * (k1 + v) + self.grain * self.a2
        return FigureBounds(upper, lower, self.terms.pushes(KW, self.unit), upper - k)

    def GS(self) -> FigureBounds:
        """Enclose ‖yM₂⁻¹G‖ by (17) to (19)."""
        c, b, rows = self.c, self.f, self.terms.rows
        G = (c.T * self.g[:, None]) @ b
        WG, by_all = self.W @ G, row_lengths(c) * row_lengths(b)
        rounding = GUARD * self.w * (np.abs(self.g) @ by_all)
        both = RankOneDiscs(
            np.concatenate([c, c]), np.concatenate([rows, 0.0 * rows], axis=1),
            np.concatenate([self.r, self.e], axis=1), np.concatenate([0.0 * b, b]),
        )  # fmt: skip
        h = both.largest(WG, self.W, G) + rounding
        moved = self.a1 * (self.delta_GK + self.delta_y)
        d_G = self.e @ by_all + (self.r * row_lengths(c) * row_lengths(rows @ G)).sum(axis=1)
        least = np.abs(self.y) * (norm(WG) - rounding - self.a * d_G)
        least = least - (self.delta_y + self.y_max * moved) * h
        upper = self.y_max * h * (1.0 + moved) / (1.0 - self.q)
        by_disc = both.pushes(self.W, G)
        return FigureBounds(upper, least / (1.0 + self.q), by_disc, (moved + self.q) * h)

    def spread(self, worst: np.ndarray, figures: dict[str, FigureBounds]) -> Array:
        """Bound how much each coordinate moves the loop (1 + n_p, N), from what each moves the
        discs.

        A disc counts by how far it moves M; with several `figures` by how far it moves the one that
        is furthest above its bound, `worst` (N,). It decides what is divided: no bound rests on it.
        """
        n, rows = len(self.c), self.terms.rows
        by_disc = np.zeros((len(self.w), 2 * n))  # of `held`, then of `free`
        # |δ_i q_iᵀc_i| near 1 lets M nearly vanish: a smaller radius moves 1/M by less than that
        own = self.r * np.abs(np.einsum("Nip,ip->Ni", rows, self.c))
        moves = row_lengths(self.c) * row_lengths(self.b @ self.K)
        moves = moves * np.where(own < 1.0, (1.0 - own) / (1.0 + own), 1.0)
        by_disc[:, :n] = np.where(self.finite.T, moves, 1.0)
        rest = self.delta_y + self.y_max * self.epsilon
        for name, figure in figures.items():
            here = self.good & (worst == name)
            by_disc[here, : figure.by_disc.shape[1]] = figure.by_disc[here]
            rest[here] = np.where(np.isfinite(figure.beside), figure.beside, 0.0)[here]
        shares = np.concatenate([self.held.shares, self.free.shares])
        found = np.einsum("Ni,ikN->kN", by_disc, np.where(np.isfinite(shares), shares, 0.0))
        found[0] += rest
        return np.asarray(found)


def row_lengths(rows: np.ndarray) -> Array:
    """|r| of rows r (..., p)."""
    return np.asarray(np.linalg.norm(rows, axis=-1))
