"""Points that θ moves, interpolation between nodes, and axes along chosen motions."""

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np

from ccd_casadi.plants.as_written import natural_modes
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError


def in_axes(
    W: Array, dW: Array, motions: Array, dmotions: Array, quiet: int
) -> tuple[Array, Array]:
    """Weights of nodes (N, m) combined to those of axes, and the slopes.

    `motions` (N, c) are those of the nodes, of which the first `quiet` are left alone. Raises
    PlantError where the points do not separate them.
    """
    A, dA = W.T @ motions, dW.transpose(0, 2, 1) @ motions + W.T @ dmotions
    Q, R = np.linalg.qr(A)
    if np.abs(np.diag(R)).min() < 1e-9 * np.abs(np.diag(R)).max():
        words = "places: forces or sensors are on one line, or a quiet or damped mode is not seen"
        raise PlantError(f"{words} where they are; move one, or drop the mode")
    sign = np.where(np.diag(R) < 0.0, -1.0, 1.0)
    Q, R = Q * sign, sign[:, None] * R
    # with the positive diagonal of R that makes Q one: dQ = Q Ω + (I - Q Qᵀ) dA R⁻¹
    step = dA @ np.linalg.inv(R)
    turn = Q.T @ step
    lower = np.tril(turn, -1)
    dQ = Q @ (lower - lower.transpose(0, 2, 1)) + step - Q @ turn
    Q, dQ = Q[:, quiet:], dQ[..., quiet:]
    return W @ Q, dW @ Q + W @ dQ


def at_reference(W: Array, dW: Array, nodes: Array, reference: Array) -> tuple[Array, Array]:
    """Weights of nodes (N, m) combined to those of three or four points (p, 2), and the slopes.

    V has as many columns as there are points. Raises PlantError where W does not separate them.
    """
    here, there = (
        np.column_stack([np.ones(len(points)), points, points.prod(axis=1)])[:, : len(reference)]
        for points in (nodes, reference)
    )
    V, dV = W.T @ here, dW.transpose(0, 2, 1) @ here
    if np.linalg.cond(V / np.abs(here).max(axis=0)) > 1e6:
        raise PlantError("places: forces or sensors are on one line; move one, or drop reference")
    inverse, beyond = np.linalg.pinv(V), np.linalg.inv(V.T @ V) @ dV.transpose(0, 2, 1)
    slope = beyond - beyond @ V @ inverse - inverse @ dV @ inverse
    N, dN = there @ inverse, there @ slope
    return W @ N.T, dW @ N.T + W @ dN.transpose(0, 2, 1)


def followed_modes(
    M: Array, K: Array, dM: Array, dK: Array, numbers: Sequence[int]
) -> tuple[Array, Array]:
    """Shapes of flexible modes, from 1 by frequency, as columns, and their slopes.

    φ' = Σ_j φ_j φ_jᵀ(K' - λ M')φ/(λ - λ_j) - φ φᵀM'φ/2,   j over all other modes
    """
    lam, modes, rigid = natural_modes(K, M)
    flexible = np.flatnonzero(~rigid)
    if max(numbers, default=0) > len(flexible):
        raise PlantError(f"places: mode {max(numbers)} is beyond the {len(flexible)} flexible ones")
    at = flexible[[number - 1 for number in numbers]]
    modes[:, at] *= np.where(modes[np.abs(modes[:, at]).argmax(axis=0), at] < 0.0, -1.0, 1.0)
    slopes = np.zeros((len(dM), len(M), len(at)))
    for k, i in enumerate(at):
        gap = lam[i] - lam
        gap[i] = np.inf
        moved = (dK - lam[i] * dM) @ modes[:, i]
        own = 0.5 * (dM @ modes[:, i]) @ modes[:, i]
        slopes[:, :, k] = (moved @ modes / gap) @ modes.T - own[:, None] * modes[:, i]
    return modes[:, at], slopes


Coordinate = float | str  # a number, the name of a θ, or that name after a minus sign
Position = tuple[Coordinate, ...]


def names_in(points: Sequence[Sequence[Coordinate]]) -> tuple[str, ...]:
    """Collect the parameters that coordinates name, each once.

    Parameters
    ----------
    points : sequence of positions
        Numbers, names of θ, or such a name after a minus sign.

    Returns
    -------
    tuple of str

    Examples
    --------
    >>> names_in((("r", 0.1), ("-r", "s")))
    ('r', 's')
    """
    texts = (value for point in points for value in point if isinstance(value, str))
    return tuple(dict.fromkeys(text.removeprefix("-") for text in texts))


class Positions:
    """Rows of coordinates as a linear function of θ.

    Attributes
    ----------
    constant, slope : arrays (m, d), (m, d, n)
        Points are constant + slope θ, m.
    """

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
        """Return the positions at θ, (m, d)."""
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
        """Compute how far fields (n, N) are from what the other nodes predict, over their largest.

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
