"""PID loops on a set of plants as `pid_grid` and its judge see them, without the package.

    K(s) = k (1 + ω_i/s) (1 + s/z)/(1 + s/p) / (1 + s/r)

Of the package there are but the plants' matrices M, D, K, B, C and the bounds: modes by SciPy, |S|²
and the rest on dense frequencies, stability by eigenvalues of a loop that is built here.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.plants.plant import Mechanics

HZ = 2.0 * np.pi


@dataclass(frozen=True)
class Loop:
    """A plant's modes on every member of a set: ω, ζ, strength b c (P, m); bounds; the box of κ.

    `crossover` in rad/s is about where |L| is 1.
    """

    omega: np.ndarray
    zeta: np.ndarray
    strength: np.ndarray
    bounds: Bounds
    low: np.ndarray
    high: np.ndarray
    crossover: float

    def response(self, w: np.ndarray) -> np.ndarray:
        """G (P, F) in m/N."""
        s = 1j * w[:, None]
        o, z = self.omega[:, None], self.zeta[:, None]
        return np.asarray((self.strength[:, None] / (s * s + 2.0 * z * o * s + o * o)).sum(2))

    def frequencies(self, extra: np.ndarray | None = None) -> np.ndarray:
        """Through every mode with its flanks."""
        top = 30.0 * max(float(self.omega.max()), float(np.exp(self.high[4])))
        if self.bounds.weights is not None:
            top = max(top, 10.0 * self.bounds.weights.c_K * self.bounds.weights.omega_K)
        steps = np.geomspace(0.1, 30.0, 12)
        steps = np.concatenate([-steps, [0.0], steps])
        parts = [np.geomspace(0.1 * self.bounds.omega_low, top, 320), [self.bounds.omega_low]]
        parts.append((self.omega[..., None] * (1.0 + self.zeta[..., None] * steps)).ravel())
        w = np.unique(np.concatenate(parts if extra is None else [*parts, extra]))
        return w[w >= 0.1 * self.bounds.omega_low]


def loop_of(
    system: Mechanics, suspension: Suspension, shifts: tuple[float, ...], bounds: Bounds,
    f: float, slowest: float,
) -> Loop:  # fmt: skip
    """Modes by SciPy, flexible ones shifted; the box of κ around a crossover of f in rad/s.

    Down to `slowest` in rad/s, where the search's box ends.
    """
    lam, modes = eigh(system.K, system.M)
    natural = np.sqrt(np.maximum(lam, 0.0))
    rigid = natural < 1e-4 * natural.max()
    omega = np.array([np.where(rigid, suspension.frequency_hz * HZ, natural * (1.0 + shift))
                      for shift in shifts])  # fmt: skip
    if system.damping_ratio is None:
        zeta = 0.5 * np.diag(modes.T @ system.D @ modes) / omega
    else:
        zeta = np.full(omega.shape, system.damping_ratio)
    zeta = np.where(rigid, suspension.damping_ratio, zeta)
    strength = (system.C @ modes)[0] * (modes.T @ system.B)[:, 0]
    stiff = f**2 / abs(strength[rigid].sum())
    ends = [(1e-6 * stiff, 30.0 * stiff), (slowest, 1.5 * f), (slowest, 3.0 * f),
            (0.3 * f, 300.0 * f), (0.3 * f, 300.0 * f)]  # fmt: skip
    low, high = np.log(np.array(ends).T)
    return Loop(omega, zeta, np.tile(strength, (len(shifts), 1)), bounds, low, high, f)


def controller(kappa: np.ndarray, s: np.ndarray) -> np.ndarray:
    """K (N, F) over its gain, of ln(k, ω_i, z, p, r) (N, 5)."""
    _, i, z, p, r = np.exp(kappa.T)[:, :, None]
    return np.asarray((1.0 + i / s) * (1.0 + s / z) / (1.0 + s / p) / (1.0 + s / r))


@dataclass(frozen=True)
class Table:
    """What is evaluated once: frequencies, G and the bounds on |1 + L|² that do not know K."""

    loop: Loop
    w: np.ndarray
    G: np.ndarray
    least: np.ndarray
    weight: np.ndarray | None
    weight_T: np.ndarray | None

    @staticmethod
    def of(loop: Loop, w: np.ndarray) -> "Table":
        b, G = loop.bounds, loop.response(w)
        least = np.full(G.shape, 1.0 / b.S_max**2)
        least[:, w == b.omega_low] = np.maximum(1.0 / b.S_max**2, 1.0 / b.S_low**2)
        if b.compliance_max is not None:
            least = np.maximum(least, np.abs(G / b.compliance_max) ** 2)
        weight = weight_T = None
        if b.weighted_level is not None and b.weights is not None:
            s, v = 1j * w, b.weights
            W_KS = v.c_K / v.M_K * (s + v.omega_K) / (s + v.c_K * v.omega_K)
            W_T = (s + v.omega_T / v.A_l) / (s + v.omega_T / v.A_u) / v.A_u
            weight, weight_T = (np.abs(W / b.weighted_level) ** 2 for W in (W_KS, W_T))
        return Table(loop, w, G, least, weight, weight_T)

    def bandwidths(self, kappa: np.ndarray, gains: np.ndarray, slack: float = 0.0) -> np.ndarray:
        """ω_b (N, k) in rad/s with ln k of `gains` (N, k); -inf where a bound is passed.

        |1 + kL|² = 1 + 2k Re L + k²|L|²; stability is not looked at.
        """
        out = np.full(gains.shape, -np.inf)
        for part in np.array_split(np.arange(len(kappa)), max(1, len(kappa) // 50)):
            C = controller(kappa[part], 1j * self.w[None])
            L = C[:, None] * self.G[None]
            a, b = 2.0 * L.real, np.abs(L) ** 2
            heavy = None
            if self.weight is not None and self.weight_T is not None:
                size = (np.abs(C) ** 2 * self.weight)[:, None]
                heavy = np.maximum(size, b * self.weight_T)
            for j in range(gains.shape[1]):
                k = np.exp(gains[part, j])[:, None, None]
                m = 1.0 + k * (a + k * b)
                good = (m * (1.0 + slack) ** 2 >= self.least).all((1, 2))
                if heavy is not None:
                    good &= (m * (1.0 + slack) ** 2 >= k * k * heavy).all((1, 2))
                if good.any():
                    out[part[good], j] = self._bandwidth(m[good].min(1))
        return out

    def _bandwidth(self, m: np.ndarray) -> np.ndarray:
        """The largest ω_b with |S|² <= 1/2 below it and within the shape, m = 1/|S|² (N, F)."""
        w, shape = self.w, self.loop.bounds.shape
        room = np.full(m.shape, np.inf)
        if shape is not None:
            room = np.minimum.accumulate(shape * w * np.sqrt(0.5 * m), axis=1)
            if self.loop.bounds.shape_ends is ShapeEnd.S_MAX:
                s = np.sqrt(2.0 / m)  # shape x - (shape - 1)/x above ω_b, and x below
                above = 0.5 * (s + np.sqrt(s * s + 4.0 * shape * (shape - 1.0))) / shape
                room[:] = (w / np.where(s < 1.0, s, above)).min(axis=1, keepdims=True)
        bad = (m < 2.0) | (room < w)
        i = np.argmax(bad, axis=1)
        rows = np.arange(len(m))
        before = np.maximum(i - 1, 0)
        share = (m[rows, before] - 2.0) / np.maximum(m[rows, before] - m[rows, i], 1e-300)
        crossing = w[before] * (w[i] / w[before]) ** np.clip(share, 0.0, 1.0)
        crossing = np.where(m[rows, i] < 2.0, crossing, w[i])
        found = np.minimum(crossing, np.maximum(room[rows, i], w[before]))
        return np.where(bad.any(1), np.where(i > 0, found, -np.inf), w[-1])


def poles(loop: Loop, kappa: np.ndarray) -> np.ndarray:
    """Closed-loop poles (P, n) of one controller ln(k, ω_i, z, p, r), time in 1/p."""
    k, i, z, p, r = np.exp(kappa)
    unit = p
    i, z, r, p = i / unit, z / unit, r / unit, 1.0
    den = np.polymul([1.0, 0.0], np.polymul([1.0 / p, 1.0], [1.0 / r, 1.0]))
    num = np.polymul([1.0, i], [1.0 / z, 1.0]) / den[0]
    den = den / den[0]
    n = 2 * loop.omega.shape[1]
    A = np.zeros((len(loop.omega), n + 3, n + 3))
    for row, (omega, zeta, strength) in enumerate(
        zip(loop.omega / unit, loop.zeta, loop.strength / unit**2, strict=True)
    ):
        size = np.sqrt(np.abs(strength) * k)
        for j, (o, ratio) in enumerate(zip(omega, zeta, strict=True)):
            A[row, 2 * j, 2 * j + 1] = o
            A[row, 2 * j + 1, 2 * j], A[row, 2 * j + 1, 2 * j + 1] = -o, -2.0 * ratio * o
            A[row, 2 * j + 1, n:] = size[j] * num[::-1]  # u = k num/den e
            A[row, n + 2, 2 * j] = -np.sign(strength[j]) * size[j] / o  # e = -y
        A[row, n, n + 1] = A[row, n + 1, n + 2] = 1.0
        A[row, n + 2, n:] = -den[:0:-1]
    return np.asarray(np.linalg.eigvals(A) * unit)


def near(found: np.ndarray, count: int) -> np.ndarray:
    """Frequencies around poles."""
    side = np.geomspace(0.02, 20.0, count // 2)
    steps, found = np.concatenate([-side, [0.0], side]), found.ravel()
    w = (np.abs(found.imag)[:, None] + np.abs(found.real)[:, None] * steps).ravel()
    return np.asarray(w[w > 0.0])


def judged(loop: Loop, kappa: np.ndarray) -> tuple[float, float]:
    """(ω_b in rad/s, the largest figure over its bound) of one controller, on dense frequencies."""
    found = poles(loop, kappa).ravel()
    if not (found.real < 0.0).all():
        return -np.inf, np.inf
    dense = np.geomspace(0.1 * loop.bounds.omega_low, 30.0 * np.abs(found).max(), 20_000)
    table = Table.of(loop, loop.frequencies(np.concatenate([near(found, 60), dense])))
    gains = kappa[None, :1]
    low, high = 0.0, 1.0
    if np.isfinite(table.bandwidths(kappa[None], gains)[0, 0]):
        high = 0.0
    for _ in range(40 if high else 0):
        middle = 0.5 * (low + high)
        good = np.isfinite(table.bandwidths(kappa[None], gains, middle)[0, 0])
        low, high = (low, middle) if good else (middle, high)
    return float(table.bandwidths(kappa[None], gains, high)[0, 0]), 1.0 + high
