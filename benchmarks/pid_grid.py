"""PID by the package's search beside dense grids over its parameters, on five plants.

    OPENBLAS_NUM_THREADS=1 python benchmarks/pid_grid.py [NAME ...] [--write]

    K(s) = k (1 + ω_i/s) (1 + s/z)/(1 + s/p) / (1 + s/r)

The grid shares nothing with the package but the plants' matrices: modes by SciPy, |S|² and the
rest on dense frequencies, stability by eigenvalues of a loop that is built here. Over
ln(ω_i, z, p, r) it is dense in the whole box, with 36 gains at every point; from its best points
that lie far apart it is refined by samples around the best of the samples before (their mean and
covariance, since the best lies in a narrow valley between bounds), with gains around theirs. Until
half way bounds may be passed, ever less. What the search finds is judged here as well. `--write`
keeps the results in benchmarks/pid_grid.json.
"""

import argparse
import importlib.util
import itertools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import eigh

from ccd_casadi.fixed_structure import Bounds, Structure, synthesise_sections
from ccd_casadi.plants.modal import Perturbation, Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics, build_plant, mechanics
from ccd_casadi.plants.registry import MODELS
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.synthesis.weights import Weights

HZ = 2.0 * np.pi
RESULTS = Path(__file__).with_suffix(".json")
PID = Structure(integrator=True, lead=1, biquads=0, roll_off=1)
COARSE = (8, 12, 10, 8)  # points of ln ω_i, z, p, r
GAINS, LOCAL_GAINS = 36, 15
BASINS, APART = 4, 0.8  # starts of a refinement, and by how much they differ in a logarithm
SAMPLES, BEST, ROUNDS, SLACK = 250, 25, 28, 14  # in SLACK rounds bounds may be passed, ever less


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
        """The largest ω_b with |S|² <= min(1, (shape ω/ω_b)²)/2 below it, m = 1/|S|² (N, F)."""
        w, shape = self.w, self.loop.bounds.shape
        room = np.full(m.shape, np.inf)
        if shape is not None:
            room = np.minimum.accumulate(shape * w * np.sqrt(0.5 * m), axis=1)
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


def refined(loop: Loop) -> tuple[float, np.ndarray, int]:
    """The grid's best ω_b in rad/s, its κ, and how many controllers were looked at."""
    table = Table.of(loop, loop.frequencies())
    low, high = loop.low, loop.high
    axes = [np.linspace(low[i + 1], high[i + 1], count) for i, count in enumerate(COARSE)]
    shapes = np.array([(0.0, *row) for row in itertools.product(*axes)])
    shapes = shapes[shapes[:, 3] <= shapes[:, 4]]  # p and r change places without a change of K
    # Gains that bring |K| to the same range at one frequency, however slow the zeros are.
    size = np.log(np.abs(controller(shapes, np.array([[1j * loop.crossover]]))))
    gains = np.clip(np.linspace(high[0] - np.log(1e3), high[0], GAINS) - size, low[0], high[0])
    # Between the points of a grid bounds are passed by little: these too are worth refining.
    value = table.bandwidths(shapes, gains, slack=0.15)
    looked = value.size
    starts: list[np.ndarray] = []
    for flat in np.argsort(-value, axis=None):
        row, j = np.unravel_index(flat, value.shape)
        if not np.isfinite(value[row, j]) or len(starts) == BASINS:
            break
        kappa = shapes[row].copy()
        kappa[0] = gains[row, j]
        far = all(np.abs(kappa - other).max() > APART for other in starts)
        if far and (poles(loop, kappa).real < 0.0).all():
            starts.append(kappa)
    best, where = -np.inf, np.full(5, np.nan)
    spacing = np.array([np.log(1e3) / GAINS, *(axis[1] - axis[0] for axis in axes)])
    for number, start in enumerate(starts):
        rng = np.random.default_rng(number)
        mean, cov, own, at = start, np.diag(spacing**2), -np.inf, start
        fine, seen = table, np.geomspace(0.3, 30.0, 400) * loop.crossover
        for turn in range(ROUNDS):
            if turn >= SLACK and (turn - SLACK) % 5 == 0:  # as the judge will see these loops
                seen = np.concatenate([seen, near(poles(loop, mean), 40)])
                fine = Table.of(loop, loop.frequencies(seen))
            kappa = rng.multivariate_normal(mean, cov, SAMPLES)
            kappa = np.clip(np.vstack([mean, at, kappa]), low, high)
            wide = max(2.0 * float(np.sqrt(cov[0, 0])), 1e-5)
            local = np.clip(kappa[:, :1] + np.linspace(-wide, wide, LOCAL_GAINS), low[0], high[0])
            slack = 0.15 * 0.6**turn if turn < SLACK else 0.0
            value = fine.bandwidths(kappa, local, slack)
            looked += value.size
            top = np.argmax(value, axis=1)
            kappa[:, 0] = local[np.arange(len(kappa)), top]
            value = value[np.arange(len(kappa)), top]
            chosen = []
            for row in np.argsort(-value):
                if len(chosen) == BEST or not np.isfinite(value[row]):
                    break
                if (poles(loop, kappa[row]).real < 0.0).all():
                    chosen.append(row)
            if not chosen:
                cov = 0.25 * cov
                continue
            if slack == 0.0 and value[chosen[0]] > own:
                own, at = float(value[chosen[0]]), kappa[chosen[0]]
            mean = kappa[chosen].mean(0)
            spread = kappa[chosen] - mean
            cov = 1.5 * spread.T @ spread / len(chosen) + 1e-14 * np.eye(5)
        if own > best:
            best, where = own, at
    return best, where, looked


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


