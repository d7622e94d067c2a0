"""Retraining against a fixed design: syntheses until the surrogates' optimum is the true one.

Both start from the same 16 Sobol designs of (θ, ω_S, ω_T) and fit the same surrogates. The fixed
design is doubled; retraining adds a batch at a time. Counted are the designs sampled when
the predicted J and the true J at the predicted optimum are first within 0.1 % of the verified
optimum's, with S_max and S_low met to 0.1 %; for retraining also when it stopped by itself, which
it does without knowing the optimum, and what the verification added.

    python benchmarks/retraining.py [--seeds N] [--out benchmarks/retraining.json]
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

from ccd_casadi.codesign.acquisition import (
    Posterior,
    objective_and_violation,
    predicted_optimum,
)
from ccd_casadi.codesign.retrained_run import CoDesignTruth
from ccd_casadi.codesign.retraining import STARTS, Settings, retrain, thinned
from ccd_casadi.codesign.truth import Truth
from ccd_casadi.codesign.versions import load_version, version_names
from ccd_casadi.retrain import open_run
from surrogates import GaussianProcess, fit_outputs, sobol

ROOT = Path(__file__).parent.parent
CASES = ("two_mass", "two_mass_paper")
CLOSE = 1e-3
FIRST, LARGEST = 16, 256


def reached(truth: CoDesignTruth, x: np.ndarray, predicted: float, optimum: float) -> bool:
    """Whether a predicted optimum is the true one; one synthesis that is not counted."""
    found = truth.evaluate(x[None, :])
    J, violation = objective_and_violation(truth, found.X, found.Y)
    errors = np.abs(np.array([predicted, J[0]]) / optimum - 1.0)
    return bool(errors.max() <= CLOSE and violation[0] <= CLOSE)


def opened(folder: Path, case: str):
    folder.mkdir(parents=True)
    shutil.copy(ROOT / "runs" / f"{case}.toml", folder / "case.toml")
    return open_run(folder, tolerance=None, workers=1, seed=0, quiet=True)


def retrained(folder: Path, case: str, seed: int) -> dict[str, float | str | None]:
    with opened(folder, case) as truth:
        truth.evaluate(sobol(truth.lower, truth.upper, FIRST, seed))
        began = perf_counter()
        outcome = retrain(folder, truth, Settings(seed=seed))
        seconds = perf_counter() - began
    result = json.loads((folder / "result.json").read_text())
    counts = [len(load_version(folder, name)[0].X) for name in version_names(folder)]
    return {
        "status": outcome.status,
        "reason": outcome.reason,
        "objective": result["objective"],
        "fitted": counts,
        "syntheses": FIRST + outcome.spent,
        "rounds": outcome.rounds,
        "seconds": seconds,
    }


def predicts(truth: Truth, surrogates: tuple[GaussianProcess, ...], optimum: float) -> bool:
    """Whether the optimum of surrogates of a truth is the true one."""
    width = truth.upper - truth.lower
    samples = truth.evaluate(truth.lower + width * surrogates[0].X)
    posterior = Posterior(truth, surrogates, samples, np.empty((0, len(width))))
    best = samples.X[posterior.incumbent() or 0]
    starts = np.vstack([best, sobol(truth.lower, truth.upper, STARTS, 0)])
    found = predicted_optimum(posterior, starts)
    return found is not None and reached(truth, *found, optimum)


def count_until(folder: Path, copy: Path, case: str, optimum: float) -> int | None:
    """Designs that the first version was fitted to whose predicted optimum is the true one."""
    with opened(copy, case) as truth:
        for name in version_names(folder):
            surrogates = load_version(folder, name)
            if predicts(truth, surrogates, optimum):
                return len(surrogates[0].X)
    return None


def fixed(folder: Path, case: str, seed: int, optimum: float) -> int | None:
    n = FIRST
    while n <= LARGEST:
        with opened(folder / str(n), case) as truth:
            truth.evaluate(sobol(truth.lower, truth.upper, n, seed))
            observed, _ = thinned(truth, truth.samples())
            surrogates = fit_outputs(
                observed.X, observed.Y, observed.dY, lower=truth.lower, upper=truth.upper, starts=2
            )
            if predicts(truth, surrogates, optimum):
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
            runs = []
            for seed in range(options.seeds):
                runs.append(retrained(Path(name) / case / f"r{seed}", case, seed))
            optimum = min(run["objective"] for run in runs)
            for seed, run in enumerate(runs):
                place = Path(name) / case
                row = {"case": case, "seed": seed, **run, "optimum": optimum}
                row["loss"] = run["objective"] / optimum - 1.0
                known = place / f"r{seed}"
                row["retrained_until"] = count_until(known, place / f"c{seed}", case, optimum)
                row["fixed_until"] = fixed(place / f"f{seed}", case, seed, optimum)
                table.append(row)
                print(json.dumps(row), flush=True)
    options.out.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
