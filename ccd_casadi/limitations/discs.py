"""Discs that hold T of one plant at a frequency, by the bounds on it and on other plants.

One controller K serves all of a set. With G_i = r G it is on plant i, by T of plant G alone,

    S_i = (1 - T)/x,   T_i = r T/x,   x = 1 + (r - 1) T

so that |S_i| <= m_S and |T_i| <= m_T are circles of T (Apollonius): the inside of one where
m_S|r - 1| < 1, and where m_T|r - 1| < |r|. Others are left out, which forbids less.
Within an interval of frequency r is r₀/(1 + η) with |η| <= δ. As x is then at most x₀/(1 - δ|T_i|),
the circles are those of r₀ with m_S/(1 - δ m_T) and m_T (1 + δ)/(1 - δ m_T).
"""

import numpy as np
import scipy

from ccd_casadi.limitations.limits import FAITHFUL, Limits, Response
from ccd_casadi.support.arrays import Array

LARGEST = 100.0  # radius of a disc that is used; in the place of others the first stands again


def discs(limits: Limits, low: Array, high: Array, omega_b: float) -> tuple[np.ndarray, Array]:
    """Centres and radii (k, N) on the intervals [low, high] of v: T lies in all of them."""
    m_S, m_T = limits.radii(low, high, omega_b)
    centres, radii = [np.zeros(low.shape), np.ones(low.shape)], [m_T, m_S]
    for other in limits.others:
        m_S, m_T = other.radii(low, high, omega_b)
        r, spread = ratio(limits.row[0], other.row[0], low, high)
        slack = np.maximum(1.0 - spread * np.minimum(m_T, 1.0 + m_S), 1e-9)  # |T| <= 1 + |S|
        S, size = circle(1.0 / r, m_T * (1.0 + spread) / slack)  # T and S change places
        for centre, radius in (circle(r, m_S / slack), (1.0 - S, size)):
            matters = radius < LARGEST
            centres.append(np.where(matters, centre, 0.0))
            radii.append(np.where(matters, radius, radii[0]))
    return np.array(centres), np.array(radii)


def ratio(one: Response, other: Response, low: Array, high: Array) -> tuple[np.ndarray, Array]:
    """r = other/one at the intervals' middles, and |r(middle)/r(v) - 1| at most, on each.

    Of roots a and b in pairs |d ln r/dv| is at most the sum of |a - b|/(|jv - a| |jv - b|); of a
    root p without another 1/|jv - p|.
    """
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    slope = np.zeros(low.shape)

    def near(p: complex) -> Array:
        gap = np.maximum(np.maximum(low - p.imag, p.imag - high), 0.0)
        return np.asarray(np.hypot(p.real, gap))

    for mine, yours in ((one.zeros, other.zeros), (one.poles, other.poles)):
        rows, columns = scipy.optimize.linear_sum_assignment(np.abs(mine[:, None] - yours[None, :]))
        for a, b in zip(mine[rows], yours[columns], strict=True):
            if a != b:  # as the poles at 0 of free bodies
                slope += abs(a - b) / (near(a) * near(b))
        for p in (*np.delete(mine, rows), *np.delete(yours, columns)):
            slope += 1.0 / near(p)
    r = other.values(middle) / one.values(middle)
    return r, np.expm1(half * slope + 3.0 * FAITHFUL)


def circle(r: np.ndarray, m: Array) -> tuple[np.ndarray, Array]:
    """Of |1 - T| <= m |1 + (r - 1) T|; an infinite radius where that is not the inside of one."""
    square = 1.0 - (m * np.abs(r - 1.0)) ** 2
    inside = square > 0.0
    square = np.where(inside, square, 1.0)
    radius = np.where(inside, m * np.abs(r) / square, np.inf)
    return np.conj(1.0 + m**2 * (r - 1.0)) / square, radius
