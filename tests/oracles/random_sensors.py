"""Random plants of several sensors on one actuator, judged by formulas that share no code.

`python benchmarks/oracle.py random_sensors --cases 30 [--first 0]` designs a controller for two
sensors of a random chain of masses, light and heavy, on the model and on both ends of a shift of
its resonances. Of each certified design |S| is then evaluated where the loop is broken at either
sensor and at the actuator, by S_i = (1 + L - L_i)/(1 + L) and S_u = 1/(1 + L) on a grid of its
own, the hold and the delay by matrix exponentials, stability by the eigenvalues of the whole.
Printed are the largest |S| over S_max and the bandwidth over the least that the grid has.
"""

import argparse
from time import perf_counter

import control
import numpy as np
from scipy.linalg import expm

import ccd_casadi as ccd
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    given_decoupling,
    sensors_on_one_actuator,
)
from ccd_casadi.support.text import HZ

Matrices = tuple[np.ndarray, np.ndarray, np.ndarray]


def chain(rng: np.random.Generator, shift: float, masses: np.ndarray, first_hz: float,
          stiff: np.ndarray, zeta: float, seen: list[int]) -> Matrices:  # fmt: skip
    """A, B, C of a free chain; all resonances off by `shift`."""
    n = len(masses)
    K = np.zeros((n, n))
    for i, k in enumerate(stiff):
        K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    root = 1.0 / np.sqrt(masses)
    squares, V = np.linalg.eigh(root[:, None] * K * root)
    squares = np.where(np.arange(n) == 0, 0.0, squares)
    omega = np.sqrt(np.maximum(squares, 0.0))
    omega *= HZ * first_hz / omega[1] * (1.0 + shift)
    drive, reading = (root[:, None] * V)[0], (root[:, None] * V)[seen]
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:], A[n:, :n] = np.eye(n), -np.diag(omega**2)
    A[n:, n:] = -np.diag(2.0 * zeta * omega)
    return A, np.append(np.zeros(n), drive)[:, None], np.hstack([reading, np.zeros_like(reading)])


def largest(plant: Matrices, K: object, period: float | None, delay: float) -> tuple[float, float]:
    """The largest |S| of all places, and the first -3 dB of S of the second sensor in rad/s;
    infinite where the loop is not stable."""
    A, B, C = plant
    a, b, c, d = (np.asarray(getattr(K, name), float) for name in "ABCD")
    n, m = len(A), len(a)
    if period is None:
        whole = np.block([[A - B @ d @ C, B @ c], [-b @ C, a]])
        if np.linalg.eigvals(whole).real.max() >= 0.0:
            return np.inf, 0.0
        s = 1j * np.geomspace(0.1, 1e6, 40_000)
        F, early, late, steps = A, B, 0.0 * B, 0
        omega, z = s.imag, np.ones_like(s)
    else:
        half = np.linalg.inv(np.eye(m) - 0.5 * period * a)
        a, b, c, d = (half @ (np.eye(m) + 0.5 * period * a), half @ b * period, c @ half,
                      d + 0.5 * period * c @ half @ b)  # fmt: skip
        steps = int(delay / period + 1e-9)
        rest = delay - steps * period

        def moved(t: float) -> np.ndarray:
            return expm(np.block([[A, B], [np.zeros((1, n + 1))]]) * t)

        F, early = moved(period)[:n, :n], moved(period - rest)[:n, n:]
        late = moved(period - rest)[:n, :n] @ moved(rest)[:n, n:]
        size = n + steps + 1 + m
        X = np.zeros((size, size))  # x, u of the last steps + 1 periods, K's state
        X[:n, :n], X[:n, n + steps : n + steps + 1] = F, late
        u = np.zeros((1, size))
        u[:, :n], u[:, n + steps + 1 :] = -d @ C, c
        X[:n] += early @ u if steps == 0 else 0.0
        if steps:
            X[:n, n + steps - 1 : n + steps] += early
        X[n] = u
        for j in range(1, steps + 1):
            X[n + j, n + j - 1] = 1.0
        X[n + steps + 1 :, :n], X[n + steps + 1 :, n + steps + 1 :] = -b @ C, a
        if np.abs(np.linalg.eigvals(X)).max() >= 1.0:
            return np.inf, 0.0
        omega = np.geomspace(0.1, 0.9999 * np.pi / period, 40_000)
        s = z = np.exp(1j * omega * period)
    one, own = np.eye(n), np.eye(m)
    G = np.array([
        (C @ np.linalg.solve(x * one - F, early * q**-steps + late * q ** -(steps + 1)))[:, 0]
        for x, q in zip(s, z, strict=True)
    ])  # fmt: skip
    gains = np.array([(c @ np.linalg.solve(x * own - a, b) + d)[0] for x in s])
    L = G * gains
    D = 1.0 + L.sum(axis=1)
    S = np.abs(np.column_stack([(D - L[:, 0]) / D, (D - L[:, 1]) / D, 1.0 / D]))
    past = np.flatnonzero(S[:, 1] > np.sqrt(0.5))
    return float(S.max()), float(omega[past[0]]) if len(past) else np.inf


