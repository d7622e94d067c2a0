"""Do verdicts hold? Seeded random small co-designs of every kind, each judged by files alone.

`python benchmarks/oracle.py verdicts_hold --cases 200 [--first 0] [--minutes 5] --out FILE` draws
chains of two or three masses with one or two parameters in a small box and solves each by the
command, as mixed sensitivity (alone, on a set, with a bound of the compliance, with disturbances)
or sections (bandwidth, least RMS error; continuous, sampled, on a set), by `nested`, `lifted` or
`direct`. `verdicts_judge`, which shares no code with the package, then looks at every claim of the
run; oracles/contradictions at its figures among each other. A run that is not verified,
or found nothing, is solved again by another formulation: verified there at the same J, it is
falsely not verified. What FILE holds already is not run again. One in twenty is a measured
response. `--hard` makes every plant one that design models of ours once mistook: damping of 0.02 to
0.1 %, a speck of mass on a stiff link, loops of a tenth of a hertz to two, modes 0.5 to 3 % apart;
half of these stand on a spring and have no free body.
"""

import argparse
import json
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from oracles.contradictions import contradictions
from oracles.verdicts_judge import HZ, Chain, Loop, wrong

SAME = 1e-6  # relative: two values of J that are one optimum
KINDS = {
    "h_infinity": 0.2,
    "set": 0.12,
    "compliance": 0.1,
    "h_infinity_disturbance": 0.18,
    "sections": 0.2,
    "sections on a set": 0.1,
    "rms_error": 0.05,
    "measured": 0.05,
}
PLANT = """
import casadi as ca


def chain(theta, mass, spring, power, sensor, zeta, price, mass_limit, ground=0.0):
    p = theta["p"]
    q = theta["q"] if "q" in theta else p**power
    n = len(mass)
    K = 0
    for i, k in enumerate(spring):
        e = ca.DM.zeros(n, 1)
        e[i], e[i + 1] = 1.0, -1.0
        K = K + k * q * (e @ e.T)
    if ground:
        K[0, 0] += ground
    B, C = ca.DM.zeros(n, 1), ca.DM.zeros(1, n)
    B[0], C[sensor] = 1.0, 1.0
    return {
        "mass": p * ca.diag(ca.DM(mass)),
        "stiffness": K,
        "damping_ratio": zeta,
        "input": B,
        "output": C,
        "hardware_cost": sum(mass) * p + price * q,
        "constraints": {"mass": sum(mass) * p - mass_limit},
    }
"""


TRAITS = ("light", "link", "slow", "close")


def hardened(seed: int, chain: Chain) -> tuple[Chain, str]:
    """The chain with a trait that a design model may lose, and the trait's name."""
    rng = np.random.default_rng([seed, 67])
    mass, spring, zeta = chain.mass, chain.spring, chain.zeta
    trait = str(rng.choice(TRAITS))
    if trait == "light":
        zeta = float(np.exp(rng.uniform(np.log(2e-4), np.log(1e-3))))
    elif trait == "link":
        mass = np.append(mass, np.exp(rng.uniform(np.log(1e-6), np.log(1e-4))))
        spring = np.append(spring, np.exp(rng.uniform(np.log(1e8), np.log(1e10))))
    elif trait == "slow":
        spring = spring * np.exp(rng.uniform(np.log(1e-3), np.log(2e-2))) ** 2
    else:  # two equal arms on a heavy middle: modes apart by their small difference alone
        apart = 1.0 + float(rng.uniform(0.01, 0.06))
        mass = mass[0] * np.array([0.1, 2.0, 0.1])
        spring = spring[0] * np.array([0.1, 0.1 * apart])
    ground = 0.0
    if rng.random() < 0.5:
        first = float(
            np.sort(np.abs(np.linalg.eigvals(Chain(mass, spring, zeta, 0).at(1.0, 1.0)[0])))[2]
        )
        ground = float(mass.sum() * (rng.uniform(0.01, 0.1) * first) ** 2)
    return Chain(mass, spring, zeta, min(chain.sensor, len(mass) - 1), ground), trait


