"""`ccd.hinfsyn` beside SLICOT's SB10AD (`control.hinfsyn`) on random general plants.

    python benchmarks/oracle.py general_hinf [--cases 100] [--seconds 10]

Each runs in a process of its own, as SB10AD does not end on some plants. A level is held by a
controller whose gain, from the responses of P and K apart on a dense grid, is not above it.
"""

import argparse
import multiprocessing as mp
import time
import warnings

import control as ct
import numpy as np

import ccd_casadi as ccd


def plant(seed: int) -> tuple[ct.StateSpace, int, int]:
    """A random general plant, often unstable, with direct terms; numbers of y and u."""
    rng = np.random.default_rng(seed)
    n, m1, p1 = (int(k) for k in rng.integers(1, (7, 4, 4)))
    m2, p2 = int(rng.integers(1, min(2, p1) + 1)), int(rng.integers(1, min(2, m1) + 1))
    A = rng.normal(size=(n, n)) - rng.uniform(0.0, 2.0) * np.eye(n)
    B, C = rng.normal(size=(n, m1 + m2)), rng.normal(size=(p1 + p2, n))
    D = rng.normal(size=(p1 + p2, m1 + m2))
    if seed % 3 == 0:
        D[:p1, :m1] = 0.0
    if seed % 2:
        D[p1:, m1:] = 0.0
    return ct.ss(A, B, C, D), p2, m2


def loop_gains(
    P: ct.StateSpace, K: ct.StateSpace, p2: int, m2: int, omega: np.ndarray
) -> np.ndarray:
    """σ_max of w to z at ω from the responses of P and K."""
    p1, m1 = P.noutputs - p2, P.ninputs - m2
    found = []
    for w in omega:
        G, C = np.atleast_2d(P(1j * w)), np.atleast_2d(K(1j * w))
        inner = np.linalg.solve(np.eye(p2) - G[p1:, m1:] @ C, G[p1:, :m1])
        found.append(np.linalg.norm(G[:p1, :m1] + G[:p1, m1:] @ C @ inner, 2))
    return np.array(found)


def ours(seed: int) -> tuple[float, float, bool]:
    """γ_opt, γ, and whether the loop is stable with a gain that is not above it."""
    P, p2, m2 = plant(seed)
    made = ccd.hinfsyn(P, p2, m2)
    return made.certificate.gamma_opt, made.gamma, held(P, made.K, p2, m2, made.gamma)


def slicot(seed: int) -> tuple[float, float, bool]:
    P, p2, m2 = plant(seed)
    K, _, gamma, _ = ct.hinfsyn(P, p2, m2)
    return gamma, gamma, held(P, K, p2, m2, gamma * (1.0 + 1e-3))


def held(P: ct.StateSpace, K: ct.StateSpace, p2: int, m2: int, gamma: float) -> bool:
    gains = loop_gains(P, K, p2, m2, np.geomspace(1e-4, 1e5, 400))
    return bool(P.lft(K, m2, p2).poles().real.max(initial=-1.0) < 0.0 and gains.max() <= gamma)


def answer(kind: str, seed: int, pipe: "mp.connection.Connection") -> None:
    began = time.perf_counter()
    try:
        pipe.send(("", *{"ours": ours, "slicot": slicot}[kind](seed), time.perf_counter() - began))
    except Exception as error:  # what it says is what is counted
        pipe.send((type(error).__name__, np.nan, np.nan, False, time.perf_counter() - began))


def required(kind: str, seed: int, seconds: float) -> tuple[str, float, float, bool, float]:
    here, there = mp.Pipe()
    process = mp.get_context("fork").Process(target=answer, args=(kind, seed, there))
    process.start()
    found = here.recv() if here.poll(seconds) else ("no end", np.nan, np.nan, False, seconds)
    process.kill()
    process.join()
    return found  # type: ignore[no-any-return]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # of python-control, about what it calls itself
    rows = [(required("ours", seed, options.seconds), required("slicot", seed, options.seconds))
            for seed in range(options.cases)]  # fmt: skip
    for name, i in (("ours", 0), ("SB10AD", 1)):
        words = [row[i][0] for row in rows if row[i][0]]
        counted = {word: words.count(word) for word in sorted(set(words))}
        kept, median = sum(row[i][3] for row in rows), np.median([row[i][4] for row in rows])
        print(f"{name:8s} held {kept} of {len(rows)}, median {1e3 * median:.0f} ms, {counted}")
    both = [(a[1], b[1]) for a, b in rows if a[3] and b[3]]
    off = np.array([abs(a / b - 1.0) for a, b in both if max(a, b) > 1e-3])
    print(f"γ_opt of both: {len(off)}, median {np.median(off):.1e}, worst {off.max():.1e}, "
          f"above 1e-6: {(off > 1e-6).sum()}")  # fmt: skip


if __name__ == "__main__":
    main()
