"""Plants of other people with goals or figures of their own: each is designed by the command and
judged by code that shares nothing with the package (`-m slow`).

- The disk drive of Gu, Petkov and Konstantinov (Robust Control Design with MATLAB, 2nd ed., 2013):
  a coil with back-EMF behind an amplifier, four modes with numerators, eleven uncertain reals.
- The disk drive of Franklin, Powell and Workman: a lag, an integrator and four modes, sampled.
- The rotor of ROSS's example (Apache-2.0) on two magnetic bearings: 16 free modes of one plane.
"""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from oracles.fuzz_cases import toml
from scipy.linalg import expm

from ccd_casadi import inner

HZ = 2.0 * np.pi
WEIGHTS = {"M_S": 2.0, "A_S": 1e-4, "c_K": 1e4}
SECTIONS = {"structure": "sections", "biquads": 2, "lead": 1, "roll_off": 2, "least_damping": 0.1}


def designed(
    folder: Path, plant: str, case: dict, theta: str, capsys: pytest.CaptureFixture
) -> dict:
    """The answer of `ccd inner`, with K(s) as `K`."""
    (folder / "plant.py").write_text(plant)
    path = folder / "case.toml"
    path.write_text(toml(case))
    assert inner.main([str(path), "--theta", theta, "--out", str(folder / "run"), "--quiet"]) == 0
    kept = json.loads((folder / "run" / "controller.json").read_text())
    n = len(kept["A"])
    shapes = {"A": (n, n), "B": (n, -1), "C": (-1, n)}
    K = {key: np.array(kept[key], float).reshape(shape) for key, shape in shapes.items()}
    K["D"] = np.array(kept["D"], float).reshape(len(K["C"]), K["B"].shape[1])
    return json.loads(capsys.readouterr().out) | {"K": K}


def answers(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, s: np.ndarray
) -> np.ndarray:
    return C @ np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B + 0j) + D


# ---- the disk drive with eleven uncertain reals -------------------------------------------------

NAMES = ["inertia", "torque", "reading", *(f"{x}{i}" for x in ("f", "zeta") for i in range(4))]
MIDDLE = np.array([6.3857e-6, 0.09183, 1.2, 50.0, 2200.0, 6400.0, 8800.0, 0.3, 0.024, 0.129, 0.173])
SHARES = np.array([0.1, 0.1, 0.05, 0.05, 0.12, 0.08, 0.15, 0.05, 0.08, 0.1, 0.1])
B_A, B_B = (0.006, 0.013, 0.723, 0.235), (0.0, -0.0018, -0.0015, -0.0263)
DRIVE = """
import casadi as ca

NAMES, B_A, B_B = {names}, {b_a}, {b_b}


def drive(theta):
    p = [theta[name] for name in NAMES]
    A = ca.MX.zeros(11, 11) if any(isinstance(one, ca.MX) for one in p) else ca.SX.zeros(11, 11)
    A[0, 0], A[0, 9] = -(8.2 + 10.0 * 0.2) / 1e-3, -0.09183 / 1e-3
    for i in range(4):
        w, k = 2.0 * ca.pi * p[3 + i], 1 + 2 * i
        A[k, k + 1], A[k + 1, 0], A[k + 1, k] = w, w * p[1], -w
        A[k + 1, k + 1] = -2.0 * p[7 + i] * w
        A[9, k], A[9, k + 1] = B_A[i] / p[0], B_B[i] / p[0]
    A[10, 9] = 1.0
    B = ca.DM.zeros(11, 1)
    B[0] = 10.0 / 1e-3
    C = ca.horzcat(ca.DM.zeros(1, 10), p[2] * 0.0508e6)
    return {{"A": A, "B": B, "C": C, "hardware_cost": theta["size"]}}
"""


