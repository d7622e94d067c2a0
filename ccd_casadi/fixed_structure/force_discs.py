"""What a force moves elsewhere than at the sensor, enclosed over boxes, of one actuator and sensor.

With d, c and z where the force acts, the sensor reads and the error counts, in modes i,

    z/d = (y G_zd + N K̂)/(y + G K̂),   N = G_zd G - G_zu G_yd = Σ_ij w_ij f_i h_j,
    w_ij = d_i b_j (z_i c_j - c_i z_j),   w_ii = 0,

f_i a mode as a force has it, h_i as the loop does, with hold and low passes; so that no two large
numbers are subtracted. It is a fraction of uncertain numbers f, h, K̂ and y, N bilinear.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from ccd_casadi.fixed_structure.discs import GUARD, Fraction
from ccd_casadi.support.arrays import Array


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
