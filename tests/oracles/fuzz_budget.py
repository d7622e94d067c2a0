"""Does every co-design end? Seeded random cases, each solved within a small time budget.

    python benchmarks/oracle.py fuzz_budget --cases 40 [--first 0] [--budget 0.1] [--out FILE]

A case is a chain of masses, one or two of them side by side (several channels), with some of: a
list, a parameter that varies, a set, bounds that are tight or cannot be met, a budget of errors, a
move with a catalogue of motors. One line of JSON each. It ends with an exit code of `solve`; a
traceback, "J inf", a `best so far` that is worse than one before, or no end within ten budgets and
`--patience` seconds is a fault. The exit status is 1 where there is one.
"""

import argparse
import itertools
import json
import re
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from oracles.fuzz_cases import toml

PLANT = """
import casadi as ca


def chain(theta, masses, spring, zeta, channels=1):
    m, k = theta["m"], theta.get("k", 1.0)
    load = theta.get("load", 0.0)
    n = len(masses)
    M = ca.diag(ca.vertcat(*(m * one for one in masses[:-1]), masses[-1] + load))
    K = ca.MX.zeros(n, n) if isinstance(m, ca.MX) else ca.SX.zeros(n, n)
    for i in range(n - 1):
        e = ca.DM.zeros(n, 1)
        e[i], e[i + 1] = 1.0, -1.0
        K += spring * k * (i + 1.0) * ca.mtimes(e, e.T)
    B = ca.DM.zeros(n, 1)
    B[0] = 1.0
    cost = m * sum(masses[:-1]) + 0.1 * k
    own = {"mass": M, "stiffness": K, "input": B, "output": B.T}
    if channels == 2:
        own = {name: ca.diagcat(value, (1.3 if name == "mass" else 1.0) * value)
               for name, value in own.items()}
    return own | {"damping_ratio": zeta, "hardware_cost": cost}
"""
KINDS = ("list", "varies", "set", "tight", "impossible", "budget", "move", "channels", "mixed")


def drawn(seed: int) -> tuple[dict[str, Any], list[str]]:
    """The case of a seed, and what it has."""
    rng = np.random.default_rng(seed)
    has = [kind for kind in KINDS if rng.random() < 0.35]
    if "move" in has or "budget" in has:
        has = [kind for kind in has if kind not in ("channels", "mixed")]
    if "move" in has and "budget" in has:
        has.remove("budget")
    if "mixed" in has:
        has = [kind for kind in has if kind != "varies"]
    masses = rng.uniform(0.5, 4.0, int(rng.integers(2, 4))).tolist()
    hz = float(np.exp(rng.uniform(np.log(40.0), np.log(300.0))))
    spring = (2.0 * np.pi * hz) ** 2 * min(masses)
    total = sum(masses)
    case: dict[str, Any] = {
        "plant": {
            "function": "plant.py:chain", "masses": masses, "spring": spring,
            "zeta": float(rng.choice([0.003, 0.02])), "channels": 2 if "channels" in has else 1,
        },
        "theta": {
            "m": {"lower": 0.6, "upper": 1.6, "start": 1.0},
            "k": {"lower": 0.5, "upper": 2.0, "start": 1.0},
        },
        "objective": {"w1": 1.0, "w2": -float(rng.uniform(0.002, 0.2)), "cost_unit": "kg"},
        "weights": {
            "M_S": 2.0, "A_S": 1e-4, "c_K": 1e4, "omega_K_hz": 2.0 * hz,
            "M_K": float(total * (0.6 * np.pi * hz) ** 2), "A_l": 1.0, "A_u": 1e-2,
        },
        "inner": {
            "S_max": 1.6 if "tight" in has else 2.0, "S_low": 0.1, "omega_low_hz": 0.01 * hz,
            "omega_S_hz": [0.02 * hz, 10.0 * hz], "omega_T_hz": [0.1 * hz, 10.0 * hz],
        },
        "outer": {"box_points": 4},
    }  # fmt: skip
    theta, inner = case["theta"], case["inner"]
    if "list" in has:
        theta["k"] = {"values": [0.5, 1.0, 2.0][: int(rng.integers(2, 4))]}
    elif rng.random() < 0.4:
        del theta["k"]
    if "varies" in has:
        most = float(rng.uniform(0.1, 2.0))
        theta["load"] = {"lower": 0.0, "upper": most, "start": 0.5 * most, "varies": True}
    if "mixed" not in has:
        case["controller"] = {
            "structure": "sections", "biquads": int(rng.integers(0, 2)), "least_damping": 0.1,
            "weighted_level": 10.0, "starts": 4,
        }  # fmt: skip
        case["loop"] = {"rate_hz": 40.0 * hz, "delay_us": 1e4 / hz}
        if not case["controller"]["biquads"]:
            del case["controller"]["least_damping"]
    if "set" in has:
        case["robust"] = {"resonance_shift": float(rng.uniform(0.01, 0.08))}
    if "impossible" in has:
        inner["compliance_max"] = float(rng.choice([1e-12, 0.5])) / case["weights"]["M_K"]
    if "budget" in has:
        case["objective"]["w2"] = 1e6
        inner["minimise"] = "rms_error"
        case["budget"] = {"force": {"name": "cable", "unit": "N^2/Hz", "level": 1e-4}}
        if rng.random() < 0.5:
            psd = [[0.01 * hz, 1e-3], [hz, 1e-5]]
            case["budget"]["force"] = {"name": "floor", "unit": "N^2/Hz", "psd": psd}
    if "move" in has:
        case["objective"]["w2"] = 100.0
        inner["minimise"] = "move_time"
        case["move"] = {"distance": 0.05, "velocity": 1.0, "acceleration": 20.0, "jerk": 4e3,
                        "settle_band": float(rng.choice([1e-7, 1e-5]))}  # fmt: skip
        if rng.random() < 0.5:
            theta["motor"] = {"values": [0.2, 0.5]}
            case["motor"] = {"size": "motor", "moving_mass": [0.2, 0.5],
                             "force_constant": [10.0, 25.0], "resistance": [3.0, 6.0],
                             "rms_power": float(rng.choice([2.0, 200.0]))}  # fmt: skip
            has.append("list")
    return case, sorted(set(has))


