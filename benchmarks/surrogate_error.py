"""Error of plain and gradient-enhanced surrogates against the number of true syntheses.

The lifted data of case study 1: ω_b, ln‖S‖∞ and ln|S(jω_low)| over (m1, m2, ln ω_S, ln ω_T),
judged on 1,000 unseen designs. ‖S‖∞ is the larger of two local peaks, and kinked where they are
equal. Prints a table, writes surrogate_error.json beside this file.
"""

import json
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.support.units import HZ
from surrogates import design, fit_outputs

HERE = Path(__file__).parent
COUNTS = (16, 24, 32, 48, 64, 128, 256)
UNSEEN = 1000
KINDS = ("plain", "gradient")
Z95 = 1.959963984540054


def main() -> None:
    """Sample, fit both kinds at each count, compare on the same unseen designs."""
    problem = problem_of(load_case(HERE.parent / "runs" / "two_mass.toml"))
    lower, upper = lifted_bounds(problem)
    rows = []
    with (
        tempfile.TemporaryDirectory() as folder,
        SampleStore(Path(folder) / "samples.sqlite") as store,
        Workers(1) as workers,
        threadpool_limits(limits=1),
    ):
        sampler = Sampler(problem, store, workers)
        unseen = sampler.quantities(design("lhs", lower, upper, UNSEEN, seed=99))
        X = np.array([sample.x for sample in unseen])
        Y = np.array([sample.values[:3] for sample in unseen])
        print(" syntheses      kind   ω_b, Hz   ‖S‖∞, % |S_low|, %  fit, s  cover")
        for count in COUNTS:
            samples = sampler.quantities(design("sobol", lower, upper, count, seed=0))
            for kind in KINDS:
                if kind != "plain" and count > 128:
                    continue  # 5 x 256 observations add nothing to the comparison
                row = _row(samples, X, Y, lower, upper, count, kind)
                rows.append(row)
                print(
                    f"{count:10d} {row['kind']:>9} {row['bandwidth_hz']:9.4f} "
                    f"{row['peak_percent']:9.3f} {row['low_percent']:10.4f} {row['seconds']:7.2f}  "
                    + " ".join(f"{share:.3f}" for share in row["covered"])
                )
    ratios = {name: _ratio(rows, name) for name in ("bandwidth_hz", "peak_percent", "low_percent")}
    print("share of the plain one's syntheses that the gradients need for its error:", ratios)
    answer = {"rows": rows, "share_of_syntheses": ratios}
    (HERE / "surrogate_error.json").write_text(json.dumps(answer, indent=2) + "\n")


def _row(samples, X, Y, lower, upper, count, kind):
    began = perf_counter()
    points = np.array([sample.x for sample in samples])
    values = np.array([sample.values[:3] for sample in samples])
    slopes = np.array([sample.gradients[:3] for sample in samples])
    options = {"lower": lower, "upper": upper, "seed": 0, "starts": 1}
    surrogates = fit_outputs(points, values, None if kind == "plain" else slopes, **options)
    seconds = perf_counter() - began
    both = [surrogate.predict(X, return_std=True) for surrogate in surrogates]
    error = np.array([mean for mean, _ in both]).T - Y
    rms = np.sqrt((error**2).mean(axis=0))
    inside = np.abs(error) <= Z95 * np.array([std for _, std in both]).T
    return {
        "syntheses": count,
        "kind": kind,
        "bandwidth_hz": rms[0] / HZ,
        "peak_percent": 100.0 * rms[1],
        "low_percent": 100.0 * rms[2],
        "covered": inside.mean(axis=0).tolist(),
        "seconds": seconds,
    }


def _ratio(rows, name):
    """The share of the plain one's syntheses with which gradients reach its error, at worst."""
    plain = {row["syntheses"]: row[name] for row in rows if row["kind"] == "plain"}
    enhanced = {row["syntheses"]: row[name] for row in rows if row["kind"] == "gradient"}
    shares = []
    for count, error in plain.items():
        enough = [other for other, value in enhanced.items() if value <= error]
        if enough and count >= 2 * min(enhanced):
            shares.append(min(enough) / count)
    return max(shares)


if __name__ == "__main__":
    main()