def goals(p: np.ndarray, K: dict) -> dict[str, float]:
    """The authors' goals on one plant, by its matrices written out again."""
    A, B, C = np.zeros((11, 11)), np.zeros((11, 1)), np.zeros((1, 11))
    J, K_t, K_y, f, zeta = p[0], p[1], p[2], p[3:7], p[7:]
    A[0, 0], A[0, 9], B[0], C[0, 10] = -10200.0, -91.83, 1e4, K_y * 50800.0
    for i in range(4):
        w, k = HZ * f[i], 1 + 2 * i
        A[k, k + 1], A[k + 1, 0], A[k + 1, k], A[k + 1, k + 1] = w, w * K_t, -w, -2 * zeta[i] * w
        A[9, k], A[9, k + 1] = B_A[i] / J, B_B[i] / J
    A[10, 9] = 1.0
    hz = np.geomspace(10.0, 1e5, 4000)
    s = 1j * HZ * hz
    L = (answers(A, B, C, np.zeros((1, 1)), s) * answers(*K.values(), s))[:, 0, 0]
    T = L / (1.0 + L)
    whole = np.block([[A - B @ K["D"] @ C, B @ K["C"]], [-K["B"] @ C, K["A"]]])
    crosses = [i for i, (a, b) in enumerate(pairwise(np.abs(L))) if (a - 1.0) * (b - 1.0) < 0.0]
    real = [i for i, (a, b) in enumerate(pairwise(L)) if a.imag * b.imag < 0.0 and a.real < 0.0]
    step = 1e-6
    drive = np.vstack([B @ K["D"], K["B"]])
    n = len(whole)
    M = expm(np.block([[whole, drive], [np.zeros((1, n + 1))]]) * step)
    x, u, y = np.append(np.zeros(n), 1.0), [], []
    for _ in range(6000):
        y.append(C[0] @ x[:11])
        u.append(K["C"][0] @ x[11:-1] + K["D"][0, 0] * (1.0 - y[-1]))
        x = M @ x
    late = np.flatnonzero(np.abs(np.array(y) - 1.0) > 0.02)
    return {
        "pole": float(np.linalg.eigvals(whole).real.max()),
        "T_db": float(20.0 * np.log10(np.abs(T).max())),
        "L_100_db": float(20.0 * np.log10(np.interp(100.0, hz, np.abs(L)))),
        "bandwidth_hz": float(hz[np.flatnonzero(np.abs(T) > np.sqrt(0.5))[-1]]),
        "phase_deg": min(abs(float(np.degrees(np.angle(-L[i])))) for i in crosses),
        "gain_db": min(abs(float(20.0 * np.log10(abs(L[i].real)))) for i in real),
        "volt": 1.2 * float(np.abs(u).max()),
        "settled_ms": 1e3 * step * float(late[-1]),
    }


