"""The fine steering mirror on an amplitude that its controller was not designed on.

    python benchmarks/mirror_held_out.py [--starts N] [--workers N]

Each amplitude is left out once; the loop is then judged by NumPy alone: K by Tustin's rule, |S| the
largest singular value on every line of the amplitude left out, stability by the winding of
det(I + GK). Designed on both, the judge's amplitude is half-way: the mean of the two responses.
"""

import argparse
from pathlib import Path

import numpy as np

import ccd_casadi as ccd
from ccd_casadi.support.process_pool import Workers

DATA = Path(__file__).parent.parent / "examples" / "fine_steering_mirror"
RATE, S_MAX = 6400.0, 1.8
STRUCTURE = ccd.Structure(lead=0, biquads=4, least_damping=0.1)


def judged(K: ccd.StateSpace, hz: np.ndarray, G: np.ndarray) -> tuple[float, float, float]:
    """Largest |S|, the first crossing of -3 dB in Hz, and turns of det(I + GK) about 0."""
    s = 2.0 * RATE * 1j * np.tan(np.pi * hz / RATE)
    of_K = K.C @ np.linalg.solve(s[:, None, None] * np.eye(len(K.A)) - K.A, K.B) + K.D
    loop = np.eye(3) + G @ of_K
    largest = 1.0 / np.linalg.svd(loop, compute_uv=False)[:, -1]
    turns = np.unwrap(np.angle(np.linalg.det(loop)))
    crossing = hz[np.argmax(largest >= np.sqrt(0.5))]
    return float(largest.max()), float(crossing), float(turns[-1] - turns[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=24)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    files = {f"{mV} mV": DATA / f"frf_{mV}mV.npz" for mV in (100, 300)}
    data = {name: ccd.read_frequency_response(path) for name, path in files.items()}
    hz = data["100 mV"].hz
    G = {name: found.matrix for name, found in data.items()}
    G["half-way"] = 0.5 * (G["100 mV"] + G["300 mV"])
    print("| designed on | judged on | ω_b Hz | \\|S\\| at most | over S_max | det turns |")
    print("|---|---|---|---|---|---|")
    with Workers(options.workers) as workers:
        for on in (["100 mV"], ["300 mV"], list(files)):
            tuned = ccd.tune(
                [data[name] for name in on], rate_hz=RATE, S_max=S_MAX, structure=STRUCTURE,
                starts=options.starts, workers=workers,
            )  # fmt: skip
            for name in G:
                peak, crossing, turns = judged(tuned.controller, hz, G[name])
                over = 100.0 * (peak / S_MAX - 1.0)
                cells = (" and ".join(on), name, f"{crossing:.1f}", f"{peak:.4f}", f"{over:+.2f} %")
                print(f"| {' | '.join(cells)} | {turns / (2.0 * np.pi):+.2f} |", flush=True)


if __name__ == "__main__":
    main()
