"""Do the three formulations agree? Seeded random problems of 2 to 4 parameters, all lines counted.

`python benchmarks/formulations_agree.py --problems 60 [--first 0] [--grid 20] [--out FILE.json]`:
each chain of `chain_plants` is solved by nested, lifted and direct in memory. Printed: J and the
lines of the verdict that did not pass, how many problems agree within 0.1 %, and whether any design
that is worse by more is called verified. `--grid N` compares those of the first N problems of two
parameters with true inner problems on a grid over θ. What the file of `--out` holds already is not
computed again.

With `--kinds` the chains are in turn of every kind of mixed sensitivity (with the reference alone,
with disturbances, on a robust set, with a bound on the compliance), `--formulations lifted direct`
leaves nested out. Printed last is the share of designs that are not verified, by the line of the
verdict that failed.
"""

import argparse
import json
import sys
from collections import Counter
from dataclasses import replace
from itertools import count, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

import ccd_casadi as ccd
from ccd_casadi.inner_problem.controller_problem import RobustSet
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of, true_inner
from ccd_casadi.plants.plant import hardware_cost

sys.path += [str(Path(__file__).parents[1] / folder) for folder in (".", "tests")]

from oracles.chain_plants import chain_problem

AGREE = 1e-3  # relative
SIDE = 15  # points a side of the grid over θ
KINDS = ("reference", "disturbance", "robust", "compliance")


def of_kind(problem: CoDesignProblem, kind: str, seed: int) -> CoDesignProblem:
    """The problem with disturbances in its synthesis, a set of plants, or ‖GS‖∞ bounded."""
    rng = np.random.default_rng([seed, 3])
    if kind == "disturbance":
        force = problem.weights.M_K * float(np.exp(rng.uniform(np.log(1.0), np.log(30.0))))
        return replace(problem, weights=replace(problem.weights, disturbance=force))
    if kind == "robust":
        shift = float(rng.uniform(0.002, 0.02))
        return replace(problem, robust=RobustSet(shift, 3, (), float(rng.choice([0.0, shift]))))
    if kind == "compliance":
        required = replace(problem, inner=replace(problem.inner, compliance_max=1e300))
        best = true_inner(required, problem.start).optimum
        if best is not None:
            most = float(best.figures.compliance * rng.uniform(0.5, 1.2))
            return replace(problem, inner=replace(problem.inner, compliance_max=most))
    return problem


def formulations(parameters: int) -> tuple[Any, ...]:
    """The defaults, but for nested: a Sobol plan, as a grid of five would be large, and two rounds.

    What is compared are the ends; nested's kinks cost thousands of syntheses with twelve rounds.
    """
    nested = ccd.Nested(plan="sobol", points=8 * parameters, max_refinements=2)
    return nested, ccd.Lifted(), ccd.Direct()


def solved(seed: int, store: Path, kind: str, names: list[str]) -> dict[str, Any]:
    """One problem by all formulations; what they all look at is computed once, in `store`."""
    problem = of_kind(chain_problem(seed), kind, seed)
    found: dict[str, Any] = {}
    for formulation in formulations(len(problem.names)):
        name = type(formulation).__name__.lower()
        if name not in names:
            continue
        began = process_time()
        result = ccd.solve(problem, formulation, seed=0, store=store).result
        found[name] = {"status": result["status"], "cpu_seconds": process_time() - began}
        if result["status"] == "infeasible":
            continue
        lines = {key: line["state"] for key, line in result["verdict"].items()}
        found[name] |= {
            "objective": result["objective"],
            "kkt": result["kkt"]["stationarity"],
            "before_look": result["box_look"].get("before"),
            "syntheses": result["syntheses"],
            "theta": result["theta"],
            "lines": lines,
            "reason": result["reason"],
        }
    return {"seed": seed, "kind": kind, "parameters": len(problem.names), "formulations": found}


def on_grid(problem: CoDesignProblem) -> dict[str, Any]:
    """The best true inner problem of `SIDE` by `SIDE` over the box of two parameters."""
    began = process_time()
    axes = [np.linspace(low, high, SIDE) for low, high in zip(*box(problem), strict=True)]
    best: dict[str, Any] = {"objective": np.inf, "feasible": 0}
    for theta in np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2):
        inner = true_inner(problem, tuple(theta))
        if np.isfinite(inner.bandwidth):
            J = problem.w1 * hardware_cost(plant_of(problem), theta) + problem.w2 * inner.bandwidth
            best["feasible"] += 1
            if best["objective"] > J:
                best |= {"objective": J, "theta": theta.tolist()}
    return best | {"cpu_seconds": process_time() - began}


