"""Do the three formulations agree? Seeded random problems of 2 to 4 parameters, all lines counted.

`python benchmarks/formulations_agree.py --problems 60 [--first 0] [--out FILE.json]`: each chain of
`chain_plants` is solved by nested, lifted and direct in memory. Printed: J and the lines of the
verdict that did not pass, how many problems agree within 0.1 %, and whether any design that is
worse by more is called verified.
"""

import argparse
import json
from collections import Counter
from pathlib import Path
from time import perf_counter
from typing import Any

from chain_plants import chain_problem

import ccd_casadi as ccd

AGREE = 1e-3  # relative


def formulations(parameters: int) -> tuple[Any, ...]:
    """The defaults, but for nested: a Sobol plan, as a grid of five would be large, and two rounds.

    What is compared are the ends; nested's kinks cost thousands of syntheses with twelve rounds.
    """
    nested = ccd.Nested(plan="sobol", points=8 * parameters, max_refinements=2)
    return nested, ccd.Lifted(), ccd.Direct()


def solved(seed: int) -> dict[str, Any]:
    """One problem by all formulations."""
    problem = chain_problem(seed)
    found: dict[str, Any] = {}
    for formulation in formulations(len(problem.names)):
        name = type(formulation).__name__.lower()
        began = perf_counter()
        result = ccd.solve(problem, formulation, seed=0).result
        found[name] = {"status": result["status"], "seconds": perf_counter() - began}
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
    return {"seed": seed, "parameters": len(problem.names), "formulations": found}


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
    }


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--problems", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    for seed in range(options.first, options.first + options.problems):
        row = solved(seed)
        rows.append(row)
        for name, item in row["formulations"].items():
            bad = [f"{k}:{v}" for k, v in item.get("lines", {}).items() if v in ("failed",)]
            print(
                f"{seed:4d} {row['parameters']} {name:7s} {item['status']:12s} "
                f"J {item.get('objective', float('nan')):14.6f} "
                f"before {item.get('before_look') or float('nan'):14.6f} "
                f"kkt {item.get('kkt', float('nan')):.0e} {item.get('syntheses', 0):5d} "
                f"{item['seconds']:5.1f} s {' '.join(bad)} {item.get('reason', '')[:70]}",
                flush=True,
            )
        if options.out:
            answer = {"judged": judged(rows), "rows": rows}
            options.out.write_text(json.dumps(answer, indent=1) + "\n")
    print(json.dumps(judged(rows), indent=1))


if __name__ == "__main__":
    main()
