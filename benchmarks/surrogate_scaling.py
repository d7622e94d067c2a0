"""Fit and evaluation time of a process against samples (100 to 2,500) and inputs (2 to 20).

The evaluation is what an NLP solver calls: the value with its gradient, and the Hessian. Prints a
table and writes surrogate_scaling.json beside this file; leaves with 1 if 1,000 samples of 8
inputs take more than 2 ms with derivatives.
"""

import argparse
import json
from pathlib import Path
from time import perf_counter

import casadi as ca
import numpy as np
from threadpoolctl import threadpool_limits

from surrogates import design, fit, to_casadi

HERE = Path(__file__).parent
SAMPLES = (100, 300, 1000, 2500)
INPUTS = (2, 4, 8, 14, 20)
LIMIT_MS = 2.0


def main() -> None:
    """Tabulate times and errors over samples and inputs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, nargs="*", default=SAMPLES)
    parser.add_argument("--inputs", type=int, nargs="*", default=INPUTS)
    arguments = parser.parse_args()
    rows = []
    print(
        f"{'n':>6}{'d':>4} {'fit s':>8}{'rms/std':>10}{'cover':>7}"
        f"{'export s':>9}{'value+grad ms':>14}{'Hessian ms':>12}"
    )
    with threadpool_limits(limits=1):
        for n in arguments.samples:
            for d in arguments.inputs:
                rows.append(measure(n, d))
                text = json.dumps(rows, indent=1) + "\n"  # after each: they take long
                (HERE / "surrogate_scaling.json").write_text(text)
    named = [row for row in rows if (row["samples"], row["inputs"]) == (1000, 8)]
    slow = [row for row in named if row["gradient_ms"] > LIMIT_MS or row["hessian_ms"] > LIMIT_MS]
    raise SystemExit(bool(slow))


def measure(n, d):
    """One row: fit, export and evaluation of n samples of d inputs."""
    low, high = np.zeros(d), np.ones(d)
    X, T = design("lhs", low, high, n, seed=1), design("lhs", low, high, 1000, seed=9)
    Y, truth = smooth(X), smooth(T)
    began = perf_counter()
    s = fit(X, Y, lower=low, upper=high, noise=1e-6 * Y.std(), starts=1)
    fitted = perf_counter() - began
    mean, std = s.predict(T, return_std=True)
    error = mean - truth
    began = perf_counter()
    x = ca.MX.sym("x", d)
    y = to_casadi(s, std=False)(x)
    gradient = ca.Function("g", [x], [y, ca.gradient(y, x)])
    hessian = ca.Function("h", [x], [ca.hessian(y, x)[0]])
    exported = perf_counter() - began
    row = {
        "samples": n,
        "inputs": d,
        "fit_s": fitted,
        "relative_rms": float(np.sqrt(np.mean(error**2)) / truth.std()),
        "coverage": float(np.mean(np.abs(error) <= 1.96 * std)),
        "export_s": exported,
        "gradient_ms": milliseconds(gradient, T),
        "hessian_ms": milliseconds(hessian, T),
    }
    print(
        f"{n:>6}{d:>4} {row['fit_s']:>8.2f}{row['relative_rms']:>10.1e}"
        f"{row['coverage']:>7.3f}{row['export_s']:>9.3f}{row['gradient_ms']:>14.3f}"
        f"{row['hessian_ms']:>12.3f}",
        flush=True,
    )
    return row


def milliseconds(function, points):
    """The median time of one call."""
    times = []
    for point in points[:60]:
        began = perf_counter()
        function(point)
        times.append(perf_counter() - began)
    return 1e3 * float(np.median(times))


def smooth(X):
    """A function that all inputs act on, the first ones most."""
    w = 2.0 / (1.0 + np.arange(X.shape[1]))
    return np.sin(X @ w) + (X @ w[::-1]) ** 2 / X.shape[1] + 0.3 * np.exp(-4 * X[:, 0] * X[:, 1])


if __name__ == "__main__":
    main()
