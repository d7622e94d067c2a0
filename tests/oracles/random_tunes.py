"""Random plants of one input and one output for `tune`, judged by formulas that share no code.

`python benchmarks/oracle.py random_tunes --cases 300 [--first 0] [--starts 2]` tunes a controller
for free masses, sprung masses, a lag and three lags, with up to three light modes of either sign,
at a random rate and delay. Of each usable design the sampled loop is then built by matrix
exponentials: its poles, and |S| on a grid of its own that is dense about the plant's resonances.
Printed are the largest |S| over S_max, the bandwidth over the first -3 dB of S, and the words of
each design that is not usable.
"""

import argparse
from dataclasses import dataclass
from time import perf_counter

import control
import numpy as np
from scipy.linalg import expm

import ccd_casadi as ccd
from ccd_casadi.support.text import HZ

S_MAX = 1.8


@dataclass(frozen=True)
class Drawn:
    """A continuous plant; its rate in Hz and its delay in s."""

    plant: control.TransferFunction
    rate: float
    delay: float


def drawn(seed: int) -> Drawn:
    """A random plant."""
    rng = np.random.default_rng(seed)
    s = control.tf("s")
    first, modes = HZ * 10.0 ** rng.uniform(0.0, 1.5), int(rng.integers(0, 4))
    kind = rng.choice(["free", "sprung", "lag", "three lags"])
    size = 10.0 ** rng.uniform(-1.0, 1.0)
    if kind == "free":
        G = size / s**2
    elif kind == "sprung":
        zeta = 10.0 ** rng.uniform(-2.5, -0.3)
        G = size / (s**2 + 2.0 * zeta * first * s + first**2)
    else:
        G = size / (s / first + 1.0) ** (1 if kind == "lag" else 3)
    if kind in ("free", "sprung"):
        for _ in range(modes):
            omega, zeta = first * 10.0 ** rng.uniform(0.7, 2.0), 10.0 ** rng.uniform(-3.0, -1.3)
            share = rng.uniform(0.1, 1.0) * rng.choice([-1.0, 1.0])
            G = G + share * size / (s**2 + 2.0 * zeta * omega * s + omega**2)
    rate = first / HZ * 10.0 ** rng.uniform(1.5, 2.7)
    return Drawn(G, rate, float(rng.choice([0.0, 0.5, 1.0, 2.0])) / rate)


def held(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, T: float, delay: float
) -> tuple[np.ndarray, ...]:
    """F, B, C of the plant behind a hold and a delay; forces that wait are states."""
    n = len(A)
    steps = int(delay / T + 1e-9)
    rest = delay - steps * T

    def moved(t: float) -> np.ndarray:
        return expm(np.block([[A, B], [np.zeros((1, n + 1))]]) * t)

    early = moved(T - rest)[:n, n:]  # of the force of `steps` periods ago
    late = moved(T - rest)[:n, :n] @ moved(rest)[:n, n:]  # of the one before
    F, enter = np.zeros((n + steps + 1, n + steps + 1)), np.zeros((n + steps + 1, 1))
    F[:n, :n] = moved(T)[:n, :n]
    F[:n, n + steps :] = late
    if steps:
        F[:n, n + steps - 1 : n + steps] = early
    else:
        enter[:n] = early
    F[range(n + 1, n + steps + 1), range(n, n + steps)] = 1.0
    enter[n] = 1.0
    return F, enter, np.hstack([C, np.zeros((1, steps + 1))])


def judged(one: Drawn, K: object) -> tuple[float, float]:
    """Largest |S| and the first -3 dB crossing in rad/s; infinite and 0 where it is unstable."""
    T = 1.0 / one.rate
    G = control.ss(one.plant)
    F, B, C = held(G.A, G.B, G.C, T, one.delay)
    a, b, c, d = (np.asarray(getattr(K, name), float) for name in "ABCD")
    half = np.linalg.inv(np.eye(len(a)) - 0.5 * T * a)
    a, b, c, d = (
        half @ (np.eye(len(a)) + 0.5 * T * a),
        T * half @ b,
        c @ half,
        d + 0.5 * T * c @ half @ b,
    )
    whole = np.block([[F - B @ d @ C, B @ c], [-b @ C, a]])
    if np.abs(np.linalg.eigvals(whole)).max() >= 1.0:
        return np.inf, 0.0
    top = np.pi / T
    poles = np.linalg.eigvals(G.A)
    poles = poles[np.abs(poles) > 1e-6 * top]
    steps = np.concatenate([-np.geomspace(1e-3, 3.0, 60)[::-1], [0.0], np.geomspace(1e-3, 3.0, 60)])
    near = np.abs(poles.imag)[:, None] + np.abs(poles.real)[:, None] * 30.0 * steps
    folded = np.abs(near - 2.0 * top * np.round(near / (2.0 * top)))
    slow = 1e-3 * min(np.abs(poles).min(initial=top), top)
    omega = np.unique(np.concatenate([np.geomspace(slow, top, 20_000), folded.ravel()]))
    omega = omega[(omega >= slow) & (omega < top)]
    z = np.exp(1j * omega * T)[:, None, None]
    L = (C @ np.linalg.solve(z * np.eye(len(F)) - F, B.astype(complex)))[:, 0, 0]
    L = L * (c @ np.linalg.solve(z * np.eye(len(a)) - a, b.astype(complex)) + d)[:, 0, 0]
    S = 1.0 / np.abs(1.0 + L)
    past = np.flatnonzero(np.sqrt(0.5) < S)
    return float(S.max()), float(omega[past[0]]) if len(past) else np.inf


def run(seed: int, starts: int) -> dict[str, object]:
    """One random case."""
    one, began = drawn(seed), perf_counter()
    made = ccd.tune(one.plant, rate_hz=one.rate, delay=one.delay, S_max=S_MAX, starts=starts)
    found: dict[str, object] = {"seed": seed, "usable": made.design.usable,
                                "hz": made.design.bandwidth / HZ,
                                "seconds": round(perf_counter() - began, 1)}  # fmt: skip
    if not made.design.usable:
        return found | {"words": made.design.words}
    peak, crossing = judged(one, made.controller)
    return found | {"S_over_S_max": peak / S_MAX,
                    "bandwidth_over_crossing": made.design.bandwidth / crossing}  # fmt: skip


def main() -> None:
    """All cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--starts", type=int, default=2)
    required = parser.parse_args()
    found = []
    for seed in range(required.first, required.first + required.cases):
        found.append(run(seed, required.starts))
        print(found[-1], flush=True)
    usable = [one for one in found if one["usable"]]
    print(f"{len(usable)} of {len(found)} usable; largest |S| over S_max "
          f"{max(one['S_over_S_max'] for one in usable):.7f}, bandwidth over crossing "
          f"{max(one['bandwidth_over_crossing'] for one in usable):.7f}")  # fmt: skip


if __name__ == "__main__":
    main()
