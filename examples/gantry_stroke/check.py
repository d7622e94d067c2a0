"""Is every bound kept at 1,001 positions? By a finite-element beam of its own.

python examples/gantry_stroke/check.py RUN_DIR        the run of this folder's case

Nothing of ccd_casadi computes here: Hermite beam elements in place of the case's polynomials, S by
solving the loop's equations at each frequency, stability by the poles of the sampled loop.
"""

import json
import sys
import tomllib
from pathlib import Path

import numpy as np
from plant import CARRIAGE, DENSITY, GUIDE, LENGTH, MOTOR, WIDTH, YOUNG
from scipy.linalg import eigh, expm

POSITIONS = 1001
ELEMENTS = 16
MODES = 9  # with the rigid one; the case has as many polynomials
SUSPENSION = 2.0 * np.pi * 0.1, 0.7  # rad/s and damping ratio, as the case's default
RELATIVE = 2e-3  # by which a figure may exceed its bound: the beams differ


def hermite(x: float) -> np.ndarray:
    """What the displacement at x, from the left end, is of all degrees of freedom."""
    a = LENGTH / ELEMENTS
    e = min(int(x / a), ELEMENTS - 1)
    s = x / a - e
    row = np.zeros(2 * (ELEMENTS + 1))
    row[2 * e : 2 * e + 4] = [
        1 - 3 * s**2 + 2 * s**3, a * (s - 2 * s**2 + s**3), 3 * s**2 - 2 * s**3, a * (s**3 - s**2)
    ]  # fmt: skip
    return row


def beam(h: float, wall: float) -> tuple[np.ndarray, np.ndarray]:
    """M, K without the carriage."""
    area = WIDTH * h - (WIDTH - 2 * wall) * (h - 2 * wall)
    inertia = (WIDTH * h**3 - (WIDTH - 2 * wall) * (h - 2 * wall) ** 3) / 12.0
    a = LENGTH / ELEMENTS
    k = (YOUNG * inertia / a**3) * np.array(
        [[12, 6 * a, -12, 6 * a], [6 * a, 4 * a**2, -6 * a, 2 * a**2],
         [-12, -6 * a, 12, -6 * a], [6 * a, 2 * a**2, -6 * a, 4 * a**2]]
    )  # fmt: skip
    m = (DENSITY * area * a / 420.0) * np.array(
        [[156, 22 * a, 54, -13 * a], [22 * a, 4 * a**2, 13 * a, -3 * a**2],
         [54, 13 * a, 156, -22 * a], [-13 * a, -3 * a**2, -22 * a, 4 * a**2]]
    )  # fmt: skip
    n = 2 * (ELEMENTS + 1)
    M, K = np.zeros((n, n)), np.zeros((n, n))
    for e in range(ELEMENTS):
        rows = slice(2 * e, 2 * e + 4)
        M[rows, rows] += m
        K[rows, rows] += k
    for end in (0.0, LENGTH):
        M += MOTOR * np.outer(hermite(end), hermite(end))
    # the guides hold the slope of the mean line: the first Legendre moment of the deflection
    x, weight = np.polynomial.legendre.leggauss(40)
    shape = np.array([hermite(0.5 * LENGTH * (1.0 + t)) for t in x])
    yaw = 1.5 * (weight * x) @ shape * 2.0 / LENGTH
    return M, K + GUIDE * np.outer(yaw, yaw)


def modal(M: np.ndarray, K: np.ndarray, at: float, damping: float) -> tuple[np.ndarray, ...]:
    """(k, d, b c) of the modes with the carriage at `at` from the middle, suspension in them."""
    tool = hermite(0.5 * LENGTH + at)
    push = 0.5 * (hermite(0.0) + hermite(LENGTH))
    lam, modes = eigh(K, M + CARRIAGE * np.outer(tool, tool), subset_by_index=(0, MODES - 1))
    omega = np.sqrt(np.maximum(lam, 0.0))
    omega[0], zeta = SUSPENSION[0], np.full(MODES, damping)
    zeta[0] = SUSPENSION[1]
    return omega, zeta, (push @ modes) * (tool @ modes)