def drawn(seed: int, hard: bool = False) -> tuple[str, str, Chain, dict[str, Any]]:
    """Kind, formulation, plant and case of a seed."""
    rng = np.random.default_rng([seed, 34])
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    formulation = str(rng.choice(["nested", "lifted", "direct"]))
    n = int(rng.integers(2, 4))
    mass = np.exp(rng.uniform(0.0, 4.0)) * rng.uniform(0.5, 2.0, n)
    spring = mass[:-1] * (HZ * np.exp(rng.uniform(np.log(60.0), np.log(300.0), n - 1))) ** 2
    sensor = 0 if rng.random() < 0.7 else int(rng.integers(n))
    chain = Chain(mass, spring, float(np.exp(rng.uniform(-7.0, -3.5))), sensor)
    if hard:
        chain, trait = hardened(seed, chain)
        kind_and_trait = f"{kind}, {trait}" + (", on a spring" if chain.ground else "")
    mass, spring, sensor = chain.mass, chain.spring, chain.sensor
    first = float(np.sort(np.abs(np.linalg.eigvals(chain.at(1.0, 1.0)[0])))[2])
    total, crossing = float(mass.sum()), first * float(rng.uniform(0.15, 0.6))
    reach = np.exp(rng.uniform(np.log(0.01), np.log(0.4), (2, 2)))
    low, high = 1.0 - reach[0], 1.0 + reach[1]
    names = ("p", "q")[: int(rng.integers(1, 3))]
    theta = {
        name: {"lower": float(low[i]), "upper": float(high[i]), "start": 1.0}
        for i, name in enumerate(names)
    }
    case: dict[str, Any] = {
        "plant": {
            "function": "plant.py:chain",
            "mass": mass.tolist(),
            "spring": spring.tolist(),
            "power": float(rng.uniform(0.0, 4.0)),
            "sensor": sensor,
            "zeta": chain.zeta,
            "price": total * float(rng.uniform(0.0, 2.0)),
            "mass_limit": total * float(rng.uniform(1.0, 1.3)),
            "ground": chain.ground,
        },
        "theta": theta,
        "objective": {"w1": float(rng.uniform(0.0, 2.0)) * crossing / total, "w2": -1.0},
        "weights": {
            "M_S": 2.0,
            "A_S": 1e-4,
            "c_K": 1e4,
            "omega_K_hz": 2.0 * crossing / HZ,
            "M_K": float(rng.uniform(1.0, 4.0)) * total * crossing**2,
            "A_l": 1.0,
            "A_u": 1e-2,
        },
        "inner": {
            "S_max": float(rng.uniform(1.5, 2.4)),
            "S_low": 0.1,
            "omega_low_hz": crossing / 30.0 / HZ,
            "omega_S_hz": [crossing / 5.0 / HZ, 30.0 * crossing / HZ],
            "omega_T_hz": [crossing / 2.0 / HZ, 20.0 * crossing / HZ],
        },
        "controller": {"structure": "h_infinity"},
        "sampling": {"points": 4, "lifted_points": 24},
        "outer": {"starts": 4, "direct_starts": 2, "max_refinements": 6, "box_points": 4},
    }
    if kind == "set":
        case["robust"] = {"resonance_shift": float(rng.uniform(0.002, 0.03)), "shifts": 3}
        if rng.random() < 0.5:
            case["robust"]["damping"] = [0.7, 1.5]
    elif kind == "compliance":
        inner, M_K = case["inner"], case["weights"]["M_K"]
        inner["compliance_max"] = float(np.exp(rng.uniform(3.0, 9.0))) / M_K
    elif kind == "h_infinity_disturbance":
        case["controller"]["structure"] = kind
        case["weights"]["disturbance"] = case["weights"]["M_K"] * float(rng.uniform(1.0, 30.0))
    elif kind != "h_infinity":
        _with_sections(rng, kind, case, crossing)
    return (kind_and_trait if hard else kind), formulation, chain, case


