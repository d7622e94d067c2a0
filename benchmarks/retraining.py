"""Retraining against a fixed design: syntheses until the surrogates' optimum is the true one.

Retraining starts from nothing. The fixed design is a Sobol set of (θ, ω_S, ω_T), doubled from 16
until the optimum of the surrogates fitted to it is right: predicted and true J there within 0.1 %
of the verified optimum's.

    python benchmarks/retraining.py [--seeds N] [--out benchmarks/retraining.json]
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from time import perf_counter

from threadpoolctl import threadpool_limits

import ccd_casadi as ccd
from ccd_casadi.codesign.formulations import solve_lifted
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers
from surrogates import load
from surrogates.retrain import main as retrain

ROOT = Path(__file__).parent.parent
CASES = ("two_mass", "two_mass_paper")
CLOSE = 1e-3
FIRST, LARGEST = 16, 256


def retrained(folder: Path, case: Path, seed: int) -> dict[str, float | str]:
    folder.mkdir(parents=True)
    shutil.copy(case, folder / "case.toml")
    began = perf_counter()
    code = retrain([str(folder), "--workers", "1", "--quiet", "--seed", str(seed)])
    result = json.loads((folder / "result.json").read_text())
    fitted = len(load(folder / "surrogate.json")[0][0].X)
    return {
        "code": code, "status": result["status"], "reason": result["retraining"]["reason"],
        "objective": result["objective"], "fitted": fitted, "syntheses": result["syntheses"],
        "seconds": perf_counter() - began,
    }  # fmt: skip


def fixed(case: Path, seed: int, optimum: float) -> int | None:
    """Designs of a Sobol set whose surrogates' optimum is the true one."""
    problem, n = ccd.problem_of(ccd.load_case(case)), FIRST
    while n <= LARGEST:
        with (
            tempfile.TemporaryDirectory() as place,
            Workers(1) as pool,
            SampleStore(Path(place) / "samples.sqlite") as store,
        ):
            options = ccd.Lifted(points=n, max_refinements=0)
            found = solve_lifted(Sampler(problem, store, pool, quiet=True), options, seed=seed)
        for round_ in found.iterates:
            J = (round_.predicted_objective, round_.objective)
            if max(abs(value / optimum - 1.0) for value in J) <= CLOSE:
                return n
        n *= 2
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    options = parser.parse_args()
    table = []
    with tempfile.TemporaryDirectory() as name, threadpool_limits(limits=1):
        for case in CASES:
            path = ROOT / "runs" / f"{case}.toml"
            runs = [retrained(Path(name) / case / str(seed), path, seed)
                    for seed in range(options.seeds)]  # fmt: skip
            optimum = min(float(run["objective"]) for run in runs)
            for seed, run in enumerate(runs):
                row = {"case": case, "seed": seed, **run, "optimum": optimum}
                row["loss"] = float(run["objective"]) / optimum - 1.0
                row["fixed_until"] = fixed(path, seed, optimum)
                table.append(row)
                print(json.dumps(row), flush=True)
    options.out.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
