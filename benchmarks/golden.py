"""Twenty solves and their ends: tests/data/golden.json, which tests/test_golden.py compares.

    python benchmarks/golden.py                # what is not there yet
    python benchmarks/golden.py --anew NAME    # these again, where an answer is meant to move
    python benchmarks/golden.py --others       # and how far J moves under other kernels

A case is a kind of inner problem or a case file, by one formulation. `identity` is the hash of
`problem.identity()`: where it moves, samples that people have stored are not found any more.
"""

import argparse
import json
import os
import subprocess
import sys
from dataclasses import replace
from time import process_time
from typing import Any

from processors import ROOT, available

sys.path.insert(0, str(ROOT / "tests"))

from kinds import kinds

import ccd_casadi as ccd
from ccd_casadi.fixed_structure import Sampling
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_problem import Uncertainty
from ccd_casadi.sampling.keys import problem_hash

FILE = ROOT / "tests/data/golden.json"
FILES = {
    "two_mass": "runs/two_mass.toml",
    "planar_stage": "examples/planar_stage/case.toml",
    "three_mass_axis": "examples/three_mass_axis/case.toml",
    "modal_table": "examples/modal_table/case.toml",
}
SMALL = {
    "nested": ccd.Nested(plan="sobol", points=4, box_points=4),
    "lifted": ccd.Lifted(points=8, box_points=4),
    "direct": ccd.Direct(starts=1, box_points=4),
}
WHOLE = {"nested": ccd.Nested(), "lifted": ccd.Lifted(), "direct": ccd.Direct()}
MIXED, SECTIONS = 1e-5, 1e-3  # relative, of J: processors and versions of libraries differ by less
THETA = 1e-2  # of the box: J is flat there


def problems() -> dict[str, CoDesignProblem]:
    """By name, what is solved."""
    found = kinds()
    sections = found["sections"].sections
    assert sections is not None
    for name, changes in {
        "set": {"uncertainty": Uncertainty(resonance_shift=0.03)},
        "sampled": {"sampling": Sampling(8000.0, 80.0)},
    }.items():
        other = replace(sections, **changes)  # type: ignore[arg-type]
        found[f"sections, {name}"] = replace(found["sections"], sections=other)
    for name, path in FILES.items():
        found[name] = ccd.problem_of(ccd.load_case(ROOT / path))
    return found


def cases() -> dict[str, tuple[str, str]]:
    """Name of a case -> problem and formulation."""
    every = {"mixed", "disturbance", "sections", "error", "two_mass"}
    pairs = [
        (name, way) for name in problems() for way in SMALL if name in every or way == "lifted"
    ]
    return {f"{name}, {way}": (name, way) for name, way in pairs}


def solved(case: str) -> dict[str, Any]:
    """What a case ends with."""
    name, way = cases()[case]
    problem, began = problems()[name], process_time()
    result = ccd.solve(problem, (WHOLE if name in FILES else SMALL)[way]).result
    return {
        "identity": problem_hash(problem.identity()),
        "status": result["status"],
        "objective": result["objective"],
        "theta": result["theta"],
        "tolerance": {
            "objective": MIXED if problem.sections is None else SECTIONS,
            "theta": [THETA * (b - a) for a, b in zip(problem.lower, problem.upper, strict=True)],
        },
        "seconds": round(process_time() - began, 1),
    }


def elsewhere(case: str, kernels: str) -> float:
    """J of a case in a process with OpenBLAS's kernels for another processor."""
    words = [sys.executable, __file__, "--one", case]
    env = os.environ | {"OPENBLAS_CORETYPE": kernels, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, env=env, cwd=ROOT, capture_output=True, text=True, check=True)
    return float(json.loads(done.stdout)["objective"])


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--anew", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--identities", action="store_true", help="no solves")
    parser.add_argument("--others", action="store_true")
    parser.add_argument("--one", metavar="NAME", help="print what this one ends with")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(solved(options.one)))
        return
    known: dict[str, Any] = json.loads(FILE.read_text()) if FILE.exists() else {}
    every = problems()
    for case, (name, _) in cases().items():  # cheap, and worth something alone
        known.setdefault(case, {"identity": problem_hash(every[name].identity())})
    if options.identities:
        FILE.write_text(json.dumps(known, indent=1) + "\n")
        return
    for case in cases():
        if "status" not in known[case] or case in options.anew:
            known[case] = solved(case)
        entry = known[case]
        if options.others and "moved" not in entry:
            J = [elsewhere(case, kernels) for kernels in available()]
            entry["moved"] = max(abs(value / entry["objective"] - 1.0) for value in J)
        known = {name: known[name] for name in cases() if name in known}
        FILE.write_text(json.dumps(known, indent=1) + "\n")
        print(
            f"{case}: {entry['status']}, {entry['objective']:.9g}, {entry['seconds']} s", flush=True
        )


if __name__ == "__main__":
    main()
