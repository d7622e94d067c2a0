"""A run folder judged without the package: NumPy and SciPy on the files that a solve wrote.

The plant is a free chain of masses and springs from its own numbers, the loop from controller.json,
with hold and delay by matrix exponentials where it is sampled. Stability is by eigenvalues, a peak
of |S| by a grid through every pole of plant, controller and loop, closed in on by SciPy.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import mpmath
import numpy as np
from scipy.linalg import block_diag, expm
from scipy.optimize import brentq, minimize_scalar

HZ = 2.0 * np.pi
CLOSE = 2e-6  # relative: of a figure against the same found here
LOOSE = 2.1e-4  # relative: by how much sections may exceed a bound, which their page says
NEAR = 2e-3  # of a range: how near to its end it is looked at


@dataclass(frozen=True)
class Chain:
    """Masses a_i p, springs b_i q between them and `ground` under the first, every flexible mode of
    damping ratio zeta; force on the first, sensor on one."""

    mass: np.ndarray
    spring: np.ndarray
    zeta: float
    sensor: int
    ground: float = 0.0

    def at(
        self, p: float, q: float, shift: float = 0.0, factor: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(A, b, c), flexible frequencies times 1 + shift, damping ratios times the factor."""
        n, mass = len(self.mass), self.mass * p
        K = np.zeros((n, n))
        for i, k in enumerate(self.spring * q):
            K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
        K[0, 0] += self.ground
        lam, modes = _modes(mass, K)
        omega = np.sqrt(np.maximum(lam, 0.0)) * (1.0 + shift)
        zeta = np.full(n, self.zeta * factor)
        if not self.ground:
            omega[0] = 0.0  # a free chain stays free
        A = np.block(
            [[np.zeros((n, n)), np.eye(n)], [-np.diag(omega**2), -np.diag(2.0 * zeta * omega)]]
        )
        zero = np.zeros(n)
        return (A, np.concatenate([zero, modes[0]]), np.concatenate([modes[self.sensor], zero]))


