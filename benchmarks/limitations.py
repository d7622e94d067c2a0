"""Bounds on every controller beside designs of random problems: none may exceed its bound.

    OPENBLAS_NUM_THREADS=1 nice python benchmarks/limitations.py [--problems N] [--write]

The problems are the climbs of random_sections.py (chains of one to three masses, half of them
sampled), with the bounds that their designs keep. A row each: the design's ω_b, what a T in a
finite basis reaches (a controller of high order), and what the certificate forbids, in Hz.
"""

import argparse
import json
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from random_sections import HZ, WHOLE, case, climbed

from ccd_casadi.limitations.bound import inside, outside
from ccd_casadi.limitations.limits import limits_of


def row(seed: int) -> dict[str, Any] | None:
    """A problem's three bandwidths in Hz; None where the climb ends at no certified design."""
    asked, design = climbed(case(seed), seed)
    if design is None or not design.certified:
        return None
    uncertain, begun = asked.uncertain, perf_counter()
    limits = limits_of(
        uncertain.plant(uncertain.nominal).plant_si(), asked.bounds, asked.sampling,
        integrator=asked.structure.integrator,
    )  # fmt: skip
    most = outside(limits)
    between = perf_counter()
    found = {"design": design.bandwidth / HZ, "outside": most / HZ if most < np.inf else None}
    found |= {"inside": inside(limits, most) / HZ, "seconds_inside": perf_counter() - between}
    return {"seed": seed, **found, "seconds_outside": between - begun}


def main() -> None:
    arguments = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    arguments.add_argument("--problems", type=int, default=60)
    arguments.add_argument("--write", action="store_true", help="keep the rows in limitations.json")
    options = arguments.parse_args()
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
    widths = [one["outside"] / one["inside"] - 1.0 for one in bounded if one["inside"]]
    summary = {
        "problems": len(rows),
        "bounded": len(bounded),
        "refuted": len(refuted),
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
