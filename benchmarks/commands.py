"""What a person waits for: start, commands and first compilation, each in a process of its own.

    python benchmarks/commands.py [--long] [--compile]

Seconds of real time and of processor time (with all worker processes), beside those recorded last
in results.json, which is then brought up to date. `--long` adds the finite-element stage and the
beam (minutes), `--compile` a new machine: the kernels into an empty cache, and the first solve of
packages without one, as after a clone or `pip install`, whose own downloads are not counted.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).with_name("results.json")
REPEATS = 3  # of what takes a second or less: the best counts
ASKED = {  # seconds
    "compile_kernels": 60.0,
    "first_solve": 60.0,
    "import_solve": 0.6,
    "help": 0.4,
    "solve_two_mass": 2.5,
    "solve_rib_stage": 60.0,
    "robustness_rib_stage": 120.0,
    "robustness_beam": 60.0,
}


def timed(words: Sequence[str], folder: Path, path: Path) -> tuple[float, float]:
    """Real and processor seconds of `python words`, its children included."""
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    # as for a person, whose Python keeps the bytecode of what it has compiled once
    kept = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment = kept | {"PYTHONPATH": str(path)}
    subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, check=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - began, spent


def without_caches(folder: Path, *words: str) -> tuple[float, float]:
    """A command of a copy of the packages whose kernels are not compiled yet."""
    for package in ("ccd_casadi", "surrogates"):
        shutil.copytree(
            ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    return timed(["-m", *words], folder, folder)


def rows(long: bool, compile_: bool, folder: Path) -> dict[str, tuple[float, float]]:
    """(real, processor) seconds by name, the best of a few where it is short."""

    def command(name: str, *words: object) -> tuple[float, float]:
        return timed(["-m", f"ccd_casadi.{name}", *map(str, words)], folder, ROOT)

    found = {
        "import_solve": min(
            timed(["-c", "import ccd_casadi.solve"], folder, ROOT) for _ in range(REPEATS)
        ),
        "help": min(command("solve", "--help") for _ in range(REPEATS)),
    }

    def solved(case: Path, out: str) -> tuple[float, float]:
        return command("solve", case, "--formulation", "lifted", "--out", folder / out)

    two_mass = ROOT / "runs" / "two_mass.toml"
    found["solve_two_mass"] = min(solved(two_mass, f"two_mass{i}") for i in range(REPEATS))
    if long:
        found["solve_rib_stage"] = solved(ROOT / "runs" / "rib_stage.toml", "rib_stage")
        found["robustness_rib_stage"] = command("robustness", folder / "rib_stage")
        solved(ROOT / "benchmarks" / "beam" / "case.toml", "beam")
        found["robustness_beam"] = command("robustness", folder / "beam")
    if compile_:
        found["compile_kernels"] = without_caches(folder / "fresh", "ccd_casadi.kernels")
        words = ["ccd_casadi.solve", str(two_mass), "--formulation", "lifted"]
        found["first_solve"] = without_caches(folder / "new", *words)
    return found


def main() -> None:
    """Print the table and bring results.json up to date."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--long", action="store_true", help="the commands that take minutes")
    arguments.add_argument("--compile", action="store_true", help="the kernels into an empty cache")
    options = arguments.parse_args()
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    with TemporaryDirectory() as folder:
        found = rows(options.long, options.compile, Path(folder))
    print(f"{'seconds':24s}{'real':>9s}{'last':>9s}{'asked':>9s}{'processor':>11s}{'last':>9s}")
    for name, required in ASKED.items():
        real, spent = found.get(name, (None, None))
        cells = (real, known.get(f"s_{name}"), required, spent, known.get(f"cpu_s_{name}"))
        widths = (9, 9, 9, 11, 9)
        text = "".join(
            f"{'-' if cell is None else format(cell, '.3g'):>{width}s}"
            for cell, width in zip(cells, widths, strict=True)
        )
        print(f"{name:24s}{text}")
        if real is not None:
            known |= {f"s_{name}": real, f"cpu_s_{name}": spent}
    RESULTS.write_text(json.dumps(known, indent=2) + "\n")


if __name__ == "__main__":
    main()