def example(name: str, function: str) -> Callable[..., Any]:
    """A plant function of one of the examples."""
    path = Path(__file__).parents[1] / "examples" / name / "plant.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: Callable[..., Any] = getattr(module, function)
    return found


def tutorial(theta: dict[str, Any]) -> dict[str, Any]:
    """The stage of docs/tutorial.md; rib and plate in mm."""
    ribs = 0.05 * theta["rib"]
    table, chuck = 2.0 + 0.4 * theta["plate"] + 0.5 * ribs, 1.5 + 0.5 * ribs
    return {
        "mass": ca.diag(ca.vertcat(table, chuck)),
        "stiffness": 2.0e6 * (theta["rib"] / 10.0) ** 3 * ca.DM([[1, -1], [-1, 1]]),
        "damping_ratio": 0.01,
        "input": ca.DM([1, 0]),
        "output": ca.DM([[0.3, 0.7]]),
        "hardware_cost": table + chuck,
    }


def acc(theta: dict[str, Any]) -> dict[str, Any]:
    """Two masses of 1 kg and a spring of k N/m, force on one and sensor on the other (ACC 1990)."""
    return {
        "mass": ca.DM.eye(2),
        "stiffness": theta["k"] * ca.DM([[1, -1], [-1, 1]]),
        "damping_ratio": 0.01,
        "input": ca.DM([1, 0]),
        "output": ca.DM([[0, 1]]),
        "hardware_cost": theta["k"],
    }


def weights(M_K: float, omega_K_hz: float) -> Weights:
    return Weights(M_S=2.0, A_S=1e-4, omega_S=800.0 * HZ, c_K=1e4, omega_K=omega_K_hz * HZ,
                   M_K=M_K, A_l=1.0, A_u=1e-2, omega_T=25.0 * HZ)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A plant and its bounds."""

    function: Callable[..., Any]
    theta: dict[str, float]
    options: dict[str, float]
    bounds: Bounds
    M_K: float
    expected_hz: float  # about: the boxes of the parameters lie around it
    shifts: tuple[float, ...] = (0.0,)
    suspended_hz: float = 0.1


CASES = {
    "two_mass (55, 55), +-3 %": Case(
        MODELS["two_mass"], {"m1": 55.0, "m2": 55.0}, {"zeta": 0.01},
        Bounds(1.75, 0.03, HZ, 1.1, 8.426, weights(2e7, 100.0)), 2e7, 25.0, (0.0, -0.03, 0.03),
    ),
    "tutorial stage, rib 19 mm": Case(
        tutorial, {"rib": 19.0, "plate": 6.0}, {},
        Bounds(2.0, 0.03, HZ, 1.1, 16.12, weights(2e6, 200.0)), 2e6, 60.0, (0.0, -0.05, 0.05),
    ),
    "guided beam, 30 mm": Case(
        example("guided_beam", "beam"), {"guide": 0.03, "tip": 0.03},
        {"zeta": 0.01, "volume": 0.3}, Bounds(2.0, 0.05, HZ, 1.1), 1e6, 60.0,
    ),
    "three-mass axis, not collocated": Case(
        example("three_mass_axis", "axis"), {"d": 5e-3, "b": 10e-3},
        {"zeta": 0.01, "least_tool_stiffness": 2e5},
        Bounds(2.0, 0.05, HZ, 1.2, compliance_max=2e-4), 1e5, 20.0,
    ),
    "ACC benchmark": Case(
        acc, {"k": 1.0}, {}, Bounds(2.0, 0.5, 0.001 * HZ, 1.2), 0.2, 0.01,
        suspended_hz=1e-5,
    ),
}  # fmt: skip


def compared(case: Case, seed: int) -> dict[str, Any]:
    """The search and the grid on one plant."""
    plant = build_plant(case.function, tuple(case.theta), case.options)
    system = mechanics(plant, np.array(list(case.theta.values())))
    suspension = Suspension(case.suspended_hz)
    begun = time.process_time()
    plants = [scale_plant(modal_plant(system, suspension, Perturbation(shift, 1.0)), case.M_K)
              for shift in case.shifts]  # fmt: skip
    made = synthesise_sections(plants, PID, case.bounds, seed=seed)
    spent = time.process_time() - begun
    loop = loop_of(system, suspension, case.shifts, case.bounds,
                   case.expected_hz * HZ, made.frequencies[0])  # fmt: skip
    begun = time.process_time()
    _, kappa, looked = refined(loop)
    grid, over = judged(loop, kappa)
    row: dict[str, Any] = {
        "grid_hz": grid / HZ, "grid_over_bound": over, "grid_kappa": np.exp(kappa).tolist(),
        "controllers": looked, "grid_seconds": time.process_time() - begun,
        "outcome": made.outcome.value, "search_seconds": spent,
    }  # fmt: skip
    if made.certified:
        own, over = judged(loop, np.asarray(made.kappa))
        row |= {"search_hz": made.bandwidth / HZ, "search_judged_hz": own / HZ,
                "search_over_bound": over, "search_kappa": np.exp(made.kappa).tolist(),
                "difference": made.bandwidth / grid - 1.0,
                "optima_hz": [[o.bandwidth / HZ, o.count] for o in made.local_optima]}  # fmt: skip
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="beginnings of plants' names; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    rows: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name, case in CASES.items():
        if options.names and not name.startswith(tuple(options.names)):
            continue
        rows[name] = row = compared(case, options.seed)
        print(f"{name:32s} search {row.get('search_hz', np.nan):.3f} Hz, grid "
              f"{row['grid_hz']:.3f} Hz of {row['controllers']} controllers, "
              f"{row.get('difference', np.nan):+.2%}", flush=True)  # fmt: skip
        print("   ", json.dumps(row), flush=True)
        if options.write:
            RESULTS.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