def _with_sections(
    rng: np.random.Generator, kind: str, case: dict[str, Any], crossing: float
) -> None:
    case["controller"] = {"structure": "sections", "biquads": int(rng.integers(2)), "starts": 2}
    case["controller"]["weighted_level"] = float(rng.uniform(6.0, 15.0))
    case["sampling"]["points"] = 3
    if rng.random() < 0.5:
        rate = float(rng.uniform(20.0, 80.0)) * crossing / HZ * 4.0
        case["loop"] = {"rate_hz": rate, "delay_us": 1e6 / rate * float(rng.uniform(0.0, 2.0))}
    if kind == "sections on a set":
        case["robust"] = {"resonance_shift": float(rng.uniform(0.005, 0.04))}
        if rng.random() < 0.5:
            case["robust"]["damping"] = [0.5, 2.0]
    if kind == "rms_error":
        case["objective"]["w2"] = 1e7 * crossing
        case["inner"]["minimise"] = kind
        case["budget"] = {
            "force": {"unit": "N^2/Hz", "level": 1e-2, "poles_hz": [20.0]},
            "sensor_noise": {"unit": "nm/rtHz", "level": 0.05},
        }
    if kind == "measured":
        for key in ("theta", "objective", "sampling", "outer", "robust"):
            case.pop(key, None)
        case.get("loop", {}).pop("delay_us", None)
        case["controller"].pop("starts")  # one search alone, from as many places as usual


