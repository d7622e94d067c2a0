"""The tests under the kernels that OpenBLAS has for other processors, with examples drawn anew.

OpenBLAS picks its kernels by the processor; OPENBLAS_CORETYPE overrules it, and last digits move.

    python benchmarks/processors.py                          # the whole suite, three times each
    python benchmarks/processors.py --times 1 --kernels Haswell tests/kernels/test_balance.py
    python benchmarks/processors.py --other                  # CI: numerical tests, one other kernel
    python benchmarks/processors.py --times 1 --examples 10  # property tests, ten times as many

Every run has a seed of its own, which the table names: `pytest --hypothesis-seed=SEED` with
HYPOTHESIS_PROFILE=study and OPENBLAS_CORETYPE as in its line draws the same examples again. Ends
with 1 if anything failed. NumPy and SciPy have to come with OpenBLAS, as their wheels on x86 do.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
# what a processor must have for the kernels of that name, as /proc/cpuinfo says it
NEEDS = {
    "Prescott": {"pni"},
    "Sandybridge": {"avx"},
    "Haswell": {"avx2", "fma"},
    "Zen": {"avx2", "fma"},
    "SkylakeX": {"avx512f", "avx512dq", "avx512bw", "avx512vl"},
}
# what hangs on last digits, for CI: half a minute on two cores
NUMERICAL = (
    "test_backends.py",
    "test_balance.py",
    "test_derivatives.py",
    "test_gamma_search.py",
    "test_gradient_parts.py",
    "test_kernel_parts.py",
    "test_loop_gains.py",
    "test_robust_design.py",
    "test_surrogate_casadi.py",
)
PROBE = """
import numpy, scipy.linalg
from threadpoolctl import threadpool_info
scipy.linalg.schur(numpy.random.default_rng(0).random((40, 40)))
found = {x.get("architecture") for x in threadpool_info() if x["internal_api"] == "openblas"}
print(",".join(sorted(map(str, found))))
"""


@dataclass(frozen=True)
class Run:
    """One run of the tests: kernels, seed, counts and the names of what failed."""

    kernels: str
    seed: int
    passed: int
    failed: tuple[str, ...]
    seconds: float


def architecture(kernels: str | None) -> str | None:
    """What OpenBLAS says it uses (of NumPy and of SciPy), None where it does not run."""
    env = {k: v for k, v in os.environ.items() if k != "OPENBLAS_CORETYPE"}
    env |= {"OPENBLAS_CORETYPE": kernels} if kernels else {}
    done = subprocess.run(
        [sys.executable, "-c", PROBE], env=env, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or None if done.returncode == 0 else None


def flags() -> set[str]:
    """The processor's abilities; none where the system does not tell."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    return next((set(x.split(":")[1].split()) for x in lines if x.startswith("flags")), set())


def available() -> dict[str, str]:
    """The kernels that this machine can run, and what OpenBLAS calls them.

    "Katmai" is Prescott's other name; wheels build Zen from Haswell's kernels.
    """
    able = flags()
    required = {name: architecture(name) for name, needs in NEEDS.items() if needs <= able}
    return {name: found for name, found in required.items() if found}


def run_tests(
    kernels: str, seed: int, jobs: int, tests: Sequence[str], examples: int | None = None
) -> Run:
    """The suite, or the tests named, in a process of its own."""
    env = os.environ | {"OPENBLAS_CORETYPE": kernels, "HYPOTHESIS_PROFILE": "study"}
    env |= {"HYPOTHESIS_TIMES": str(examples or 1)}
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        words = [sys.executable, "-m", "pytest", "-n", str(jobs), "--dist", "worksteal"]
        words += ["-p", "no:cacheprovider", f"--hypothesis-seed={seed}", f"--junitxml={report}"]
        words += ["-m", "hypothesis and not slow"] if examples else []
        words += tests
        began = time.monotonic()
        done = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
        seconds = time.monotonic() - began
        cases = list(ElementTree.parse(report).iter("testcase")) if report.exists() else []
    wrong = [c for c in cases if c.find("failure") is not None or c.find("error") is not None]
    failed = tuple(f"{c.get('classname', '').split('.')[-1]}::{c.get('name')}" for c in wrong)
    if done.returncode not in (0, 1) or (done.returncode and not failed):
        failed = (*failed, f"pytest ended with {done.returncode}")
    if failed:
        print(done.stdout[-20000:], flush=True)  # with the examples that failed
    skipped = sum(c.find("skipped") is not None for c in cases)
    return Run(kernels, seed, len(cases) - len(wrong) - skipped, failed, seconds)


def other(found: dict[str, str]) -> list[str]:
    """The kernels furthest from the machine's own: Prescott's have neither AVX nor FMA."""
    own = architecture(None)
    return [name for name in NEEDS if name in found and found[name] != own][:1]


def table(runs: Sequence[Run]) -> str:
    """One line a run."""
    lines = ["| kernels | seed | passed | failed | seconds |", "|---|---|---|---|---|"]
    lines += [
        f"| {r.kernels} | {r.seed} | {r.passed} | {', '.join(r.failed) or '-'} | {r.seconds:.0f} |"
        for r in runs
    ]
    return "\n".join(lines)


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tests", nargs="*", help="files, as for pytest (default: the whole suite)")
    parser.add_argument("--kernels", nargs="+", choices=list(NEEDS), help="these only")
    parser.add_argument("--times", type=int, default=3, help="runs for each (default: 3)")
    parser.add_argument("--seed", type=int, default=0, help="of the first run (default: 0)")
    parser.add_argument("--jobs", type=int, default=2, help="processes of pytest (default: 2)")
    parser.add_argument(
        "--examples", type=int, help="property tests alone, with that many times the examples"
    )
    parser.add_argument(
        "--other", action="store_true", help="the numerical tests once, under one other kernel"
    )
    options = parser.parse_args()
    found, times, tests = available(), options.times, options.tests
    names = [name for name in found if options.kernels is None or name in options.kernels]
    if options.other:
        names, times = other(found), 1
        tests = tests or [str(next((ROOT / "tests").rglob(name))) for name in NUMERICAL]
    if not names:
        print("no other kernels can be run here: nothing to compare")
        return 0
    if not options.other:
        print(f"this machine: {architecture(None)}; {', '.join(f'{k}: {found[k]}' for k in names)}")
    runs: list[Run] = []
    for number in range(times):
        for place, name in enumerate(names):
            seed = options.seed + number * len(names) + place
            runs.append(run_tests(name, seed, options.jobs, tests, options.examples))
            print(table(runs[-1:]).splitlines()[-1], flush=True)
    if len(runs) > 1:
        print(table(runs))
    failed = sum(bool(run.failed) for run in runs)
    print(f"{len(runs)} runs, {failed} with failures")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