def worse_than_grid(row: dict[str, Any]) -> list[str]:
    """Formulations of one row that are worse than the grid by more than they may disagree."""
    best = row["grid"]["objective"] if "grid" in row else np.inf
    if not np.isfinite(best):
        return []
    found = {n: item.get("objective", np.inf) for n, item in row["formulations"].items()}
    level = best + AGREE * abs(best)
    return [name for name, J in found.items() if level < J]


def not_verified(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of the designs that were found, the share that is not verified; by kind and failed line."""
    designs = [
        (row.get("kind", KINDS[0]), name, item)
        for row in rows
        for name, item in row["formulations"].items()
        if "lines" in item
    ]
    failed: Counter[str] = Counter()
    for kind, name, item in designs:
        for line, state in item["lines"].items():
            if state == "failed":
                failed[f"{kind} {name}: {line}"] += 1
    count = sum(item["status"] != "verified" for _, _, item in designs)
    share = count / max(len(designs), 1)
    return {"designs": len(designs), "not_verified": count, "share": share, "by_line": failed}


def judged(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Agreement over all rows; infeasible ones count as agreeing where all say so."""
    agree, false_verified, lost, unlooked, lines = 0, [], [], 0, Counter()
    for row in rows:
        found = row["formulations"]
        J = {name: item["objective"] for name, item in found.items() if "objective" in item}
        if not J:
            agree += 1
            continue
        best = min(J.values())
        worse = [name for name, value in J.items() if value > best + AGREE * abs(best)]
        missing = [name for name in found if name not in J]
        agree += not worse and not missing
        false_verified += [(row["seed"], n) for n in worse if found[n]["status"] == "verified"]
        lost += [(row["seed"], n) for n in (*worse, *missing)]
        unlooked += any(
            item["before_look"] > best + AGREE * abs(best)
            for item in found.values()
            if item.get("before_look") is not None
        )
        for item in found.values():
            lines.update(
                f"{name} {state}"
                for name, state in item.get("lines", {}).items()
                if state in ("failed", "warned")
            )
    return {
        "problems": len(rows),
        "agree": agree,
        "disagreed_before_the_look": unlooked,
        "worse_or_missing": lost,
        "worse_and_called_verified": false_verified,
        "lines": dict(lines),
        "not_verified": not_verified(rows),
        "grids": sum("grid" in row for row in rows),
        "worse_than_grid": [(row["seed"], name) for row in rows for name in worse_than_grid(row)],
        "cpu_seconds": sum(i["cpu_seconds"] for row in rows for i in row["formulations"].values()),
    }


def printed(row: dict[str, Any]) -> None:
    """One line a formulation, one of the grid."""
    for name, item in row["formulations"].items():
        bad = [f"{k}:{v}" for k, v in item.get("lines", {}).items() if v in ("failed",)]
        print(
            f"{row['seed']:4d} {row.get('kind', KINDS[0])[:7]:7s} {row['parameters']} {name:7s} "
            f"{item['status']:12s} "
            f"J {item.get('objective', np.nan):14.6f} "
            f"before {item.get('before_look') or np.nan:14.6f} "
            f"kkt {item.get('kkt', np.nan):.0e} {item.get('syntheses', 0):5d} "
            f"{item['cpu_seconds']:5.1f} s {' '.join(bad)} {item.get('reason', '')[:70]}",
            flush=True,
        )
    if "grid" in row:
        grid = row["grid"]
        print(
            f"{row['seed']:4d}   grid {'':15s} J {grid['objective']:14.6f} "
            f"{' '.join(worse_than_grid(row))} {grid['cpu_seconds']:.1f} s",
            flush=True,
        )


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--grid", type=int, default=0)
    parser.add_argument("--kinds", action="store_true")
    names = ("nested", "lifted", "direct")
    parser.add_argument("--formulations", nargs="+", choices=names, default=names)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows: dict[int, dict[str, Any]] = {}
    if options.out and options.out.exists():
        rows = {row["seed"]: row for row in json.loads(options.out.read_text())["rows"]}
    two = (seed for seed in count() if len(chain_problem(seed).names) == 2)
    planar = list(islice(two, options.grid))
    last = options.first + options.problems
    for seed in range(options.first, last):
        if seed not in rows:
            with TemporaryDirectory() as folder:
                kind = KINDS[seed % len(KINDS) if options.kinds else 0]
                store = Path(folder) / "samples.sqlite"
                rows[seed] = solved(seed, store, kind, options.formulations)
        if seed in planar and "grid" not in rows[seed]:
            rows[seed]["grid"] = on_grid(chain_problem(seed))
        printed(rows[seed])
        if options.out:
            ordered = [rows[seed] for seed in sorted(rows)]
            answer = {"judged": judged(ordered), "rows": ordered}
            options.out.write_text(json.dumps(answer, indent=1) + "\n")
    print(json.dumps(judged([rows[seed] for seed in sorted(rows)]), indent=1))


if __name__ == "__main__":
    main()
