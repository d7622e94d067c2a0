"""How often the truth at fresh θ lies within 1, 2 and 3 sigma of what a run's surrogate predicts.

Each case is sampled at θ of a Sobol set and fitted as `solve` does it, with several seeds; then the
inner problem is solved at θ that neither has seen. Printed are the shares within 1, 2 and 3 of the
deviations as they are promised (68.3, 95.4, 99.7 % of a normal distribution) and without their
calibration. Writes predicted_coverage.json. About six minutes of processor time.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.nested import fit_bandwidth
from ccd_casadi.codesign.outer import Outer
from ccd_casadi.codesign.run import outer_of
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers
from surrogates import design
from surrogates.fitting import recalibrate

ROOT = Path(__file__).parents[1]
CASES = (  # case, whether its surrogate has gradients, samples
    ("runs/two_mass.toml", False, 25),
    ("runs/two_mass.toml", False, 12),
    ("examples/modal_table/case.toml", False, 25),
    ("runs/two_mass_built.toml", True, 12),
    ("runs/two_mass_built.toml", False, 9),
)
FRESH, SEEDS = 24, (0, 1, 2)


def misses(outer: Outer, gradients: bool, points: int, seed: int) -> tuple[list[float], float]:
    """(truth - prediction)/sigma at fresh θ, the band not in sigma, and that band."""
    sampler = outer.sampler
    problem, bounds = sampler.problem, box(sampler.problem)
    samples = sampler.values(design("sobol", *bounds, points, seed))
    able = [sample for sample in samples if sample.feasible]
    process = recalibrate(fit_bandwidth(problem, able, seed, gradients=gradients), seed)
    fresh = [one for one in sampler.values(design("lhs", *bounds, FRESH, 99)) if one.feasible]
    mean, std = process.predict(np.array([one.theta for one in fresh]), return_std=True)
    sigma = np.maximum(std / process.band, 1e-7 * np.abs(mean))  # what the truth itself is good for
    return ((np.array([one.value for one in fresh]) - mean) / sigma).tolist(), process.band


def main() -> None:
    """All cases and seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=len(CASES), help="the first so many")
    rows = []
    print("case                            samples  gradients  seed   band  within 1, 2, 3 sigma")
    for place, gradients, points in CASES[: parser.parse_args().cases]:
        case = load_case(ROOT / place)
        for seed in SEEDS:
            with (
                tempfile.TemporaryDirectory() as folder,
                SampleStore(Path(folder) / "samples.sqlite") as store,
                Workers(1) as workers,
                threadpool_limits(limits=1),
            ):
                problem = problem_of(case)
                outer = outer_of(Sampler(problem, store, workers)).prepare(seed)
                found, band = misses(outer, gradients, points, seed)
            z = np.abs(found)
            shares = [[float((z <= k * b).mean()) for k in (1, 2, 3)] for b in (band, 1.0)]
            rows.append({"case": place, "gradients": gradients, "samples": points, "seed": seed,
                         "band": band, "within": shares[0], "without_band": shares[1],
                         "misses": found})  # fmt: skip
            words = " ".join(f"{100.0 * share:5.1f}" for share in (*shares[0], *shares[1]))
            head = f"{place:32s}{points:7d}{gradients!s:>11s}{seed:6d}{band:7.2f}"
            print(f"{head}  {words}", flush=True)
    for name in ("within", "without_band"):
        print(name, np.mean([row[name] for row in rows], axis=0).round(3).tolist())
    (ROOT / "benchmarks" / "predicted_coverage.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