def _modes(mass: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared frequencies, ascending, and mass-normalised shapes, in forty digits: a stiff link
    takes the soft modes' digits from double precision."""
    with mpmath.workdps(40):
        root = [mpmath.sqrt(m) for m in mass]
        n = len(mass)
        scaled = mpmath.matrix(n, n)
        for i in range(n):
            for j in range(n):
                scaled[i, j] = mpmath.mpf(K[i, j]) / (root[i] * root[j])
        lam, shapes = mpmath.eigsy(scaled)
        order = sorted(range(n), key=lambda i: lam[i])
        modes = [[shapes[i, j] / root[i] for j in order] for i in range(n)]
        found = [float(lam[j]) for j in order]
        return np.array(found), np.array([[float(x) for x in row] for row in modes])


class Loop:
    """1/(1 + GK) of one plant and controller, continuous or with hold, delay and bilinear K."""

    def __init__(
        self, plant: tuple[np.ndarray, ...], data: Mapping[str, Any], loop: Mapping[str, float]
    ) -> None:
        A, b, c = plant
        a, k_b, k_c, k_d = (np.array(data[name], float) for name in "ABCD")
        k_b, k_c, k_d = k_b[:, 0], k_c[0], float(k_d[0, 0])
        self.period = 1.0 / loop["rate_hz"] if loop else 0.0
        near = np.concatenate([np.linalg.eigvals(A), np.linalg.eigvals(a)])
        if self.period:
            A, b, c = held(A, b, c, self.period, 1e-6 * loop.get("delay_us", 0.0))
            inverse = np.linalg.inv(np.eye(len(a)) - 0.5 * self.period * a)
            k_d += 0.5 * self.period * k_c @ inverse @ k_b
            a = inverse @ (np.eye(len(a)) + 0.5 * self.period * a)
            k_b, k_c = inverse @ k_b * self.period, k_c @ inverse
        self.plant, self.controller = (A, b, c, 0.0), (a, k_b, k_c, k_d)
        closed = np.block([[A - np.outer(b, c) * k_d, np.outer(b, k_c)], [-np.outer(k_b, c), a]])
        poles = np.linalg.eigvals(closed)
        self.stable = bool((np.abs(poles) < 1.0 if self.period else poles.real < 0.0).all())
        if self.period:
            poles = np.log(poles[np.abs(poles) > 1e-9] + 0j) / self.period
        near = np.concatenate([near, poles])
        steps = np.concatenate([-np.geomspace(1e-3, 30.0, 40), [0.0], np.geomspace(1e-3, 30.0, 40)])
        top = np.pi / self.period if self.period else 1e3 * np.abs(near).max()
        grid = [np.geomspace(1e-4 * HZ, top, 2500)]
        grid += [np.abs(p.imag) + np.abs(p.real) * steps for p in near]
        w = np.unique(np.concatenate(grid))
        w = w[(w > 1e-4 * HZ) & (w <= top)]
        self.grid = w[np.append(True, np.diff(w) > 1e-6 * w[1:])]  # apart by more than rounding

    def responses(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """G and K at these frequencies, in rad/s."""
        s = np.exp(1j * omega * self.period) if self.period else 1j * omega
        found = []
        for A, b, c, d in (self.plant, self.controller):
            x = np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, b[:, None] + 0j)[..., 0]
            found.append(x @ c + d)
        return found[0], found[1]

    def gain(self, omega: np.ndarray) -> np.ndarray:
        """|S|."""
        G, K = self.responses(np.atleast_1d(omega))
        return np.abs(1.0 / (1.0 + G * K))

    def peak(self) -> float:
        """‖S‖∞: the highest local maxima of the grid, each climbed."""
        w = self.grid
        found = self.gain(w)
        inside = np.flatnonzero((found[1:-1] >= found[:-2]) & (found[1:-1] >= found[2:])) + 1
        best = float(found.max())
        for i in inside[found[inside] > 0.9 * best]:
            ends, options = (w[i - 1], w[i + 1]), {"xatol": 1e-10 * w[i]}
            climbed = minimize_scalar(
                lambda x: -self.gain(x)[0], bounds=ends, method="bounded", options=options
            )
            best = max(best, -float(climbed.fun))
        return best

    def bandwidth(self, slack: float) -> float:
        """The first frequency where |S| rises through -3 dB and that much, rad/s; 0 for none."""
        level = (1.0 + slack) * np.sqrt(0.5)
        over = np.flatnonzero(self.gain(self.grid) > level)
        if not over.size or not over[0]:
            return 0.0
        a, b = self.grid[over[0] - 1], self.grid[over[0]]
        return float(brentq(lambda x: self.gain(x)[0] - level, a, b, rtol=1e-12))


def held(
    A: np.ndarray, b: np.ndarray, c: np.ndarray, T: float, delay: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The plant from instant to instant; forces on their way are states, the newest first."""
    n, age = len(A), int(np.ceil(delay / T - 1e-9))
    h = T * age - delay  # how long a period sees the newer of two forces

    def driven(t: float) -> np.ndarray:
        return np.asarray(expm(np.block([[A, b[:, None]], [np.zeros((1, n + 1))]]) * t)[:n, n])

    newer = driven(h)
    older = expm(A * h) @ driven(T - h)
    if not age:
        return expm(A * T), older + newer, c
    line = np.diag(np.ones(age - 1), -1) if age > 1 else np.zeros((1, 1))
    whole = block_diag(expm(A * T), line)
    whole[:n, n + age - 1] = older
    drive = np.zeros(n + age)
    drive[n] = 1.0
    if age > 1:
        whole[:n, n + age - 2] = newer
    else:
        drive[:n] = newer
    return whole, drive, np.concatenate([c, np.zeros(age)])


def wrong(
    chain: Chain, case: Mapping[str, Any], result: Mapping[str, Any], data: Mapping[str, Any]
) -> list[str]:
    """Every claim of the run that does not hold, in words; empty where all do."""
    return [words for holds, words in _claims(chain, case, result, data) if not holds]


def _claims(
    chain: Chain, case: Mapping[str, Any], r: Mapping[str, Any], data: Mapping[str, Any]
) -> Iterator[tuple[bool, str]]:
    theta, inner, loop = r["theta"], case["inner"], case.get("loop", {})
    sections = case["controller"]["structure"] == "sections"
    slack = LOOSE if sections else CLOSE
    at = (theta["p"], theta.get("q", theta["p"] ** case["plant"]["power"]))
    for name, value in theta.items():
        low, high = case["theta"][name]["lower"], case["theta"][name]["upper"]
        width = 1e-9 * (high - low)
        yield low - width <= value <= high + width, f"{name} outside of its bounds"
    limit, claimed = case["plant"]["mass_limit"], r["checks"]["constraints"] is not False
    met = float(chain.mass.sum() * at[0]) <= limit * (1.0 + CLOSE)
    yield met or not claimed, "the constraint is not met"

    def of(shift: float = 0.0, factor: float = 1.0) -> Loop:
        return Loop(chain.at(*at, shift, factor), data, loop)

    model, robust = of(), case.get("robust", {})
    reach, factors = robust.get("resonance_shift", 0.0), (1.0, *robust.get("damping", ()))
    shifts = np.linspace(-reach, reach, 41 if sections else robust.get("shifts", 5))
    loops = [of(s, z) for s in (shifts if reach else [0.0]) for z in factors] if robust else [model]
    certain = r["verdict"]["certified"]["state"] != "failed"
    kept = r["verdict"]["survives"]["state"] != "failed"
    yield model.stable or not certain, "unstable"
    if not certain or not model.stable:
        return
    if kept:
        yield all(each.stable for each in loops), "unstable on the set"
        worst = max(each.peak() for each in loops if each.stable)
        yield worst <= inner["S_max"] * (1.0 + slack), f"peak of S {worst:.8g} on the set"
        yield worst <= r["sensitivity_peak"] * (1.0 + slack), f"peak of S {worst:.8g} untold"
    slowest = HZ * r["bandwidth_hz"]
    everywhere = loops if sections else [model]  # full order: only S_max holds on the set
    if kept:
        least = min(each.bandwidth(slack) for each in everywhere)
        yield least >= slowest * (1.0 - CLOSE), f"bandwidth is {least / HZ:.8g} Hz"
    if not robust:
        peak, most = model.peak(), model.bandwidth(-slack)
        yield abs(peak / r["sensitivity_peak"] - 1.0) <= CLOSE, f"peak of S is {peak:.8g}"
        reported = sections or most <= slowest * (1.0 + CLOSE)  # a shape may bind below -3 dB
        yield reported, f"bandwidth is more than told: {most / HZ:.8g} Hz"
    low = max(float(each.gain(HZ * inner["omega_low_hz"])[0]) for each in everywhere)
    yield low <= inner["S_low"] * (1.0 + slack), f"|S| at omega_low {low:.6g}"
    if "compliance_max" in inner and not loop:
        G, K = model.responses(model.grid)
        most = float(np.abs(G / (1.0 + G * K)).max())
        yield most <= inner["compliance_max"] * (1.0 + slack), f"compliance {most:.6g}"
    yield from _ranges(of, r["verdict"]["survives"], inner["S_max"], slack)


def _ranges(
    of: Callable[[float, float], Loop], line: Mapping[str, Any], S_max: float, slack: float
) -> Iterator[tuple[bool, str]]:
    """Within a range the loop keeps what it says, beyond its end it does not."""

    slack = line.get("S_max_shift_slack", slack)

    def keeps(off: Loop, share: float) -> bool:
        return off.stable and off.peak() <= S_max * (1.0 + share * slack)

    for what, most, holds in (
        ("stable_shift", (-0.5, 0.5), lambda x, share: of(x, 1.0).stable),
        ("S_max_shift", (-0.5, 0.5), lambda x, share: keeps(of(x, 1.0), share)),
        ("stable_damping", (-0.9, 9.0), lambda x, share: of(0.0, 1.0 + x).stable),
    ):
        for reported, furthest in zip(line.get(what, ()), most, strict=False):
            end = reported - (what == "stable_damping")
            inside = [x for x in np.linspace(0.0, (1.0 - NEAR) * end, 25) if not holds(x, 1.0)]
            yield not inside, f"{what} to {reported:.5g}, not so at {inside[:1]}"
            beyond = (1.0 + NEAR) * end + 1e-5 * np.sign(furthest)
            followed = abs(end) >= abs(furthest) * (1.0 - 1e-9)
            yield followed or not holds(beyond, 0.4), f"{what} to {reported:.5g}, further in truth"