def main(folder: Path) -> int:
    case = tomllib.loads((folder / "case.toml").read_text())
    result = json.loads((folder / "result.json").read_text())
    K = {key: np.array(value, float) for key, value in
         json.loads((folder / "controller.json").read_text()).items() if key in "ABCD"}  # fmt: skip
    inner, T = case["inner"], 1.0 / case["loop"]["rate_hz"]
    assert abs(1e-6 * case["loop"]["delay_us"] - T) < 1e-9, "this script knows one period of delay"
    eye = np.eye(len(K["A"]))
    hz = np.unique(np.concatenate([np.geomspace(0.5, 0.4999 / T, 4000),
                                   np.linspace(20.0, 400.0, 4000)]))  # fmt: skip
    z = np.exp(2j * np.pi * hz * T)
    s = 2.0 / T * (z - 1.0) / (z + 1.0)  # Tustin's rule
    C = np.array([(K["C"] @ np.linalg.solve(v * eye - K["A"], K["B"]) + K["D"])[0, 0] for v in s])
    inverse = np.linalg.inv(2.0 / T * eye - K["A"])
    Ad = inverse @ (2.0 / T * eye + K["A"])
    Bd, Cd = (eye + Ad) @ inverse @ K["B"], K["C"]
    Dd = K["D"] + K["C"] @ inverse @ K["B"]
    found = result["theta"] | result["fixed"]
    plate = beam(found["h"], found["wall"])
    ends = case["theta"]["at"]["lower"], case["theta"]["at"]["upper"]
    least = (np.inf, 0.0)
    worst = dict.fromkeys(("S_max", "S_low", "shape", "largest |z|", "GS"), (0.0, 0.0))
    floor = result["bandwidth_hz"] * (1.0 - RELATIVE)
    shift = case["robust"]["resonance_shift"]
    for at in np.linspace(*ends, POSITIONS):
        omega, zeta, strength = modal(*plate, at, case["plant"]["damping"])
        for factor in (1.0 - shift, 1.0, 1.0 + shift):
            w = omega * np.where(np.arange(MODES) > 0, factor, 1.0)
            G, A, B, c = np.zeros(len(z), complex), [], [], []
            for wi, zi, r in zip(w, zeta, strength, strict=True):
                a = np.array([[0.0, 1.0, 0.0], [-wi * wi, -2 * zi * wi, r], [0.0, 0.0, 0.0]])
                F = expm(a * T)
                A, B, c = [*A, F[:2, :2]], [*B, F[:2, 2]], [*c, 1.0, 0.0]
                det = (z - F[0, 0]) * (z - F[1, 1]) - F[0, 1] * F[1, 0]
                G += ((z - F[1, 1]) * F[0, 2] + F[0, 1] * F[1, 2]) / det / z
            S = np.abs(1.0 / (1.0 + G * C))
            P = np.zeros((2 * MODES + 1, 2 * MODES + 1))  # the last state is the delayed force
            for i, (F, b) in enumerate(zip(A, B, strict=True)):
                P[2 * i : 2 * i + 2, 2 * i : 2 * i + 2], P[2 * i : 2 * i + 2, -1] = F, b
            c = np.array([*c, 0.0])
            force = np.eye(len(P))[-1]
            loop = np.block([[P - np.outer(force, c) * Dd[0, 0], np.outer(force, Cd[0])],
                             [-np.outer(Bd[:, 0], c), Ad]])  # fmt: skip
            crossing = hz[np.argmax(S > 2.0**-0.5)]
            least = min(least, (crossing, at))
            shares = {
                "S_max": S.max() / inner["S_max"],
                "S_low": np.interp(inner["omega_low_hz"], hz, S) / inner["S_low"],
                "shape": (S / np.maximum(1.1 * hz / floor / 2.0**0.5, 1e-300))[
                    hz < 2 * floor
                ].max(),
                "GS": np.abs(G * S).max() / inner["compliance_max"],
                "largest |z|": np.abs(np.linalg.eigvals(loop)).max(),
            }
            worst = {key: max(worst[key], (share, at)) for key, share in shares.items()}
    print(f"{POSITIONS} positions, each with resonances at both ends and in the middle")
    print(f"bandwidth at least {least[0]:.2f} Hz at {least[1]:.4f} m; designed for "
          f"{result['bandwidth_hz']:.2f} Hz")  # fmt: skip
    for key, (share, at) in worst.items():
        print(f"{key:12} {share:.6f} at most, at {at:+.4f} m")
    good = all(share <= 1.0 + RELATIVE for key, (share, _) in worst.items() if key != "largest |z|")
    return 0 if good and worst["largest |z|"][0] < 1.0 and least[0] >= floor else 1


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1])))
