"""σ_max of S, KS, T and GS on refined grids, as the judge reads them: their peaks and ω_b.

Grids run through every pole and zero of plant, controller and closed loop; every value is a dense
solve. Local maxima, the first -3 dB of S and every dip of the room below the shape are closed in
on by ever finer grids: no derivative is taken, as the synthesis does.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array

HALF_POWER = 1.0 / np.sqrt(2.0)
PER_DECADE = 60
FLANKS = np.concatenate([[0.0], *(np.array([-1.0, 1.0]) * x for x in (0.2, 0.5, 1.0, 2.0, 5.0))])
APART = 1e-9  # relative: grid points that are closer count as one
ZOOMS = 8  # each time eleven points between a maximum's neighbours: the spacing over 5
SECTIONS = 17  # of a bracket in ten: to rounding


class Responses:
    """σ_max of S, KS, T, SG and the weighted ones at frequencies in rad/s, by dense solves."""

    def __init__(
        self,
        free: StateSpace,
        G: StateSpace,
        K: StateSpace,
        sampling: Sampling | None,
        bounds: Bounds,
    ) -> None:
        self.free, self.G, self.K = free, G, K
        self.period = None if sampling is None else sampling.period
        self.bounds = bounds

    def at(self, omega: Array) -> dict[str, Array]:
        s = 1j * omega if self.period is None else np.exp(1j * omega * self.period)
        g, k = _response(self.G, s), _response(self.K, s)
        S = np.linalg.inv(np.eye(g.shape[1]) + g @ k)
        free = g if self.period is None else _response(self.free, 1j * omega)
        found = {
            "S": _gain(S),
            "KS": _gain(k @ S),
            "T": _gain(g @ k @ S),
            "GS": _gain(S @ free),
        }
        weights = self.bounds.weights
        if weights is not None:
            _, W_KS, W_T = np.abs(weights.responses(omega))
            found["weighted KS"], found["weighted T"] = W_KS * found["KS"], W_T * found["T"]
        for own in self.bounds.channels:
            if own.given:
                found[f"S of {own.name}"] = _length(own.output, S)
            if own.M_K is not None and weights is not None:
                W = weights.M_K / own.M_K * W_KS
                found[f"weighted KS of {own.name}"] = W * _length(own.force, k @ S)
        return found


def _response(system: StateSpace, s: np.ndarray) -> np.ndarray:
    n = len(system.A)
    solved = np.linalg.solve(s[:, None, None] * np.eye(n) - system.A, system.B + 0j)
    return np.asarray(system.C @ solved + system.D)


def _gain(M: np.ndarray) -> Array:
    """σ_max of matrices (..., p, m)."""
    if M.shape[-2:] == (1, 1):
        return np.abs(M[..., 0, 0])
    return np.asarray(np.linalg.svd(M, compute_uv=False)[..., 0])


def _length(row: Sequence[float], M: np.ndarray) -> Array:
    """‖rᵀM‖ of a row r and matrices (..., p, m)."""
    return np.asarray(np.linalg.norm(np.array(row) @ M, axis=-1))


def frequency_grid(
    roots: Sequence[np.ndarray],
    sampling: Sampling | None,
    omega_low: float,
    size: float,
    corner: float,
) -> Array:
    """ω in rad/s, logarithmic and through every root with its flanks.

    `roots`: poles of the loop, of plant and controller (sampled: in z), then zeros in s. `size`:
    the plant's fastest pole; `corner`: of the weights.
    """
    values = [np.concatenate(roots)]
    if sampling is not None:
        with np.errstate(divide="ignore"):
            # Poles are in z here; those of the plant's zeros are left in s, on the same axis.
            z = np.concatenate(roots[:3])
            values = [np.log(z[z != 0.0]) / sampling.period, np.concatenate(roots[3:])]
    joint = np.concatenate(values)
    joint = joint[np.isfinite(joint) & (np.abs(joint) > 0.0)]
    slow = np.abs(joint)[np.abs(joint) > 1e-6 * size].min()
    bottom = 0.01 * min(omega_low, slow)
    top = max(300.0 * max(size, float(np.abs(joint).max())), 30.0 * corner)
    if sampling is not None:
        top = np.pi / sampling.period
    count = int(PER_DECADE * np.log10(top / bottom))
    near = (np.abs(joint.imag)[:, None] + np.abs(joint.real)[:, None] * FLANKS).ravel()
    grid = np.concatenate([np.geomspace(bottom, top, count), near, np.abs(joint), [omega_low]])
    grid = np.unique(grid[(grid >= bottom) & (grid <= top)])
    # Of two points that rounding parts one may be the maximum, and its bracket end at the other.
    return grid[np.append(True, np.diff(grid) > APART * grid[1:])]


def peaks(
    table: Responses, grid: Array, values: dict[str, Array]
) -> dict[str, tuple[float, float]]:
    """Every curve's largest value and its frequency, local maxima within 10 % of it zoomed into.

    The brackets of all curves are evaluated at once: one solve of a point serves every curve.
    """
    best = {name: int(np.argmax(value)) for name, value in values.items()}
    tops = {name: (float(values[name][i]), float(grid[i])) for name, i in best.items()}
    of, at = [], []
    for number, value in enumerate(values.values()):
        inner = np.flatnonzero((value[1:-1] >= value[:-2]) & (value[1:-1] >= value[2:])) + 1
        at.append(inner[value[inner] > 0.9 * value.max()])
        of.append(np.full(len(at[-1]), number))
    curve, inner = np.concatenate(of), np.concatenate(at)
    if not len(inner):
        return tops
    rows = np.arange(len(inner))

    def own(points: Array) -> Array:
        found = np.stack(list(table.at(points.ravel()).values()))
        return found.reshape(len(found), *points.shape)[curve, rows]

    points, peak, i = _zoomed(own, grid[inner - 1], grid[inner + 1])
    for number, name in enumerate(values):
        mine = rows[curve == number]
        if len(mine):
            k = mine[np.argmax(peak[mine])]
            tops[name] = max(tops[name], (float(peak[k]), float(points[k, i[k]])))
    return tops


def _zoomed(
    function: Callable[[Array], Array], low: Array, high: Array
) -> tuple[Array, Array, np.ndarray]:
    """The last points (N, 11) of N brackets that close in on a maximum, its value and its place."""
    rows = np.arange(len(low))
    for _ in range(ZOOMS):
        points = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 11)
        found = function(points)
        i = np.argmax(found, axis=1)
        low, high = points[rows, np.maximum(i - 1, 0)], points[rows, np.minimum(i + 1, 10)]
    return points, found[rows, i], i


def crossing_and_bandwidth(
    table: Responses,
    grid: Array,
    S: Array,
    bounds: Bounds,
    integrator: bool,
    curve: str = "S",
) -> tuple[float, float]:
    """The first ω with |S| = 1/√2, and the largest ω_b that keeps the shape below it.

    `curve` names what S is of the table's.
    """
    # A peak between two points of the grid may pass -3 dB where both stay below.
    inner = np.flatnonzero((S[1:-1] >= S[:-2]) & (S[1:-1] >= S[2:])) + 1
    inner = inner[(S[inner] <= HALF_POWER) & (S[inner] > 0.9 * HALF_POWER)]
    if len(inner):
        points, peaks, i = _zoomed(lambda x: table.at(x.ravel())[curve].reshape(x.shape),
                                   grid[inner - 1], grid[inner + 1])  # fmt: skip
        grid = np.concatenate([grid, points[np.arange(len(i)), i]])
        grid, order = np.unique(grid, return_index=True)
        S = np.concatenate([S, peaks])[order]
    above = np.flatnonzero(S > HALF_POWER)
    if S[0] > HALF_POWER or not len(above):
        return np.nan, 0.0
    low, high = float(grid[above[0] - 1]), float(grid[above[0]])
    for _ in range(SECTIONS):
        points = np.linspace(low, high, 11)
        first = int(np.argmax(table.at(points)[curve][1:] > HALF_POWER))
        low, high = float(points[first]), float(points[first + 1])
    if bounds.shape is None:
        return low, low
    # Every dip of the room h(ω) = shape ω/(√2|S|), closed in on: ω_b <= h(ω) for all ω, or only
    # for all ω <= ω_b.
    shape, short = bounds.shape, bounds.shape_ends is ShapeEnd.CROSSING
    omega = np.unique(np.concatenate([grid, np.geomspace(low / 30.0, 3.0 * low, 1500)]))
    omega = omega[omega <= (low if short else grid[-1])]

    def room(x: Array) -> Array:
        counted = x if integrator else np.maximum(x, bounds.omega_low)
        return np.asarray(shape * counted * HALF_POWER / table.at(x)[curve])

    value = room(omega)
    inner = np.flatnonzero((value[1:-1] <= value[:-2]) & (value[1:-1] <= value[2:])) + 1
    dips = [(float(value[i]), float(omega[i])) for i in (0, len(omega) - 1)]
    if len(inner):
        points, least, i = _zoomed(lambda x: -room(x.ravel()).reshape(x.shape),
                                   omega[inner - 1], omega[inner + 1])  # fmt: skip
        dips += zip((-least).tolist(), points[np.arange(len(i)), i].tolist(), strict=True)
    if not short:
        return low, min(low, min(height for height, _ in dips))
    bandwidth = low
    while broken := [dip for dip in dips if dip[1] <= bandwidth and dip[0] < bandwidth]:
        height, at = min(broken)
        bandwidth = height if height >= at else at * (1.0 - 1e-9)
    return low, bandwidth
