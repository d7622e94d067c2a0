"""The loops of boxes with every mode in a disc, and what a force moves elsewhere, enclosed.

The force is on the plant of one actuator and sensor.
With d, c and z where the force acts, the sensor reads and the error counts, in modes i,

    z/d = (y G_zd + N K̂)/(y + G K̂),   N = G_zd G - G_zu G_yd = Σ_ij w_ij f_i h_j,
    w_ij = d_i b_j (z_i c_j - c_i z_j),   w_ii = 0,

f_i a mode as a force has it, h_i as the loop does, with hold and low passes; so that no two large
numbers are subtracted. It is a fraction of uncertain numbers f, h, K̂ and y, N bilinear.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from ccd_casadi.fixed_structure.discs import GUARD, Discs, Fraction, RankOneDiscs, norm
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


@dataclass(frozen=True)
class ForceDiscs:
    """The numbers of B boxes, each a middle and a radius.

    Attributes
    ----------
    held, of_held, free, of_free : array (B, n)
        h and f of the modes.
    alike : bool
        Whether f is h, one number.
    gain, of_gain, y, of_y : array (B,)
        K̂, and y of `boxes` or 1.
    at_rest : array (B,) or None
        |y|² of `boxes` at most: f and h of free bodies are times y², and so is the fraction.
    rigid : bool array (n,)
        Which modes are free bodies.
    """

    held: np.ndarray
    of_held: Array
    free: np.ndarray
    of_free: Array
    alike: bool
    gain: np.ndarray
    of_gain: Array
    y: np.ndarray
    of_y: Array
    at_rest: Array | None
    rigid: np.ndarray

    @property
    def bounded(self) -> Self:
        """|.| of every number at most, with no radius."""
        none = 0.0 * self.of_held
        return replace(
            self, held=np.abs(self.held) + self.of_held, free=np.abs(self.free) + self.of_free,
            of_held=none, of_free=none, gain=np.abs(self.gain) + self.of_gain,
            of_gain=0.0 * self.of_gain, y=np.abs(self.y) + self.of_y, of_y=0.0 * self.of_y,
        )  # fmt: skip

    def _values(self, zd: Array, cb: Array, w: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """G_zd, G and N of the middles (B,)."""
        return self.free @ zd, self.held @ cb, ((self.free @ w) * self.held).sum(axis=1)

    def moved(self, c: Array, b: Array, z: Array, d: Array) -> Fraction:
        """z/d of one force and one error.

        At rest terms with y² are beside: y³ and K̂ y² h_j in the denominator, y³ z_j d_j f_j and
        K̂ y² w_ij f_i h_j of other modes than free bodies in the numerator.

        Parameters
        ----------
        c, b, z, d : array (n,)
            z over a bound: what is beside counts for numerator and denominator alike.

        Returns
        -------
        Fraction
            Its uncertain numbers: h (n), f (n), K̂ and y.
        """
        zd, cb = z * d, c * b
        w = (d[:, None] * b) * (z[:, None] * c - c[:, None] * z)
        if self.alike:
            w = 0.5 * (w + w.T)
        most, kept = self.bounded, np.ones(len(c), bool)
        beside = np.zeros((2, len(self.y)))  # in numerator and denominator
        if self.at_rest is not None:
            other, kept = ~self.rigid, self.rigid
            sizes = (np.abs(part) * other for part in (zd, cb, w * other[:, None]))
            G_zd, G, N = most._values(*sizes)
            beside += self.at_rest * [most.y * G_zd + most.gain * N, most.y + most.gain * G]
            w = w * (kept[:, None] != kept)
        zd, cb = zd * kept, cb * kept
        G_zd, G, N = self._values(zd, cb, w)
        of_f, of_h = self.held @ w.T, self.free @ w
        all_zd, all_G, all_N = most._values(np.abs(zd), np.abs(cb), np.abs(w))
        lasting = 0.0 if self.at_rest is not None else 1.0
        above = self.y * G_zd + self.gain * N
        below = lasting * self.y + self.gain * G
        e, r, k = self.of_free, self.of_held, self.of_gain
        beside[0] += most.gain * ((e @ np.abs(w)) * r).sum(axis=1)
        beside[0] += k * ((np.abs(of_f) * e).sum(axis=1) + (np.abs(of_h) * r).sum(axis=1))
        beside[0] += self.of_y * (e @ np.abs(zd)) + GUARD * (most.y * all_zd + most.gain * all_N)
        beside[1] += k * (r @ np.abs(cb)) + GUARD * (most.y + most.gain * all_G)
        to_f, to_h = self.y[:, None] * zd + self.gain[:, None] * of_f, self.gain[:, None] * of_h
        if self.alike:
            to_h, e = to_h + to_f, 0.0 * e
        one = np.ones((len(self.y), 1))
        return Fraction(
            above, below,
            np.concatenate([to_h, to_f, N[:, None], G_zd[:, None]], axis=1),
            np.concatenate([self.gain[:, None] * cb, 0.0 * to_f, G[:, None], lasting * one], 1),
            np.concatenate([r, e, k[:, None], self.of_y[:, None]], axis=1),
            beside.max(axis=0),
        )  # fmt: skip

    def enclosed(self, c: Array, b: Array, z: Array, d: Array) -> tuple[Array, Array, Array, Array]:
        """Enclose the norm of z/d of several forces or several errors.

        Parameters
        ----------
        c, b, z, d : array (n,), (n,), (n, p), (n, q)
            As `moved` has them.

        Returns
        -------
        upper, lower : array (B,)
        by_disc : array (B, 2 n)
            By how much h and f move it per radius, to first order.
        beside : array (B,)
            What all else does.
        """
        n, squares = len(c), np.zeros((2, len(self.y)))
        by_disc, beside = np.zeros((len(self.y), 2 * n)), np.zeros(len(self.y))
        for i in range(z.shape[1]):
            for j in range(d.shape[1]):
                one = self.moved(c, b, z[:, i], d[:, j])
                upper, lower, moved, _ = one.enclose()
                squares += np.array([upper, lower]) ** 2
                by_disc += moved[:, : 2 * n]
                beside += (moved[:, 2 * n :] * one.radius[:, 2 * n :]).sum(axis=1)
        return (*np.sqrt(squares), by_disc, beside)
