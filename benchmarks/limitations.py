"""Bounds on every controller beside designs of random problems: none may exceed its bound.

    OPENBLAS_NUM_THREADS=1 nice python benchmarks/limitations.py [--problems N] [--write]
    OPENBLAS_NUM_THREADS=1 nice python benchmarks/limitations.py --shipped

The problems are the climbs of random_sections.py (chains of one to three masses, half of them
sampled), with the bounds that their designs keep. A row each: the design's ω_b, what a T in a
finite basis reaches (a controller of high order), and what the certificate forbids on the model and
on the set, by its pairs of opposite corners, in Hz.
`--shipped`: the designs of shipped_designs.json and of rib_stage_design instead, with the
bound at their θ.
"""

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np
import rib_stage_built as rib
import shipped_designs as designs
from random_sections import HZ, WHOLE, case, climbed

from ccd_casadi.cases.case import load_case, parse_theta
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.limitations.bound import lower_bound, upper_bound
from ccd_casadi.limitations.limits import limits_of
from ccd_casadi.limitations.of_problem import Gap, gap_of, opposite_corners
from ccd_casadi.support.errors import UserError


def row(seed: int) -> dict[str, Any] | None:
    """A problem's three bandwidths in Hz; None where the climb ends at no certified design."""
    asked, design = climbed(case(seed), seed)
    if design is None or not design.certified:
        return None
    uncertain, begun = asked.uncertain, process_time()
    limits = limits_of(
        uncertain.plant(uncertain.nominal).plant_si(), asked.bounds, asked.sampling,
        integrator=asked.structure.integrator,
    )  # fmt: skip
    pairs = opposite_corners(uncertain, asked.bounds, asked.sampling, asked.structure.integrator)
    most = upper_bound(limits)
    between = process_time()
    on_set = min(map(upper_bound, pairs), default=np.inf)
    after = process_time()
    found = {
        "seed": seed,
        "design": design.bandwidth / HZ,
        "outside": most / HZ if most < np.inf else None,
        "on_set": on_set / HZ if on_set < np.inf else None,
        "inside": lower_bound(limits, most) / HZ,
    }
    return found | {
        "seconds_outside": between - begun,
        "seconds_on_set": after - between,
        "seconds_inside": process_time() - after,
    }


def shipped() -> None:
    """A line for each shipped design: its ω_b and what no controller reaches at its θ."""
    for name, kept in json.loads(designs.RESULTS.read_text()).items():
        if kept["bandwidth_hz"] is None:
            continue
        with TemporaryDirectory() as folder:
            case = load_case(designs.placed(name, Path(folder)))
            begun = process_time()
            try:
                found = gap_of(problem_of(case), parse_theta(case, kept["theta"]), within=False)
            except UserError as unknown:
                print(name, unknown)
                continue
        show(name, kept["bandwidth_hz"], found, process_time() - begun)
    kept = json.loads((rib.DESIGN / "inner.json").read_text())
    problem = problem_of(load_case(designs.ROOT / "runs" / "rib_stage_built.toml"))
    begun = process_time()
    bound = gap_of(problem, rib.theta_of(rib.DESIGN), within=False)
    show("rib_stage_design", kept["bandwidth_hz"], bound, process_time() - begun)


def show(name: str, hz: float, found: Gap, seconds: float) -> None:
    """Over its bound a design would refute it."""
    most = found.upper_bound / HZ
    print(f"{name}: {hz:.2f} Hz, bound {most:.2f} Hz, gap {100.0 * (most / hz - 1.0):.0f} %, "
          f"{seconds:.1f} s of a processor{', REFUTED' if hz > most else ''}",
          flush=True)  # fmt: skip


def main() -> None:
    arguments = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    arguments.add_argument("--problems", type=int, default=60)
    arguments.add_argument("--write", action="store_true", help="keep the rows in limitations.json")
    arguments.add_argument("--shipped", action="store_true")
    options = arguments.parse_args()
    if options.shipped:
        shipped()
        return
    rows: list[dict[str, Any]] = []
    seed = 0
    while len(rows) < options.problems:
        seed += 1
        found = row(seed) if seed % WHOLE else None
        if found is not None:
            rows.append(found)
            print(found, flush=True)
    bounded = [one for one in rows if one["outside"] is not None]
    refuted = [one for one in bounded if max(one["design"], one["inside"]) > one["outside"]]
    sets = [one for one in rows if one["on_set"] is not None]
    refuted += [one for one in sets if one["design"] > one["on_set"]]
    gains = [1.0 - one["on_set"] / one["outside"] for one in sets if one["outside"]]
    widths = [one["outside"] / one["inside"] - 1.0 for one in bounded if one["inside"]]
    summary = {
        "problems": len(rows),
        "bounded": len(bounded),
        "refuted": len(refuted),
        "on_set": len(sets),
        "on_set_below": dict(zip(("50", "100"), np.quantile(gains, (0.5, 1.0)), strict=True)),
        "with_inside": len(widths),
        "width": dict(zip(("50", "90", "100"), np.quantile(widths, (0.5, 0.9, 1.0)), strict=True)),
        "seconds_outside": float(np.median([one["seconds_outside"] for one in bounded])),
    }
    print(json.dumps(summary, indent=1))
    if options.write:
        text = json.dumps({"summary": summary, "rows": rows}, indent=1)
        Path(__file__).with_suffix(".json").write_text(f"{text}\n")


if __name__ == "__main__":
    main()
