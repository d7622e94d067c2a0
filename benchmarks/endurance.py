"""Whole solves for hours in one process: does memory grow, do files or threads stay open?

    OPENBLAS_NUM_THREADS=1 python benchmarks/endurance.py [--hours 2] [--trim] [--out FILE]

Every round is the command `solve` on a case that was not there before (bounds, weights, objective
drawn anew, formulations in turn, own plant file every fourth), in a folder of its own that is
deleted again, report and pictures included. After each the process's own memory, open files and
threads are noted; the figures go to benchmarks/endurance.json. Memory grows where the later three
quarters have a slope that is worth its scatter.
"""

import argparse
import contextlib
import ctypes
import gc
import io
import json
import random
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from ccd_casadi.solve import main as solve

ROOT = Path(__file__).parent.parent
RESULTS = Path(__file__).with_suffix(".json")
CASE = (ROOT / "runs" / "two_mass.toml").read_text()
QUICK = "\n[sampling]\npoints = 3\nlifted_points = 16\n[outer]\nstarts = 4\ndirect_starts = 2\n"
FORMULATIONS = ("lifted", "direct", "nested", "lifted")
PLANT = """
import casadi as ca

def model(theta, **options):
    m1, m2 = theta["m1"], theta["m2"]
    return dict(
        mass=ca.diag(ca.vertcat(m1, m2)), damping_ratio=0.01,
        stiffness={k} * ca.DM([[1, -1], [-1, 1]]), input=ca.DM([1, 0]), output=ca.DM([[1, 0]]),
        hardware_cost=m1 + m2,
    )
"""


def case_of(rng: random.Random, own_plant: bool, folder: Path) -> str:
    """A case that no round had before."""
    text = CASE.replace("M_K = 2e7", f"M_K = {rng.uniform(1e7, 4e7):.9g}")
    text = text.replace("w2 = -0.9950", f"w2 = {-rng.uniform(0.5, 2.0):.9g}")
    text = text.replace("lower = 55.0", f"lower = {rng.uniform(50.0, 58.0):.9g}")
    if own_plant:
        (folder / "plant.py").write_text(PLANT.format(k=f"{rng.uniform(0.8e8, 1.2e8):.9g}"))
        kept = [x for x in text.splitlines() if not x.startswith(("model = ", "zeta = "))]
        text = "\n".join(kept).replace("[plant]", '[plant]\nfunction = "plant.py:model"')
    return text + QUICK


def measured(trim: bool) -> dict[str, float]:
    """Memory of this process alone in MB, open files, threads; `trim`: freed pages given back."""
    gc.collect()
    if trim:
        ctypes.CDLL(None).malloc_trim(0)
    process = psutil.Process()
    return {
        "mb": process.memory_full_info().uss / 1e6,
        "files": process.num_fds(),
        "threads": threading.active_count(),
    }


def summed(rounds: list[dict[str, Any]], seed: int, seconds: float) -> dict[str, Any]:
    """Slope of memory over the later three quarters, with the standard error that it has."""
    later = rounds[len(rounds) // 4 :]
    x = np.arange(len(later), dtype=float)
    y = np.array([r["mb"] for r in later])
    (slope, _), covariance = np.polyfit(x, y, 1, cov=True)
    return {
        "seed": seed,
        "seconds": seconds,
        "solves": len(rounds),
        "exit_codes": dict(Counter(str(r["code"]) for r in rounds)),
        "mb_first": rounds[0]["mb"],
        "mb_after_a_quarter": float(y[: max(1, len(y) // 10)].mean()),
        "mb_last": float(y[-max(1, len(y) // 10) :].mean()),
        "kb_per_solve": 1e3 * float(slope),
        "kb_per_solve_standard_error": 1e3 * float(np.sqrt(covariance[0, 0])),
        "files": [min(r["files"] for r in later), max(r["files"] for r in later)],
        "threads": [min(r["threads"] for r in later), max(r["threads"] for r in later)],
    }


def main() -> None:
    """Solve until the time is over."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--trim", action="store_true", help="without what malloc keeps (glibc)")
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    rng, rounds, began = random.Random(options.seed), [], time.monotonic()
    while (spent := time.monotonic() - began) < 3600.0 * options.hours:
        number = len(rounds)
        with tempfile.TemporaryDirectory(prefix="endurance_") as name:
            folder = Path(name)
            (folder / "case.toml").write_text(case_of(rng, number % 4 == 3, folder))
            words = [str(folder / "case.toml"), "--out", str(folder / "run"), "--quiet"]
            words += ["--workers", "1", "--formulation", FORMULATIONS[number % 4]]
            with contextlib.redirect_stderr(io.StringIO()) as errors:
                code = solve(words)
        if code not in (0, 4):
            sys.exit(f"round {number} ended with {code}: {errors.getvalue()[-500:]}")
        rounds.append({"code": code} | measured(options.trim))
        if number >= 20 and number % 20 == 0:
            figures = summed(rounds, options.seed, spent)
            options.out.write_text(json.dumps(figures, indent=2) + "\n")
            left = options.hours * 60.0 - spent / 60.0
            print(f"{number} solves, {figures['mb_last']:.0f} MB, {left:.0f} min left", flush=True)
    figures = summed(rounds, options.seed, time.monotonic() - began)
    options.out.write_text(json.dumps(figures, indent=2) + "\n")
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
