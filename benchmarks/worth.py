"""`ccd worth` against full solves: is its gain right to 3 % on the shipped cases, and in what time?

Both are held against the same sequential design. The difference is of cost and bandwidth, each in
% of the sequential design's.

    python benchmarks/worth.py [CASE.toml ...] [--workers N] [--out benchmarks/worth.json]
"""

import argparse
import json
import tempfile
from pathlib import Path
from time import perf_counter, process_time

import ccd_casadi as ccd
from ccd_casadi.support.command_line import usable_cores
from ccd_casadi.support.errors import UserError
from ccd_casadi.worth import main as worth

ROOT = Path(__file__).parent.parent
CASES = ("runs/two_mass.toml", "runs/two_mass_paper.toml", "runs/two_mass_built.toml",
         *(f"examples/{name}/case.toml" for name in (
             "guided_beam", "planar_stage", "three_mass_axis", "two_axes",
             "modal_table")))  # fmt: skip
COLUMNS = ("case", "cost %", "solve", "Hz %", "solve ", "± %", "syntheses", "s", "solve's s")


def compared(case: Path, workers: int) -> list[str | float]:
    """A row of the table."""
    with tempfile.TemporaryDirectory() as place:
        began = perf_counter()
        given = [str(case), "--out", place, "--workers", str(workers), "--quiet"]
        if worth(given):
            raise UserError(f"{case}: worth found nothing")
        spent = perf_counter() - began
        found = json.loads((Path(place) / "worth.json").read_text())
    began = perf_counter()
    solved = ccd.solve(ccd.problem_of(ccd.load_case(case)), workers=workers).result
    old = found["sequential"]
    truth = [100.0 * (solved[key] / old[key] - 1.0) for key in ("hardware_cost", "bandwidth_hz")]
    return [
        str(case.relative_to(ROOT)), found["hardware_cost_percent"], truth[0],
        found["bandwidth_percent"], truth[1], found["uncertainty_percent"], found["syntheses"],
        spent, perf_counter() - began,
    ]  # fmt: skip


def main() -> None:
    """Print the table as Markdown."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("cases", nargs="*", type=Path)
    arguments.add_argument("--workers", type=int, default=usable_cores())
    arguments.add_argument("--out", type=Path)
    options = arguments.parse_args()
    rows = []
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}")
    for case in options.cases or [ROOT / name for name in CASES]:
        began = process_time()
        try:
            rows.append(compared(case.resolve(), options.workers))
        except (UserError, KeyError, TypeError) as error:
            print(f"| {case} | {error!r} |", flush=True)
            continue
        row = [f"{v:.1f}" if isinstance(v, float) else str(v) for v in rows[-1]]
        print(
            f"| {' | '.join(row)} |  <!-- {process_time() - began:.0f} CPU s here -->", flush=True
        )
    if options.out:
        options.out.write_text(
            json.dumps([dict(zip(COLUMNS, r, strict=True)) for r in rows], indent=1)
        )


if __name__ == "__main__":
    main()