def written(seed: int, folder: Path) -> tuple[Path, list[str]]:
    """Its files."""
    case, has = drawn(seed)
    (folder / "plant.py").write_text(PLANT)
    path = folder / "case.toml"
    path.write_text(toml(case))
    return path, has


def fault(code: int, reported: str) -> str:
    """What is wrong with how a run ended; empty where nothing is."""
    if "Traceback" in reported or code not in (0, 2, 3, 4):
        return f"traceback or exit code {code}: {reported[-1500:]}"
    if infinite := re.search(r"J (?:-?inf|nan)\b.*", reported):
        return infinite[0]
    best = [float(J) for J in re.findall(r"best so far: J (\S+),", reported)]
    if any(after > before for before, after in itertools.pairwise(best)):
        return f"best so far goes backwards: {best}"
    return ""


def ended(seed: int, minutes: float, patience: float) -> dict[str, Any]:
    """How the case of a seed ends."""
    with TemporaryDirectory() as place:
        path, has = written(seed, Path(place))
        words = [sys.executable, "-m", "ccd_casadi.solve", str(path), "--workers", "2"]
        words += ["--budget", str(minutes), "--no-report"]
        began, limit = time.monotonic(), 600.0 * minutes + patience
        row: dict[str, Any] = {"seed": seed, "has": has}
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=limit, check=False)
            row |= {"code": done.returncode, "fault": fault(done.returncode, done.stderr)}
            row["words"] = done.stdout.strip()[:200]
        except subprocess.TimeoutExpired as error:
            reported = (error.stderr or b"").decode(errors="replace")
            row |= {"code": None, "fault": f"no end in {limit:.0f} s: {reported[-1500:]}"}
        result = path.with_suffix("") / "result.json"
        if result.exists():
            kept = json.loads(result.read_text())
            row |= {"status": kept["status"], "ended": kept["time_budget"]["ended"]}
        return row | {"seconds": round(time.monotonic() - began, 1)}


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--budget", type=float, default=0.1, metavar="MINUTES")
    parser.add_argument("--patience", type=float, default=120.0, metavar="SECONDS")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for seed in range(options.first, options.first + options.cases):
        rows.append(ended(seed, options.budget, options.patience))
        print(json.dumps(rows[-1]), flush=True)
        if options.out:
            options.out.write_text("".join(json.dumps(row) + "\n" for row in rows))
    faults = sum(bool(row["fault"]) for row in rows)
    print(f"{len(rows)} cases, {faults} faults", flush=True)
    sys.exit(int(faults > 0))


if __name__ == "__main__":
    main()