@pytest.mark.slow
def test_the_goals_of_a_disk_drive_hold_on_its_whole_box(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """All but the settling within 1.5 ms (2 %), which holds on the model, and 1.9 ms on the box."""
    parts = (MIDDLE * (1.0 - SHARES), MIDDLE, MIDDLE * (1.0 + SHARES))
    ends = zip(NAMES, *(part.tolist() for part in parts), strict=True)
    theta = {
        name: {"lower": low, "upper": high, "start": at, "varies": True}
        for name, low, at, high in ends
    }
    case = {
        "plant": {"function": "plant.py:drive"},
        "theta": theta | {"size": {"lower": 0.9, "upper": 1.1}},
        "objective": {"w1": 1.0, "w2": -1.0, "cost_unit": "kg"},
        "controller": SECTIONS | {"weighted_level": 1.0, "starts": 10},
        "weights": WEIGHTS | {"omega_K_hz": 4e4, "M_K": 1.5, "A_l": 1.58, "A_u": 1e-2},
        "inner": {
            "S_max": 1.7, "S_low": 0.09, "omega_low_hz": 100.0,
            "omega_S_hz": [100.0, 2e4], "omega_T_hz": [4e4, 8e4],
        },
    }  # fmt: skip
    plant = DRIVE.format(names=NAMES, b_a=B_A, b_b=B_B)
    found = designed(tmp_path, plant, case, "size=1", capsys)
    assert found["status"] == "verified"
    assert len(found["K"]["A"]) <= 8
    rng = np.random.default_rng(1)
    inside, corners = rng.uniform(-1.0, 1.0, (50, 11)), rng.choice([-1.0, 1.0], (50, 11))
    drawn = [np.zeros(11), *inside, *corners]
    met = [goals(MIDDLE * (1.0 + SHARES * d), found["K"]) for d in drawn]
    assert met[0]["settled_ms"] < 1.5
    for one in met:
        assert one["pole"] < 0.0
        assert one["T_db"] < 4.0
        assert one["L_100_db"] > 20.0
        assert one["bandwidth_hz"] > 1000.0
        assert one["phase_deg"] > 40.0
        assert one["gain_db"] > 5.0
        assert one["volt"] < 1.2
        assert one["settled_ms"] < 1.9


# ---- the disk drive of a textbook ---------------------------------------------------------------

MODES = ((1.15e-5, -5.75e-3, 0.05, 70.0), (0.0, 0.023, 0.005, 2200.0),
         (0.0, 0.8185, 0.05, 4000.0), (0.0273, 0.1642, 0.005, 9000.0))  # fmt: skip
TEXTBOOK = """
import casadi as ca


def drive(theta):
    A, B = ca.DM.zeros(10, 10), ca.DM.zeros(10, 1)
    A[0, 1], A[1, 1] = 1.0, -12.5
    for i, (a, b, zeta, hz) in enumerate({modes}):
        w, k = 2.0 * ca.pi * hz, 2 + 2 * i
        A[k, k + 1], A[k + 1, k], A[k + 1, k + 1], B[k + 1] = w, -w, -2.0 * zeta * w, w
        A[1, k], A[1, k + 1] = 1e6 * b, 1e6 * a
    return {{"A": A, "B": B, "C": ca.DM.eye(10)[0, :], "hardware_cost": theta["size"]}}
"""


@pytest.mark.slow
def test_the_sampled_drive_of_a_textbook(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The plant as its transfer function, held and late by 10 µs, resonances ±2 %: aliases and all,
    from partial sums over the bands."""
    T, tau = 7e-5, 1e-5
    case = {
        "plant": {"function": "plant.py:drive"},
        "theta": {"size": {"lower": 0.9, "upper": 1.1}},
        "objective": {"w1": 1.0, "w2": -1.0, "cost_unit": "kg"},
        "controller": SECTIONS | {"starts": 8},
        "loop": {"rate_hz": 1.0 / T, "delay_us": 1e6 * tau},
        "weights": WEIGHTS | {"omega_K_hz": 5e3, "M_K": 100.0, "A_l": 1.0, "A_u": 1e-2},
        "inner": {
            "S_max": 1.8, "S_low": 0.1, "omega_low_hz": 10.0,
            "omega_S_hz": [5.0, 5e3], "omega_T_hz": [50.0, 1e4],
        },
        "robust": {"resonance_shift": 0.02},
    }  # fmt: skip
    found = designed(tmp_path, TEXTBOOK.format(modes=MODES), case, "size=1", capsys)
    assert found["status"] == "verified"
    hz = np.geomspace(1.0, 0.49 / T, 3000)
    z = np.exp(2j * np.pi * hz * T)
    K = answers(*found["K"].values(), 2.0 / T * (z - 1.0) / (z + 1.0))[:, 0, 0]  # Tustin's rule
    for shift in (-0.02, 0.0, 0.02):
        G = np.zeros(len(hz), complex)
        for band in range(-60, 61):
            s = 2j * np.pi * (hz + band / T)
            modes = [
                w * (a * s + b * w) / (s**2 + 2.0 * zeta * w * s + w**2)
                for a, b, zeta, own in MODES
                for w in [HZ * own * (1.0 + shift)]
            ]
            hold = (1.0 - np.exp(-s * T)) / (s * T)
            G += hold * np.exp(-s * tau) * 1e6 / (s * (s + 12.5)) * np.sum(modes, axis=0)
        S = np.abs(1.0 / (1.0 + G * K))
        assert S.max() <= 1.8 * 1.002
        assert S[hz <= found["bandwidth_hz"]].max() <= np.sqrt(0.5) * 1.002


# ---- a rotor on two magnetic bearings -----------------------------------------------------------

ROTOR = """
from math import cos, pi

import casadi as ca

F, PHI = ca.DM({f}), ca.DM({phi})


def rotor(theta):
    k = 4e-7 * pi * 138.0**2 * 470.3e-6 * cos(0.392)
    i0, s0 = theta["bias"], theta["gap"]
    k_i, k_s = k * i0 / s0**2, -k * i0**2 / s0**3 * theta["stiffness"]
    return {{
        "mass": ca.DM.eye(8), "stiffness": ca.diag((2.0 * pi * F) ** 2) + k_s * PHI.T @ PHI,
        "damping": ca.diag(2.0 * 0.001 * 2.0 * pi * F), "input": k_i * PHI.T, "output": PHI,
        "hardware_cost": 10.0 * i0**2,
    }}
"""
FREE_HZ = np.array([
    0.0, 0.0, 104.273, 400.434, 768.623, 1118.08, 2613.36, 3322.77,
    3952.27, 7136.87, 7154.14, 9009.43, 9584.01, 13153.3, 14058.0, 15273.1,
])  # fmt: skip
AT_BEARINGS = np.array([
    [-0.571201, -0.162483, -0.104055, 0.343723, 0.390083, 0.160067, -0.318073, -0.00730718,
     0.0604106, -0.172363, -0.410633, 0.41361, 0.00305333, -0.327416, 0.016044, 0.641111],
    [0.278629, -0.612305, -0.360162, -0.0215935, 0.194087, -0.316127, -0.0236292, 0.36553,
     -0.00707772, 0.411744, -0.175566, -0.00512969, 0.332233, 0.00243949, 0.154733, -0.00339623],
])  # fmt: skip


@pytest.mark.slow
def test_bearings_of_a_rotor_stay_in_zone_a_with_less_bias(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """|S| <= 2.5 at each bearing with the magnets' stiffness ±20 %, 20 % less bias power: designed
    with 8 modes, judged with 16. ROSS's own test takes hours for a second."""
    T, tau, bias, gap = 5e-5, 2.5e-5, 0.8944, 0.432e-3
    one = {"outputs": [1, 0], "inputs": [1, 0]}, {"outputs": [0, 1], "inputs": [0, 1]}
    case = {
        "plant": {"function": "plant.py:rotor"},
        "theta": {
            "bias": {"lower": 0.6, "upper": 1.4, "unit": "A"},
            "gap": {"lower": 4e-4, "upper": 6e-4, "unit": "m"},
            "stiffness": {"lower": 0.8, "upper": 1.2, "start": 1.0, "varies": True},
        },
        "objective": {"w1": 1.0, "w2": -0.05, "cost_unit": "W"},
        "controller": {
            "structure": "sections", "biquads": 1, "lead": 2, "roll_off": 2, "least_damping": 0.2,
            "starts": 16, "weighted_level": 1.0, "channel": {"a": one[0], "b": one[1]},
        },
        "loop": {"rate_hz": 1.0 / T, "delay_us": 1e6 * tau},
        "weights": WEIGHTS | {"omega_K_hz": 1e3, "M_K": 4e5, "A_l": 4.0, "A_u": 0.1},
        "inner": {
            "S_max": 2.5, "S_low": 0.3, "omega_low_hz": 1.0,
            "omega_S_hz": [5.0, 500.0], "omega_T_hz": [3000.0, 4000.0],
        },
        "robust": {"resonance_shift": 0.02},
    }  # fmt: skip
    plant = ROTOR.format(f=FREE_HZ[:8].tolist(), phi=AT_BEARINGS[:, :8].tolist())
    found = designed(tmp_path, plant, case, f"bias={bias},gap={gap}", capsys)
    assert found["status"] == "verified"
    k = 4e-7 * np.pi * 138.0**2 * 470.3e-6 * np.cos(0.392)
    z = np.exp(1j * HZ * np.geomspace(0.5, 0.4995 / T, 3000) * T)
    K = answers(*found["K"].values(), 2.0 / T * (z - 1.0) / (z + 1.0))
    for share in (0.8, 1.0, 1.2):
        stiffness = np.diag((HZ * FREE_HZ) ** 2)
        stiffness -= share * k * bias**2 / gap**3 * AT_BEARINGS.T @ AT_BEARINGS
        A = np.block([[np.zeros((16, 16)), np.eye(16)],
                      [-stiffness, -np.diag(2.0 * 0.001 * HZ * FREE_HZ)]])  # fmt: skip
        B = np.vstack([np.zeros((16, 2)), k * bias / gap**2 * AT_BEARINGS.T])
        C = np.hstack([AT_BEARINGS, np.zeros((2, 16))])

        def held(h: float, A: np.ndarray = A, B: np.ndarray = B) -> tuple[np.ndarray, np.ndarray]:
            whole = expm(h * np.block([[A, B], [np.zeros((2, 34))]]))
            return whole[:32, :32], whole[:32, 32:]

        rest, late = held(T - tau)
        early = rest @ held(tau)[1]
        x = np.linalg.solve(
            z[:, None, None] * np.eye(32) - held(T)[0], late + early / z[:, None, None]
        )
        S = np.linalg.inv(np.eye(2) + C @ x @ K)
        assert np.abs(np.diagonal(S, axis1=1, axis2=2)).max() <= 2.5 * 1.002
        a, b, c, d = tustin_of(found["K"], T)
        loop = np.block([
            [held(T)[0] - late @ d @ C, early, late @ c],
            [-d @ C, np.zeros((2, 2)), c],
            [-b @ C, np.zeros((len(a), 2)), a],
        ])  # fmt: skip
        assert np.abs(np.linalg.eigvals(loop)).max() < 1.0


def tustin_of(K: dict, T: float) -> tuple[np.ndarray, ...]:
    left = np.linalg.inv(np.eye(len(K["A"])) - 0.5 * T * K["A"])
    b, c = T * left @ K["B"], K["C"] @ left
    return left @ (np.eye(len(left)) + 0.5 * T * K["A"]), b, c, K["D"] + 0.5 * K["C"] @ b