def run(seed: int) -> dict[str, object]:
    """One random case."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 4))
    masses, stiff = np.exp(rng.normal(0.0, 0.7, n)), np.exp(rng.normal(0.0, 0.5, n - 1))
    first, zeta = float(rng.uniform(40.0, 200.0)), float(rng.uniform(0.005, 0.04))
    seen = [0, int(rng.integers(1, n))]
    off = float(rng.uniform(0.0, 0.05))
    parts = (masses, first, stiff, zeta, seen)
    plants = [chain(rng, shift, *parts) for shift in (0.0, -off, off)]
    period = None if rng.random() < 0.3 else 1.0 / float(rng.uniform(20.0, 60.0) * first)
    late_us = 0.0 if period is None else float(1e6 * period * rng.uniform(0.2, 2.0))
    sampling = None if period is None else ccd.Sampling(1.0 / period, late_us)
    S_max = float(rng.uniform(1.6, 2.4))
    sensors = given_decoupling(("a", "b"), [[1, 0], [0, 1]], [[1], [1]])
    lead, biquads = int(rng.integers(1, 3)), int(rng.integers(1, 3))
    usual = {"lead": lead, "biquads": biquads, "roll_off": 1, "least_damping": 0.1}
    structure = ChannelStructure(
        sensors, (ccd.Structure(integrator=False, **usual), ccd.Structure(**usual))
    )
    bounds = Bounds(S_max=S_max, S_low=0.1, omega_low=0.02 * HZ * first, shape=1.1, error=1,
                    channels=sensors_on_one_actuator(sensors, S_max))  # fmt: skip
    began = perf_counter()
    systems = [control.ss(A, B, C, np.zeros((2, 1))) for A, B, C in plants]
    made = ccd.synthesise_sections(systems, structure, bounds, sampling=sampling, starts=4,
                                   M_K=float(masses.sum()) * (HZ * 0.3 * first) ** 2)  # fmt: skip
    found: dict[str, object] = {"seed": seed, "outcome": made.outcome.name,
                                "hz": made.bandwidth / HZ, "first": first,
                                "seconds": round(perf_counter() - began, 1)}  # fmt: skip
    if made.certified:
        delay = 0.0 if sampling is None else sampling.delay
        peaks, crossings = zip(*(largest(one, made.controller, period, delay) for one in plants),
                               strict=True)  # fmt: skip
        found |= {"S_over_S_max": max(peaks) / S_max,
                  "bandwidth_over_crossing": made.bandwidth / min(crossings)}  # fmt: skip
    return found


def main() -> None:
    """All cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=30)
    parser.add_argument("--first", type=int, default=0)
    required = parser.parse_args()
    found = []
    for seed in range(required.first, required.first + required.cases):
        found.append(run(seed))
        print(found[-1], flush=True)
    kept = [one for one in found if "S_over_S_max" in one]
    print(f"{len(kept)} of {len(found)} certified; largest |S| over S_max "
          f"{max(one['S_over_S_max'] for one in kept):.7f}, bandwidth over crossing "
          f"{max(one['bandwidth_over_crossing'] for one in kept):.7f}")  # fmt: skip


if __name__ == "__main__":
    main()
