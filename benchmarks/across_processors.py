"""Is the answer the same on other processors? Whole solves under each of OpenBLAS's kernels.

    python benchmarks/across_processors.py                            # small cases, all kernels
    python benchmarks/across_processors.py --cases rib_stage --kernels Prescott Haswell SkylakeX

Same case, same seed: status, θ and ω_b are compared with those under the first kernels, relative
to 1e-6. What is done is kept in across_processors.json; the same command goes on from there. Ends
with 1 where answers differ. `--table` prints the table only.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from processors import NEEDS, ROOT, available

FILE = Path(__file__).with_suffix(".json")
SAME = 1e-6
CASES = {
    "two_mass, lifted": ("runs/two_mass.toml", "lifted"),
    "two_mass, nested": ("runs/two_mass.toml", "nested"),
    "two_mass, direct": ("runs/two_mass.toml", "direct"),
    "planar_stage": ("examples/planar_stage/case.toml", "lifted"),
    "three_mass_axis": ("examples/three_mass_axis/case.toml", "lifted"),
    "modal_table": ("examples/modal_table/case.toml", "lifted"),
    "rib_stage": ("runs/rib_stage.toml", "lifted"),
}


def solved(case: str, kernels: str, workers: int) -> dict[str, Any]:
    """One solve in a process of its own: status, theta, bandwidth and objective."""
    path, formulation = CASES[case]
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "ccd_casadi.solve", str(ROOT / path), "--quiet"]
        words += ["--out", folder, "--formulation", formulation, "--workers", str(workers)]
        env = os.environ | {"OPENBLAS_CORETYPE": kernels}
        began = time.monotonic()
        done = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
        seconds = round(time.monotonic() - began, 1)
        file = Path(folder) / "result.json"
        if not file.exists():
            return {"status": f"exit {done.returncode}: {done.stderr[-200:]}", "seconds": seconds}
        found = json.loads(file.read_text())
    keys = ("status", "theta", "bandwidth_hz", "objective")
    return {key: found.get(key) for key in keys} | {"seconds": seconds}


def difference(one: dict[str, Any], other: dict[str, Any]) -> float:
    """The largest relative difference of θ and of ω_b; infinite where the verdict differs."""
    if one["status"] != other["status"] or not one.get("theta"):
        return float("inf")
    pairs = [(one["theta"][name], other["theta"][name]) for name in one["theta"]]
    pairs.append((one["bandwidth_hz"], other["bandwidth_hz"]))
    return max(abs(a - b) / max(abs(a), abs(b), 1e-300) for a, b in pairs)


def table(done: dict[str, dict[str, Any]]) -> tuple[str, bool]:
    """A line for each case, and whether all answers are the same."""
    lines = ["| case | kernels | verdict | ω_b, Hz | largest relative difference |"]
    lines += ["|---|---|---|---|---|"]
    same = True
    for case in CASES:
        runs = {name: done[f"{case}/{name}"] for name in NEEDS if f"{case}/{name}" in done}
        if not runs:
            continue
        first = next(iter(runs.values()))
        largest = max((difference(first, run) for run in runs.values()), default=0.0)
        same = same and largest <= SAME
        verdicts = ", ".join(dict.fromkeys(str(run["status"]) for run in runs.values()))
        bandwidth = first.get("bandwidth_hz")
        shown = f"{bandwidth:.6f}" if bandwidth else "-"
        lines.append(f"| {case} | {', '.join(runs)} | {verdicts} | {shown} | {largest:.1e} |")
    return "\n".join(lines), same


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    small = [name for name in CASES if name != "rib_stage"]
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=small)
    parser.add_argument("--kernels", nargs="+", choices=list(NEEDS), default=list(NEEDS))
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--table", action="store_true", help="what is known, and no more solves")
    parser.add_argument("--anew", action="store_true", help="forget what is known of these")
    options = parser.parse_args()
    done: dict[str, dict[str, Any]] = json.loads(FILE.read_text()) if FILE.exists() else {}
    able = {} if options.table else available()
    for case in options.cases:
        for name in [name for name in options.kernels if name in able]:
            key = f"{case}/{name}"
            if key not in done or options.anew:
                done[key] = solved(case, name, options.workers)
                FILE.write_text(json.dumps(done, indent=1) + "\n")
                print(f"{key}: {done[key]['status']}, {done[key]['seconds']:.0f} s", flush=True)
    words, same = table(done)
    print(words)
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main())
