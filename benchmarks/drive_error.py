"""The position error of the dual-stage disk drive, by PyHDDBenchmark's own simulation.

    python benchmarks/drive_error.py --theirs DIR

DIR is a checkout of github.com/liuzd1997/PyHDDBenchmark. Its `function_simulation.py` takes minutes
a case; the same recursion, compiled here, takes a fifth of a second and gives the nine figures that
the benchmark publishes for its own controllers (13.51 to 14.54 %) to all their digits. It is run on
those and on what benchmarks/disk_drive.json holds: 3σ of the head in per cent of the track's
52.697 nm, and the largest stroke of the piezo.
"""

import argparse
import json
from pathlib import Path

import disk_drive as judge
import numpy as np
from error import FAN, HZ, TRACK
from numba import njit
from peer_table import keep
from scipy.signal import cont2discrete, lfilter, tf2ss

FINE = 20  # instants of the simulation in a sample of the controller
STEP = judge.T / FINE
COUNT = round(1.1 / STEP) + 1
KEPT = FINE * 420 * 120  # instants from 0.1 s on: 120 revolutions


@njit(cache=True)
def filtered(A: np.ndarray, B: np.ndarray, C: np.ndarray, u: np.ndarray) -> np.ndarray:
    x, y = np.zeros(len(B)), np.zeros(len(u))
    for k in range(len(u)):
        x = A @ x + B * u[k]
        y[k] = C @ x
    return y


def disturbances(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fan at every instant, rotational vibration, and the run-out of a revolution."""
    noises = []
    for seed in range(1, 15):
        # as the benchmark draws them: NumPy's older generator
        noises.append(np.random.RandomState(seed).rand(COUNT, 1)[:, 0] - 0.5)
    fan = np.zeros(COUNT)
    for (gain, zeta, hz), u in zip(FAN, noises[1:], strict=True):
        w = HZ * hz
        b, a, _ = cont2discrete(([gain], [1.0, 2.0 * zeta * w, w**2]), STEP)
        fan += lfilter(b.ravel(), a, np.append(u, 0.0))[1:]
    w = HZ * np.array([50.0, 3.0, 2000.0, 250.0])
    above = 3e-10 * np.polymul([1.0, w[0]], [1.0, 40.0 * w[2], w[2] ** 2])
    below = np.polymul([1.0, w[1]], [1.0, 0.2 * w[3], w[3] ** 2])
    A, B, C, _, _ = cont2discrete(tf2ss(above, below), STEP)
    moved = filtered(np.ascontiguousarray(A), B.ravel(), C.ravel(), noises[0])
    run_out = np.loadtxt(folder / "Data_RRO.txt", comments="#", delimiter=",") * 0.5e-10
    return fan, np.append(0.0, moved[:-1]), run_out


@njit(cache=True)
def run(
    A: np.ndarray, B: np.ndarray, first: int, K: tuple, L: tuple, F: tuple, H: tuple, times: int,
    fan: np.ndarray, moved: np.ndarray, run_out: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Head and piezo; modes A (n, 2, 2), B (n, 2), the `first` of which the VCM drives."""
    n = len(fan)
    x = np.zeros((len(A), 2))
    states = [np.zeros(len(one[0])) for one in (K, L, F, H)]
    head, stroke = np.zeros(n), np.zeros(n)
    y = piezo = slow = fast = u = v = 0.0
    i = 0
    for k in range(n):
        if k % FINE == 0:
            e = -y + run_out[i]
            i = (i + 1) % len(run_out)
            slow = K[2] @ states[0] + K[3] * e
            states[0] = K[0] @ states[0] + K[1] * e
            fast = L[2] @ states[1] + L[3] * e
            states[1] = L[0] @ states[1] + L[1] * e
        if k % (FINE // times) == 0:
            u = F[2] @ states[2] + F[3] * slow
            states[2] = F[0] @ states[2] + F[1] * slow
            v = H[2] @ states[3] + H[3] * fast
            states[3] = H[0] @ states[3] + H[1] * fast
        head[k], stroke[k] = y, piezo
        y, piezo = fan[k], 0.0
        for j in range(len(A)):
            drive = u + moved[k] if j < first else v
            a = A[j, 0, 0] * x[j, 0] + A[j, 0, 1] * x[j, 1] + B[j, 0] * drive
            x[j, 1] = A[j, 1, 0] * x[j, 0] + A[j, 1, 1] * x[j, 1] + B[j, 1] * drive
            x[j, 0] = a
            if j >= first:
                piezo += a
            y += a
    return head, stroke


def flat(system: judge.System | None) -> tuple:
    """Arrays as the recursion takes them; None is a wire."""
    wire = (np.zeros((1, 1)), np.zeros(1), np.zeros(1), np.ones(1))
    A, B, C, D = wire if system is None else system
    return (np.ascontiguousarray(A, float), np.ravel(B).astype(float), np.ravel(C).astype(float),
            float(np.ravel(D)[0]))  # fmt: skip


def simulated(branches: list[judge.Branch], case: tuple, given: tuple) -> tuple[float, float]:
    """3σ in per cent of the track, and the largest stroke in nm."""
    rows = judge.modes(*case)
    held = [judge.held(part, STEP) for part in rows]
    A = np.concatenate([[one[0][i : i + 2, i : i + 2] for i in range(0, len(one[0]), 2)]
                        for one in held])  # fmt: skip
    B = np.concatenate([one[1].reshape(-1, 2) for one in held])
    parts = [flat(b.controller) for b in branches] + [flat(b.filtered) for b in branches]
    head, stroke = run(A, B, len(rows[0]), *parts, branches[0].times, *given)
    begin = int(np.argmax(STEP * (np.arange(COUNT) - 1) >= 0.1))
    part = slice(begin, begin + KEPT)
    return 300.0 * float(head[part].std()) / TRACK, 1e9 * float(np.abs(stroke[part]).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--theirs", type=Path, required=True)
    given = parser.parse_args()
    sections = json.loads(judge.RESULTS.read_text())["sections"]
    sets = {judge.THEIRS: judge.theirs(given.theirs)}
    sets |= {name: judge.ours(own) for name, own in sections.items()}
    noise = disturbances(given.theirs)
    worst = {}
    for name, branches in sets.items():
        found = np.array([simulated(branches, case, noise) for case in judge.NINE])
        worst[name] = found.max(axis=0)
        each = " ".join(f"{value:.2f}" for value in found[:, 0])
        print(f"{name:18s} 3σ in % of the track {each}; worst {worst[name][0]:.2f}, "
              f"stroke {worst[name][1]:.1f} nm")  # fmt: skip
    rows = []
    for name in sections:
        theirs, own = worst[judge.THEIRS], worst[name]
        rows.append([f"{name}: worst 3σ of nine cases; stroke", f"{theirs[0]:.2f} % of the track; "
                     f"{theirs[1]:.1f} nm", f"{own[0]:.2f} %; {own[1]:.1f} nm"])  # fmt: skip
    keep("drive", rows)


if __name__ == "__main__":
    main()
