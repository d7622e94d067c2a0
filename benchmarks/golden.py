"""Twenty solves and their ends: tests/data/golden.json, which test_golden.py compares.

    python benchmarks/golden.py                # what is not there yet
    python benchmarks/golden.py --anew NAME    # these again, where an answer is meant to move
    python benchmarks/golden.py --others       # how far J and θ move under other kernels

The cases are those of tests/oracles/golden.py.
"""

import argparse
import json
import os
import subprocess
import sys
from typing import Any

from processors import ROOT, available

sys.path += [str(ROOT), str(ROOT / "tests")]

from oracles.golden import FILE, apart, cases, solved


def elsewhere(case: str, kernels: str) -> dict[str, Any]:
    """The same in a process with OpenBLAS's kernels for another processor."""
    words = [sys.executable, __file__, "--one", case]
    env = os.environ | {"OPENBLAS_CORETYPE": kernels, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(words, env=env, cwd=ROOT, capture_output=True, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--anew", nargs="*", default=[], metavar="NAME")
    parser.add_argument("--others", action="store_true")
    parser.add_argument("--one", metavar="NAME", help="print what this one ends with")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(solved(options.one)))
        return
    known: dict[str, Any] = json.loads(FILE.read_text()) if FILE.exists() else {}
    for case in cases():
        if case not in known or case in options.anew:
            known[case] = solved(case)
            table = {name: known[name] for name in cases() if name in known}
            FILE.write_text(json.dumps(table, indent=1) + "\n")
        words = f"{case}: {known[case]['status']}, {known[case]['objective']:.9g}"
        if options.others:
            ends = {name: elsewhere(case, name) for name in available()}
            shares = {name: f"{apart(known[case], end):.1e}" for name, end in ends.items()}
            words += f", of the tolerance {shares}"
        print(words, flush=True)


if __name__ == "__main__":
    main()
