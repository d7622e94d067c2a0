"""Does a run say one thing? Terminal, pages and result.json of generated small runs, compared.

`python benchmarks/oracle.py consistency --cases 60 [--first 0] [--minutes 4] [--out FILE]` solves
seeded cases of every kind by the commands: mixed sensitivity (by any formulation, alone, on a set,
with a bound of the compliance, with disturbances), sections (continuous, sampled, on a set, least
RMS error), two channels, and `tune` of measured lines and of models. What contradicts what is
printed, by oracles/page_figures and contradictions.py; nothing is expected. The shipped
example of two channels is one in ten, with bounds of its own.
"""

import argparse
import json
import subprocess
import sys
import time
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import scipy.io

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from oracles.contradictions import contradictions
from oracles.page_figures import disagreements, tuned_disagreements
from oracles.verdicts_hold import drawn, written
from oracles.verdicts_judge import HZ, Chain, Loop

ROOT = Path(__file__).parents[2]


def called(command: str, *options: str, seconds: float | None) -> tuple[int | None, str]:
    """Exit code (None: out of time) and what was printed; without a limit in this process."""
    if seconds is None:
        out, err = StringIO(), StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            code = import_module(f"ccd_casadi.{command}").main([*options, "--workers", "1"])
        return code, f"{out.getvalue()}\n{err.getvalue()}"
    call = [sys.executable, "-m", f"ccd_casadi.{command}", *options, "--workers", "1"]
    try:
        done = subprocess.run(call, capture_output=True, text=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        return None, ""
    return done.returncode, f"{done.stdout}\n{done.stderr}"


def two_channels(folder: Path, seed: int) -> Path:
    """The beam on two motors, quick to design: other bounds, on a set or alone, sampled or not."""
    rng, own = np.random.default_rng([seed, 35]), ROOT / "examples/two_axes"
    (folder / "plant.py").write_text((own / "plant.py").read_text())
    text = (own / "case.toml").read_text().replace("starts = 8", "starts = 2")
    text = text.replace("S_max = 1.9", f"S_max = {rng.uniform(1.7, 2.3):.3f}")
    text = text.replace("S_max = 1.5", f"S_max = {rng.uniform(1.5, 1.7):.3f}")
    text += "\n[sampling]\npoints = 3\n[outer]\nmax_refinements = 2\nbox_points = 0\n"
    if seed % 20 == 5:
        text += "[robust]\nresonance_shift = 0.01\n"
    if seed % 4 == 1:
        text += "[loop]\nrate_hz = 8000.0\ndelay_us = 50.0\n"
    path = folder / "case.toml"
    path.write_text(text)
    return path


def tuned(
    folder: Path, chain: Chain, case: dict[str, Any], seed: int, seconds: float | None
) -> Any:
    """By lines of a chain's response, or by its matrices."""
    rate = 40.0 * case["inner"]["omega_T_hz"][0]
    A, B, C = (np.atleast_2d(part) for part in chain.at(1.0, 1.0)[:3])
    if seed % 2:
        data = folder / "G.mat"
        scipy.io.savemat(data, {"A": A, "B": B.reshape(len(A), -1), "C": C.reshape(-1, len(A)),
                                "D": np.zeros((1, 1))})  # fmt: skip
    else:
        none = {"A": np.zeros((0, 0)), "B": np.zeros((0, 1)), "C": np.zeros((1, 0)), "D": [[0.0]]}
        hz = np.geomspace(0.2 * case["inner"]["omega_low_hz"], 0.49 * rate, 1200)
        G = Loop(chain.at(1.0, 1.0), none, {"rate_hz": rate}).responses(HZ * hz)[0]
        data = folder / "G.csv"
        np.savetxt(data, np.column_stack([hz, G.real, G.imag]), delimiter=",",
                   header="f_hz,re,im", comments="")  # fmt: skip
    out = folder / "tuned"
    code, text = called("tune", str(data), "--rate-hz", str(rate), "--biquads", str(seed % 2),
                        "--out", str(out), seconds=seconds)  # fmt: skip
    if code not in (0, 3, 4):
        return {"failed": f"exit code {code}: {text[-300:]}"}
    status = json.loads((out / "result.json").read_text())["status"]
    return {"status": status, "wrong": tuned_disagreements(out, text)}


def judged(seed: int, seconds: float | None) -> dict[str, Any]:
    """The row of a seed."""
    kind, formulation, chain, case = drawn(seed)
    kind = {5: "two channels", 7: "tune", 8: "tune"}.get(seed % 10, kind)
    row: dict[str, Any] = {"seed": seed, "kind": "tune" if kind == "measured" else kind}
    began = time.monotonic()
    with TemporaryDirectory() as place:
        folder = Path(place)
        if row["kind"] == "tune":
            row |= tuned(folder, chain, case, seed, seconds)
            return row | {"seconds": round(time.monotonic() - began, 1)}
        if kind == "two channels":
            path, formulation = two_channels(folder, seed), "nested"
        else:
            path = written(folder, case)
        out = folder / "run"
        code, text = called("solve", str(path), "--out", str(out), "--formulation", formulation,
                            seconds=seconds)  # fmt: skip
        row |= {"formulation": formulation, "seconds": round(time.monotonic() - began, 1)}
        if code not in (0, 3, 4):
            return row | {"failed": f"exit code {code}: {text[-300:]}"}
        result = json.loads((out / "result.json").read_text())
        row |= {"status": result["status"], "wrong": disagreements(out, text)}
        row["wrong"] += contradictions(result, problem_of(load_case(path)))
        row["lines"] = {name: line["state"] for name, line in result.get("verdict", {}).items()}
        row["set"] = result.get("verdict", {}).get("survives", {}).get("set")
        row["proof"] = result.get("proof", {}).get("outcome")
    return row


def summed(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What is to be nothing, and what was run."""
    return {
        "cases": len(rows),
        "kinds": dict(Counter(row["kind"] for row in rows)),
        "status": dict(Counter(row.get("status", "failed") for row in rows)),
        "contradictions": [(row["seed"], row["wrong"]) for row in rows if row.get("wrong")],
        "failed": [(row["seed"], row["failed"]) for row in rows if "failed" in row],
        "seconds": round(sum(row.get("seconds", 0.0) for row in rows), 1),
    }


def main() -> int:
    """A line a case, then the sum; 1 where something contradicts."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=4.0, help="of one run at most")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for seed in range(options.first, options.first + options.cases):
        rows.append(judged(seed, 60.0 * options.minutes))
        print(json.dumps(rows[-1]), flush=True)
    text = json.dumps({"summed": summed(rows), "rows": rows}, indent=1)
    if options.out is not None:
        options.out.write_text(text + "\n")
    print(json.dumps(summed(rows), indent=1))
    return 1 if summed(rows)["contradictions"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
