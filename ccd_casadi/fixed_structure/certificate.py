"""The judge of a controller on a set of plants; it shares nothing with the synthesis.

Of plants with several inputs and outputs the whole loop is judged, by largest singular values.

From the SI matrices of K and of every plant: the closed loop is rebuilt, its eigenvalues decide
stability; S, KS, T and GS are evaluated by dense solves on grids through every pole and zero of
plant, controller and closed loop, refined at every local maximum that matters. For S the largest
gain is confirmed by a Hamiltonian matrix (`norms`). A sampled loop is judged in z, its hold and
delay exact, K by Tustin's rule; what happens between samples is not in it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.loop import Sampling
from ccd_casadi.plants.scaling import ScaledPlant, StateSpace, balanced, transmission_zeros
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import Pool, Workers
from ccd_casadi.synthesis.norms import hinf_norm

HALF_POWER = 1.0 / np.sqrt(2.0)
TOLERANCE = 1e-5  # relative: by how much a figure may pass its bound and still count as met
CONFIRMED = 1e-6  # relative: between the peak of S on the grid and by the Hamiltonian
PER_DECADE = 60
FLANKS = np.concatenate([[0.0], *(np.array([-1.0, 1.0]) * x for x in (0.2, 0.5, 1.0, 2.0, 5.0))])
APART = 1e-9  # relative: grid points that are closer count as one
ZOOMS = 8  # each time eleven points between a maximum's neighbours: the spacing over 5
SECTIONS = 17  # of a bracket in ten: to rounding
REST = 1e-3  # of the lowest frequency of the grid: 0 Hz, seen from the figures' digits


@dataclass(frozen=True)
class PlantFigures:
    """One plant's loop in SI. Frequencies in rad/s; KS in N/m, GS in m/N; NaN where unstable.

    `stability`: the largest real part of a pole in 1/s, sampled the spectral radius less 1.
    `crossing`: the first -3 dB of S. `bandwidth`: the largest ω_b that the shape allows.
    `static_compliance` is GS towards 0 Hz, 0 with an integrator; `low_compliance` at ω_low.
    `weighted_KS` and `weighted_T` are NaN without weights. `confirmed`: S's peak by a Hamiltonian.
    """

    stable: bool
    stability: float
    S_peak: float
    S_peak_frequency: float
    S_low: float
    crossing: float
    bandwidth: float
    KS: float
    T: float
    GS: float
    weighted_KS: float
    weighted_T: float
    static_compliance: float
    low_compliance: float
    confirmed: bool


@dataclass(frozen=True)
class Certificate:
    """What the judge found on every plant, and whether all bounds hold with `bandwidth` (rad/s)."""

    passed: bool
    bandwidth: float
    plants: tuple[PlantFigures, ...]
    worst: dict[str, float]
    words: str


def certify(
    plants: Sequence[ScaledPlant],
    controller: StateSpace,
    bounds: Bounds,
    sampling: Sampling | None = None,
    *,
    integrator: bool = True,
    workers: Pool | None = None,
) -> Certificate:
    """Judge an SI controller (e in, u out) on plants against the bounds, σ_max of each matrix.

    `integrator`: the shape counts from 0 on, else from ω_low. ω_b is the least of all plants. The
    plants are spread over `workers`.
    """
    tasks = [
        (i, (plant, controller, bounds, sampling, integrator)) for i, plant in enumerate(plants)
    ]
    each = dict((workers or Workers(1)).map_unordered(_judge, tasks))
    found = [each[i] for i in range(len(tasks))]
    unstable = [i for i, figures in enumerate(found, 1) if not figures.stable]
    if unstable:
        words = f"unstable on plant {unstable[0]} of {len(found)}"
        return Certificate(False, np.nan, tuple(found), {}, words)
    bandwidth = float(np.min([figures.bandwidth for figures in found]))
    worst: dict[str, float] = {}
    for figures in found:
        for name, ratio in bounds.shares(figures).items():
            worst[name] = max(worst.get(name, 0.0), ratio)
    broken = [f"{name} by {ratio - 1.0:.2g}" for name, ratio in worst.items()
              if not ratio <= 1.0 + TOLERANCE]  # fmt: skip
    lost = [i for i, figures in enumerate(found, 1) if not figures.confirmed]
    if broken:
        words = f"passes its bound on {', '.join(broken)} (relative)"
    elif not bandwidth > 0.0:
        words = "S does not start below -3 dB on every plant"
    elif lost:
        words = f"the peak of S on plant {lost[0]} is not confirmed by the level test"
    else:
        words = f"stable and within every bound on {len(found)} plants"
    passed = not broken and not lost and bandwidth > 0.0
    return Certificate(passed, bandwidth, tuple(found), worst, words)


Task = tuple[ScaledPlant, StateSpace, Bounds, Sampling | None, bool]


def _judge(task: tuple[int, Task]) -> tuple[int, PlantFigures]:
    return task[0], judged(*task[1])


def judged(
    plant: ScaledPlant,
    controller: StateSpace,
    bounds: Bounds,
    sampling: Sampling | None,
    integrator: bool,
) -> PlantFigures:
    """The figures of one loop."""
    si = plant.plant_si()
    G = StateSpace(*balanced(si.A, si.B, si.C), si.D)
    K = StateSpace(*balanced(controller.A, controller.B, controller.C), controller.D)
    loop = G, K
    if sampling is not None:
        loop = _sampled(G, sampling), _tustin(K, sampling.period)
    S = _sensitivity(*loop)
    poles = np.linalg.eigvals(S.A)
    stability = float(poles.real.max() if sampling is None else np.abs(poles).max() - 1.0)
    if not stability < 0.0:
        return _unstable(stability)
    roots = [poles, np.linalg.eigvals(loop[0].A), np.linalg.eigvals(loop[1].A)]
    roots += [transmission_zeros(*_scaled(x)) * _size(x) for x in (G, K) if not x.D.any()]
    corner = 0.0
    if bounds.weights is not None:
        w = bounds.weights
        corner = max(w.c_K * w.omega_K, w.omega_T / w.A_u)
    grid = _grid(roots, sampling, bounds.omega_low, _size(G), corner)
    table = _Responses(G, loop[0], loop[1], sampling, bounds)
    values, low = table.at(grid), table.at(np.array([bounds.omega_low]))
    tops = _tops(table, grid, values)
    top, at = tops["S"]
    norm = _norm(S, sampling)
    crossing, bandwidth = _bandwidth(table, grid, values["S"], bounds, integrator)
    weighted = [tops[name][0] if name in tops else np.nan for name in ("weighted KS", "weighted T")]
    return PlantFigures(
        stable=True,
        stability=stability,
        S_peak=max(top, norm),
        S_peak_frequency=at,
        S_low=float(low["S"][0]),
        crossing=crossing,
        bandwidth=bandwidth,
        KS=tops["KS"][0],
        T=tops["T"][0],
        GS=tops["GS"][0],
        weighted_KS=weighted[0],
        weighted_T=weighted[1],
        # A channel with an integrator beside one without has a pole at 0 Hz: the limit there.
        static_compliance=0.0 if integrator else float(table.at(REST * grid[:1])["GS"][0]),
        low_compliance=float(low["GS"][0]),
        confirmed=abs(norm / top - 1.0) <= CONFIRMED,
    )


def _unstable(stability: float) -> PlantFigures:
    nan = np.nan
    return PlantFigures(
        False, stability, nan, nan, nan, nan, nan, nan, nan, nan, nan, nan, nan, nan, False
    )


class _Responses:
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
        if self.bounds.weights is not None:
            _, W_KS, W_T = np.abs(self.bounds.weights.responses(omega))
            found["weighted KS"], found["weighted T"] = W_KS * found["KS"], W_T * found["T"]
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


def _sensitivity(G: StateSpace, K: StateSpace) -> StateSpace:
    """S, r to e, of a plant without feedthrough."""
    A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    B = np.vstack([G.B @ K.D, K.B])
    C = np.hstack([-G.C, np.zeros((len(G.C), len(K.A)))])
    return StateSpace(A, B, C, np.eye(len(G.C)))


def _sampled(G: StateSpace, sampling: Sampling) -> StateSpace:
    """u_k to y_k with the delay as whole periods and a rest, in which the older force still acts.

    ẋ = A x + B u with u held is integrated over both parts of a period by one exponential of
    [[A, B, 0], [0, 0, 1/T], [0, 0, 0]]-like blocks each.
    """
    T, (n, m) = sampling.period, G.B.shape
    whole = int(np.floor(sampling.delay / T + 1e-9))
    rest = max(sampling.delay - whole * T, 0.0)
    held = np.zeros((n + m, n + m))
    held[:n, :n], held[:n, n:] = G.A, G.B
    first, second = expm(held * rest), expm(held * (T - rest))
    age = m * (whole + 1)  # u_{k-1} … of so many periods are kept
    A, B = np.zeros((n + age, n + age)), np.zeros((n + age, m))
    A[:n, :n] = second[:n, :n] @ first[:n, :n]
    A[:n, n + m * whole : n + m * (whole + 1)] = second[:n, :n] @ first[:n, n:]
    if whole:
        A[:n, n + m * (whole - 1) : n + m * whole] += second[:n, n:]
    else:
        B[:n] = second[:n, n:]
    B[n : n + m] = np.eye(m)
    A[n + m :, n : n + age - m] = np.eye(age - m)
    return StateSpace(A, B, np.hstack([G.C, np.zeros((len(G.C), age))]), np.zeros((len(G.C), m)))


def _tustin(K: StateSpace, period: float) -> StateSpace:
    """K(z) with s = (2/T)(z - 1)/(z + 1)."""
    one, half = np.eye(len(K.A)), 0.5 * period
    inverse = np.linalg.inv(one - half * K.A)
    C = K.C @ inverse
    return StateSpace(inverse @ (one + half * K.A), period * inverse @ K.B, C, K.D + half * C @ K.B)


def _norm(S: StateSpace, sampling: Sampling | None) -> float:
    """‖S‖∞ by Hamiltonian matrices; of a sampled loop with z = (1 + w)/(1 - w)."""
    if sampling is None:
        return hinf_norm(S)[0]
    inverse = np.linalg.inv(S.A + np.eye(len(S.A)))
    root = np.sqrt(2.0)
    A = inverse @ (S.A - np.eye(len(S.A)))
    return hinf_norm(
        StateSpace(A, root * inverse @ S.B, root * S.C @ inverse, S.D - S.C @ inverse @ S.B)
    )[0]


def _grid(
    roots: Sequence[np.ndarray],
    sampling: Sampling | None,
    omega_low: float,
    size: float,
    corner: float,
) -> Array:
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


def _tops(
    table: _Responses, grid: Array, values: dict[str, Array]
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


def _bandwidth(
    table: _Responses, grid: Array, S: Array, bounds: Bounds, integrator: bool
) -> tuple[float, float]:
    """The first ω with |S| = 1/√2, and the largest ω_b that keeps the shape below it."""
    # A peak between two points of the grid may pass -3 dB where both stay below.
    inner = np.flatnonzero((S[1:-1] >= S[:-2]) & (S[1:-1] >= S[2:])) + 1
    inner = inner[(S[inner] <= HALF_POWER) & (S[inner] > 0.9 * HALF_POWER)]
    if len(inner):
        points, peaks, i = _zoomed(lambda x: table.at(x.ravel())["S"].reshape(x.shape),
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
        first = int(np.argmax(table.at(points)["S"][1:] > HALF_POWER))
        low, high = float(points[first]), float(points[first + 1])
    if bounds.shape is None:
        return low, low
    # Every dip of the room h(ω) = shape ω/(√2|S|), closed in on; ω_b <= h(ω) for all ω <= ω_b.
    omega = np.unique(np.concatenate([grid[: above[0]], np.geomspace(low / 30.0, low, 1000)]))
    omega = omega[omega <= low]

    shape = bounds.shape

    def room(x: Array) -> Array:
        counted = x if integrator else np.maximum(x, bounds.omega_low)
        return np.asarray(shape * counted * HALF_POWER / table.at(x)["S"])

    value = room(omega)
    inner = np.flatnonzero((value[1:-1] <= value[:-2]) & (value[1:-1] <= value[2:])) + 1
    dips = [(float(value[i]), float(omega[i])) for i in (0, len(omega) - 1)]
    if len(inner):
        points, least, i = _zoomed(lambda x: -room(x.ravel()).reshape(x.shape),
                                   omega[inner - 1], omega[inner + 1])  # fmt: skip
        dips += zip((-least).tolist(), points[np.arange(len(i)), i].tolist(), strict=True)
    bandwidth = low
    while broken := [dip for dip in dips if dip[1] <= bandwidth and dip[0] < bandwidth]:
        height, at = min(broken)
        bandwidth = height if height >= at else at * (1.0 - 1e-9)
    return low, bandwidth


def _size(system: StateSpace) -> float:
    return float(np.abs(np.linalg.eigvals(system.A)).max())


def _scaled(system: StateSpace) -> tuple[Array, Array, Array]:
    return system.A / _size(system), system.B, system.C