def written(folder: Path, case: dict[str, Any]) -> Path:
    """The case and its plant function as files."""
    (folder / "plant.py").write_text(PLANT)
    lines: list[str] = []

    def table(name: str, entries: dict[str, Any]) -> None:
        own = {key: value for key, value in entries.items() if not isinstance(value, dict)}
        if own:
            lines.append(f"[{name}]")
            lines.extend(f"{key} = {json.dumps(value)}" for key, value in own.items())
        for key, value in entries.items():
            if isinstance(value, dict):
                table(f"{name}.{key}", value)

    for name, entries in case.items():
        table(name, entries)
    path = folder / "case.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def ran(path: Path, formulation: str, seconds: float) -> dict[str, Any]:
    """result.json and controller.json of a solve by the command, or why there are none."""
    out = path.parent / formulation
    call = [sys.executable, "-m", "ccd_casadi.solve", str(path), "--out", str(out), "--quiet"]
    call += ["--formulation", formulation, "--no-report", "--workers", "1"]
    try:
        done = subprocess.run(call, capture_output=True, text=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        return {"failed": f"no end in {seconds:g} s"}
    if done.returncode not in (0, 3, 4):
        return {"failed": f"exit code {done.returncode}: {done.stderr[-500:]}"}
    result = json.loads((out / "result.json").read_text())
    found = {"result": result}
    if result["status"] != "infeasible":
        found["controller"] = json.loads((out / "controller.json").read_text())
    return found


def measured(folder: Path, chain: Chain, case: dict[str, Any], seconds: float) -> dict[str, Any]:
    """The chain's response at lines as the plant, its controller judged on the chain itself."""
    loop = case.get("loop", {})
    nothing = {"A": np.zeros((0, 0)), "B": np.zeros((0, 1)), "C": np.zeros((1, 0)), "D": [[0.0]]}
    plant = Loop(chain.at(1.0, 1.0), nothing, loop)
    first, last = case["inner"]["omega_low_hz"], 20.0 * case["inner"]["omega_T_hz"][0]
    hz = np.geomspace(0.5 * first, min(5.0 * last, 0.49 * loop.get("rate_hz", np.inf)), 1500)
    G, _ = plant.responses(HZ * hz)
    np.savetxt(folder / "G.csv", np.column_stack([hz, G.real, G.imag]), delimiter=",",
               header="f_hz,re,im", comments="")  # fmt: skip
    path = written(folder, case | {"plant": {"model": "measured", "file": "G.csv"}})
    call = [sys.executable, "-m", "ccd_casadi.inner", str(path), "--quiet", "--out", str(folder)]
    try:
        done = subprocess.run(call, capture_output=True, text=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        return {"failed": f"no end in {seconds:g} s"}
    if done.returncode not in (0, 3, 4):
        return {"failed": f"exit code {done.returncode}: {done.stderr[-500:]}"}
    answer = json.loads(done.stdout)
    row = {"status": answer["status"], "reason": answer.get("reason", "")}
    if answer["status"] == "verified":
        closed = Loop(
            chain.at(1.0, 1.0), json.loads((folder / "controller.json").read_text()), loop
        )
        peak, most = float(closed.gain(HZ * hz).max()), case["inner"]["S_max"]
        reported = abs(peak / answer["sensitivity_peak"] - 1.0)
        row["wrong"] = [] if closed.stable else ["unstable"]
        row["wrong"] += [f"peak of S {peak:.8g}"] if peak > most * (1.0 + 1e-6) else []
        row["wrong"] += [f"peak of S is {peak:.8g}"] if reported > 1e-6 else []
    return row


def judged(seed: int, seconds: float, hard: bool = False) -> dict[str, Any]:
    """The row of a seed."""
    kind, formulation, chain, case = drawn(seed, hard)
    row: dict[str, Any] = {"seed": seed, "kind": kind, "formulation": formulation}
    began = time.monotonic()
    with TemporaryDirectory() as place:
        if kind.startswith("measured"):
            return row | measured(Path(place), chain, case, seconds)
        path = written(Path(place), case)
        found = ran(path, formulation, seconds)
        row["seconds"] = round(time.monotonic() - began, 1)
        if "failed" in found:
            return row | found
        r = found["result"]
        row |= {"status": r["status"], "reason": r["reason"], "objective": r.get("objective")}
        row["wrong"] = []
        if r["status"] != "infeasible":
            row["wrong"] = wrong(chain, case, r, found["controller"])
            row["contradictions"] = contradictions(r, problem_of(load_case(path)))
            lines = {name: line["state"] for name, line in r["verdict"].items()}
            row |= {"lines": lines, "syntheses": r["syntheses"], "kkt": r["kkt"]["stationarity"]}
        if r["status"] != "verified":
            other = "lifted" if formulation == "direct" else "direct"
            again = ran(path, other, seconds).get("result", {"status": "no end"})
            row["again"] = [other, again["status"], again.get("objective")]
    return row


def summed(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What is to be nothing, and the share of not verified by the line that failed."""

    def falsely(row: dict[str, Any]) -> bool:
        if "again" not in row or row["again"][1] != "verified":
            return False
        J, other = row["objective"], row["again"][2]
        return J is None or other + SAME * abs(other) >= J

    lines = Counter(
        f"{row['kind']}, {row['formulation']}: {name}"
        for row in rows
        for name, state in row.get("lines", {}).items()
        if state == "failed"
    )
    return {
        "cases": len(rows),
        "kinds": dict(Counter(row["kind"] for row in rows)),
        "status": dict(Counter(row.get("status", "failed") for row in rows)),
        "not_verified_by_line": dict(lines),
        "falsely_verified": [(row["seed"], row["wrong"]) for row in rows if row.get("wrong")],
        "falsely_not_verified": [row["seed"] for row in rows if falsely(row)],
        "contradictions": [
            (row["seed"], row["contradictions"]) for row in rows if row.get("contradictions")
        ],
        "failed": [(row["seed"], row["failed"]) for row in rows if "failed" in row],
        "seconds": sum(row.get("seconds", 0.0) for row in rows),
    }


def main() -> None:
    """Run what is missing, write the rows and what they say together."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=5.0, help="of one solve at most")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--hard", action="store_true", help="plants that a design model may lose")
    options = parser.parse_args()
    rows: dict[int, dict[str, Any]] = {}
    if options.out.exists():
        rows = {row["seed"]: row for row in json.loads(options.out.read_text())["rows"]}
    for seed in range(options.first, options.first + options.cases):
        if seed in rows:
            continue
        rows[seed] = judged(seed, 60.0 * options.minutes, options.hard)
        print(json.dumps(rows[seed]), flush=True)
        ordered = [rows[number] for number in sorted(rows)]
        text = json.dumps({"summed": summed(ordered), "rows": ordered}, indent=1)
        options.out.write_text(text + "\n")
    print(json.dumps(summed([rows[number] for number in sorted(rows)]), indent=1))


if __name__ == "__main__":
    main()
