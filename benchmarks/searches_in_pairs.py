"""Structured searches of two trees of this project on the same random chains: better, worse, time.

    OPENBLAS_NUM_THREADS=1 python benchmarks/searches_in_pairs.py --other TREE [--problems N]

The problems are those of benchmarks/structured_peers.py, each searched from the same 12 starts.
TREE is another checkout, in which only what is compared should differ. Every problem runs in a
process of each tree, one after the other, so that both meet the same load. What --out holds is not
run again.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
ORACLES = HERE.parent / "tests"
EQUAL = 1e-3  # relative: bandwidths of one optimum
CODE = """
import json, sys, time
sys.path.insert(0, sys.argv[1])
from ccd_casadi.fixed_structure import synthesise_sections
from oracles.random_sections import case
assert sys.modules["ccd_casadi"].__file__.startswith(sys.argv[2])
for line in sys.stdin:
    seed = int(line)
    asked = case(seed)
    plants = asked.uncertain.plants(asked.uncertain.corners())
    began = time.process_time()
    made = synthesise_sections(plants, asked.structure, asked.bounds, sampling=asked.sampling,
                               starts=12, seed=0)
    hz = made.bandwidth / 6.283185307179586 if made.certified else 0.0
    row = {"hz": hz, "seconds": time.process_time() - began, "loops": made.evaluations}
    print(json.dumps(row), flush=True)
"""


def process(tree: Path) -> subprocess.Popen[str]:
    """One that answers seeds with the package of a tree."""
    return subprocess.Popen(
        [sys.executable, "-c", CODE, str(ORACLES), str(tree)], stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, text=True, cwd=tree, env=os.environ | {"PYTHONPATH": str(tree)},
    )  # fmt: skip


def answer(worker: subprocess.Popen[str], seed: int) -> dict[str, Any]:
    """Of one process to a seed."""
    assert worker.stdin
    assert worker.stdout
    print(seed, file=worker.stdin, flush=True)
    row: dict[str, Any] = json.loads(worker.stdout.readline())
    return row


def main() -> None:
    """Every pair, a line each, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--other", type=Path, required=True)
    parser.add_argument("--problems", type=int, default=40)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    sys.path.insert(0, str(HERE))
    from structured_peers import problems

    lines = options.out.read_text().splitlines() if options.out.exists() else []
    rows = {row["seed"]: row for row in map(json.loads, lines)}
    trees = {"here": process(HERE.parent), "other": process(options.other)}
    with options.out.open("a") as file:
        for seed, _ in problems(options.problems):
            if seed in rows:
                continue
            rows[seed] = {"seed": seed} | {name: answer(one, seed) for name, one in trees.items()}
            print(json.dumps(rows[seed]), file=file, flush=True)
            print(seed, *(f"{rows[seed][name]['hz']:.4f} Hz" for name in trees), flush=True)
    hz = {name: np.array([row[name]["hz"] for row in rows.values()]) for name in trees}
    ratio = (hz["here"] + 1e-9) / (hz["other"] + 1e-9)
    seconds = {name: sum(row[name]["seconds"] for row in rows.values()) for name in trees}
    print(json.dumps({
        "problems": len(rows),
        "certified": {name: int((found > 0.0).sum()) for name, found in hz.items()},
        "better": int((ratio > 1.0 + EQUAL).sum()),
        "worse": int((ratio < 1.0 - EQUAL).sum()),
        "geometric_mean_of_both": float(np.exp(np.log(ratio[np.minimum(*hz.values()) > 0]).mean())),
        "processor_seconds": seconds,
    }, indent=1))  # fmt: skip


if __name__ == "__main__":
    main()
