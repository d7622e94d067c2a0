"""Points that θ moves, and a smooth interpolation of anything between nodes.

    f(p) = Σ_k w_k(p) f_k,   w(p) = the first N columns of [|p - p_j|⁵, 1, p, p pᵀ] A⁻¹,

a polyharmonic spline: exact up to second degree, linear in f_k, three times differentiable.

Source: Duchon (1977) for the spline; Rippa, Adv. Comput. Math. 11 (1999), for nodes left out.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

Coordinate = float | str  # a number, the name of a θ, or that name after a minus sign
Position = tuple[Coordinate, ...]


def names_in(points: Sequence[Sequence[Coordinate]]) -> tuple[str, ...]:
    """The parameters that coordinates name, each once.

    >>> names_in((("r", 0.1), ("-r", "s")))
    ('r', 's')
    """
    texts = (value for point in points for value in point if isinstance(value, str))
    return tuple(dict.fromkeys(text.removeprefix("-") for text in texts))


class Positions:
    """Rows of coordinates as a linear function of θ: `constant` (m, d) + `slope` (m, d, n) θ."""

    def __init__(self, points: Sequence[Sequence[Coordinate]], names: Sequence[str]) -> None:
        shape = (len(points), len(points[0]) if points else 0)
        self.constant, self.slope = np.zeros(shape), np.zeros((*shape, len(names)))
        for i, point in enumerate(points):
            for j, value in enumerate(point):
                if isinstance(value, str):
                    sign = -1.0 if value.startswith("-") else 1.0
                    self.slope[i, j, list(names).index(value.removeprefix("-"))] = sign
                else:
                    self.constant[i, j] = value

    def at(self, theta: Array) -> Array:
        """At θ, (m, d)."""
        return np.asarray(self.constant + self.slope @ theta)


class NodeInterpolation:
    """w(p) and its slopes, for nodes (N, d)."""

    def __init__(self, nodes: Array) -> None:
        self.nodes, count = nodes, len(nodes)
        self.centre = 0.5 * (nodes.max(axis=0) + nodes.min(axis=0))
        self.size = max(0.5 * float(np.ptp(nodes, axis=0).max()), 1e-300)
        self._at = (nodes - self.centre) / self.size
        rows = [self._row(at) for at in self._at]
        kernel, power = (np.array([row[k] for row in rows]) for k in (0, 1))
        q = power.shape[1]
        if np.linalg.matrix_rank(power, 1e-6) < q or (kernel + np.eye(count)).min() == 0.0:
            words = "places.nodes are too few, on one line or curve, or one is there twice"
            raise PlantError(f"{words}; three or more in every direction, on a grid, do")
        self._inverse = np.linalg.inv(np.block([[kernel, power], [power.T, np.zeros((q, q))]]))
        self._inverse = self._inverse[:, :count]

    def weights(self, points: Positions, theta: Array) -> tuple[Array, Array]:
        """w of every point at θ, (N, m), and its slopes (n, N, m)."""
        found = [self.at(point) for point in points.at(theta)]
        W = np.array([w for w, _ in found]).reshape(-1, len(self.nodes)).T
        slopes = [slope.T @ own for (_, own), slope in zip(found, points.slope, strict=True)]
        shape = (W.shape[1], len(theta), len(W))  # there may be no point
        return W, np.array(slopes).reshape(shape).transpose(1, 2, 0)

    def at(self, point: Array) -> tuple[Array, Array]:
        """w (N,) at a point (d,), and the slopes (d, N)."""
        kernel, power, dkernel, dpower = self._row((point - self.centre) / self.size)
        slopes = np.vstack([dkernel, dpower]).T @ self._inverse
        return np.concatenate([kernel, power]) @ self._inverse, slopes / self.size

    def left_out(self, values: Array, points: Array) -> float:
        """How far fields (n, N) are from what the other nodes say, over their largest.

        At the inner nodes nearest to points (m, d): nodes that are far away say nothing of these,
        and beyond an edge nothing is interpolated.
        """
        count, edge = len(self.nodes), np.abs(self._at).max(axis=0)
        inner = np.flatnonzero((np.abs(self._at) < edge).all(axis=1))
        away = np.linalg.norm(self.nodes[inner, None] - points, axis=2)
        near = inner[away.argmin(axis=0)] if len(inner) else inner
        gap = (self._inverse[:count] @ values.T) / np.diag(self._inverse[:count])[:, None]
        share = np.abs(gap[near]) / np.abs(values).max(axis=1, initial=1e-300)
        return float(share.max(initial=0.0))

    def _row(self, at: Array) -> tuple[Array, Array, Array, Array]:
        """Kernel and polynomial at a scaled point, and their slopes (., d)."""
        away, eye = at - self._at, np.eye(len(at))
        r = np.linalg.norm(away, axis=1)
        pairs = list(combinations_with_replacement(range(len(at)), 2))
        power = np.array([1.0, *at, *(at[i] * at[j] for i, j in pairs)])
        slopes = [at[i] * eye[j] + at[j] * eye[i] for i, j in pairs]
        return r**5, power, 5.0 * r[:, None] ** 3 * away, np.vstack([0.0 * at, eye, *slopes])
