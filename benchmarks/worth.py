"""`ccd worth` against full solves: is its gain right to 3 % on the shipped cases, and its estimate?

Both are held against the same sequential design, in % of its hardware cost and bandwidth. `miss` is
by how much the full solve is better at equal hardware cost, `stated` what worth expected of it.

    python benchmarks/worth.py [CASE.toml ...] [--solved DIR] [--workers N] [--out FILE.json]

DIR holds folders of finished solves, named as the case (its folder, where that is `case.toml`);
what is not there is solved here.
"""

import argparse
import json
import tempfile
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from typing import Any

import ccd_casadi as ccd
from ccd_casadi.support.command_line import usable_cores
from ccd_casadi.support.errors import UserError
from ccd_casadi.worth import main as worth

ROOT = Path(__file__).parent.parent
CASES = ("runs/two_mass.toml", "runs/two_mass_paper.toml", "runs/two_mass_built.toml",
         "runs/rib_stage.toml", *(f"examples/{name}/case.toml" for name in (
             "guided_beam", "planar_stage", "three_mass_axis", "two_axes", "modal_table",
             "cad_stage", "gantry_stroke")))  # fmt: skip
COLUMNS = ("case", "worth", "full solve", "expected cost", "expected Hz", "miss", "stated", "CPU s")


def spent() -> float:
    """CPU seconds of this process and of those that it has ended."""
    parts = [getrusage(who) for who in (RUSAGE_SELF, RUSAGE_CHILDREN)]
    return sum(part.ru_utime + part.ru_stime for part in parts)


def full_solve(case: Path, name: str, solved: Path | None, workers: int) -> dict[str, Any]:
    """result.json of a finished solve, or of one that is made here."""
    result = None if solved is None else solved / name / "result.json"
    if result is not None and result.is_file():
        return dict(json.loads(result.read_text()))
    return ccd.solve(ccd.problem_of(ccd.load_case(case)), workers=workers).result


def compared(case: Path, solved: Path | None, workers: int) -> list[str]:
    """A row of the table."""
    name, began = case.parent.name if case.stem == "case" else case.stem, spent()
    with tempfile.TemporaryDirectory() as place:
        if worth([str(case), "--out", place, "--workers", str(workers), "--quiet"]):
            raise UserError(f"{case}: worth found nothing")
        seconds = spent() - began
        found = json.loads((Path(place) / "worth.json").read_text())
    result, old, new = (
        full_solve(case, name, solved, workers),
        found["sequential"],
        found["co_design"],
    )
    problem = ccd.problem_of(ccd.load_case(case))
    better = problem.w1 * (new["hardware_cost"] - result["hardware_cost"]) + problem.w2 * ccd.HZ * (
        new["bandwidth_hz"] - result["bandwidth_hz"]
    )
    keys = ("hardware_cost", "bandwidth_hz")
    full = ", ".join(f"{100.0 * (result[key] / old[key] - 1.0):+z.2f}" for key in keys)
    ours = ", ".join(f"{found[f'{key}_percent']:+z.2f}" for key in ("hardware_cost", "bandwidth"))
    ends = [
        " to ".join(f"{end:+z.2f}" for end in found[f"full_solve_{key}_percent"])
        for key in ("hardware_cost", "bandwidth")
    ]
    miss = 100.0 * better / abs(problem.w2) / ccd.HZ / old["bandwidth_hz"]
    stated = f"{found['uncertainty_percent']:.3f}{'' if found['settled'] else ' (not settled)'}"
    return [name, ours, full, *ends, f"{miss:z.3f}", stated, f"{seconds:.1f}"]


def main() -> None:
    """Print the table as Markdown."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("cases", nargs="*", type=Path)
    arguments.add_argument("--solved", type=Path)
    arguments.add_argument("--workers", type=int, default=usable_cores())
    arguments.add_argument("--out", type=Path)
    options = arguments.parse_args()
    rows = []
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    for case in options.cases or [ROOT / name for name in CASES]:
        try:
            rows.append(compared(case.resolve(), options.solved, options.workers))
        except (UserError, KeyError, TypeError) as error:
            print(f"| {case} | {error!r} |", flush=True)
            continue
        print(f"| {' | '.join(rows[-1])} |", flush=True)
    if options.out:
        kept = [dict(zip(COLUMNS, row, strict=True)) for row in rows]
        options.out.write_text(json.dumps(kept, indent=1))


if __name__ == "__main__":
    main()
