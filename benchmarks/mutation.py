"""Mutation testing of the numerical core: a seeded sample of mutants, and which the tests kill.

    python benchmarks/mutation.py --mutants 150 --seed 0

Each mutant is one changed operator, comparison, constant or condition in a copy of the sources;
the tests of its module run on it until one fails. Kernels run as plain Python (`interpreted`), as
compiling each mutant would take minutes. Results go to benchmarks/mutation.json after every
mutant; the same command goes on from there. Survivors are listed for reading.
"""

import argparse
import ast
import copy
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).with_suffix(".json")
LIMIT = 200  # s of processor time for one test file; an endless loop counts as killed

KERNEL_TESTS = (
    ("tests/test_weights.py", ""),
    ("tests/test_certificate.py", ""),
    ("tests/test_synthesis.py", "published or prototype or guess or sweep or unmeasured"),
    ("tests/test_sensitivity.py", ""),
    ("tests/test_synthesis.py", "units or lower_bound or coordinates"),
    ("tests/test_channels.py", "not stage"),
    ("tests/test_synthesis.py", "flexible_plants_are_certified and not sixty"),
)
GRADIENT_TESTS = (
    ("tests/test_derivatives.py", "prototype or fixed_controller or sharp or drown"),
    ("tests/test_derivatives.py", "both_limits"),
)
STORE_TESTS = (
    ("tests/test_samples.py", ""),
    ("tests/test_damaged_stores.py", ""),
    ("tests/test_sampling.py", ""),
)
PLANT_TESTS = (
    ("tests/test_plant.py", ""), ("tests/test_weights.py", ""), ("tests/test_channels.py", ""),
    ("tests/test_synthesis.py", ""), ("tests/test_certificate.py", ""),
    ("tests/test_sensitivity.py", ""), ("tests/test_derivatives.py", ""),
)  # fmt: skip
TARGETS: dict[str, tuple[tuple[str, str], ...]] = {
    **{
        f"ccd_casadi/kernels/{name}.py": KERNEL_TESTS
        for name in (
            "riccati", "gamma", "certificate", "closed_loop", "generalized_plant", "frequency",
            "sensitivity", "design", "refine",
        )
    },
    **{
        f"ccd_casadi/kernels/{name}.py": GRADIENT_TESTS
        for name in ("gradients", "pullback", "bound_peak")
    },
    **{
        f"ccd_casadi/{name}.py": PLANT_TESTS
        for name in ("modal", "scaling", "synthesis", "closed_loop", "weights", "derivatives")
    },
    "ccd_casadi/samples.py": STORE_TESTS,
    "ccd_casadi/sampling.py": STORE_TESTS,
}  # fmt: skip
SWAPS: dict[type, type] = {
    ast.Lt: ast.GtE, ast.LtE: ast.Lt, ast.Gt: ast.LtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Pow: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
CALLS = {"min": "max", "max": "min"}


@dataclass(frozen=True)
class Mutant:
    """One change: file, line, what it was and what it became; `index` counts the file's sites."""

    path: str
    index: int
    line: int
    before: str
    after: str


def sites(tree: ast.Module) -> Iterator[tuple[ast.AST, ast.AST]]:
    """(node, its mutated copy) of every place that can be changed, in order."""
    skipped = _texts_and_types(tree)
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        changed = _mutated(node)
        if changed is not None:
            yield node, changed


def _mutated(node: ast.AST) -> ast.AST | None:
    new = copy.deepcopy(node)
    if isinstance(new, ast.Compare) and type(new.ops[0]) in SWAPS:
        new.ops[0] = SWAPS[type(new.ops[0])]()
    elif isinstance(new, ast.BinOp | ast.AugAssign | ast.BoolOp) and type(new.op) in SWAPS:
        new.op = SWAPS[type(new.op)]()
    elif isinstance(new, ast.UnaryOp) and isinstance(new.op, ast.USub | ast.Not):
        new = new.operand  # type: ignore[assignment]
    elif isinstance(new, ast.Constant) and type(new.value) in (int, float):
        new.value = 2 * new.value + 1
    elif isinstance(new, ast.Call) and isinstance(new.func, ast.Name) and new.func.id in CALLS:
        new.func.id = CALLS[new.func.id]
    elif isinstance(new, ast.If | ast.While):
        new.test = ast.UnaryOp(ast.Not(), new.test)
    else:
        return None
    return new


def _texts_and_types(tree: ast.Module) -> set[int]:
    """Annotations and raised messages: what changes there changes no number."""
    found: set[int] = set()
    for node in ast.walk(tree):
        parts: list[ast.AST | None] = []
        if isinstance(node, ast.FunctionDef):
            parts = [node.returns, *(a.annotation for a in node.args.args + node.args.kwonlyargs)]
        elif isinstance(node, ast.AnnAssign):
            parts = [node.annotation]
        elif isinstance(node, ast.Raise | ast.Assert):
            parts = [node]
        for part in parts:
            if part is not None:
                found |= {id(inner) for inner in ast.walk(part)}
    return found


def mutants(path: str) -> list[tuple[Mutant, str]]:
    """Every mutant of a file with its source text."""
    tree = ast.parse((ROOT / path).read_text())
    found = []
    for index, (node, changed) in enumerate(sites(tree)):
        place = _Replace(node, changed)
        text = ast.unparse(ast.fix_missing_locations(place.visit(copy.copy(tree))))
        place.undo()
        before, after = (ast.unparse(part).split("\n")[0][:90] for part in (node, changed))
        found.append((Mutant(path, index, getattr(node, "lineno", 0), before, after), text))
    return found


class _Replace(ast.NodeTransformer):
    """Puts `new` where `old` stands, and back: the tree is shared by all mutants."""

    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self.old, self.new = old, new
        self.places: list[tuple[ast.AST, str, int | None]] = []

    def visit(self, node: ast.AST) -> ast.AST:
        for name, value in ast.iter_fields(node):
            if value is self.old:
                setattr(node, name, self.new)
                self.places.append((node, name, None))
            elif isinstance(value, list):
                for i, item in enumerate(value):
                    if item is self.old:
                        value[i] = self.new
                        self.places.append((node, name, i))
                    elif isinstance(item, ast.AST):
                        self.visit(item)
            elif isinstance(value, ast.AST):
                self.visit(value)
        return node

    def undo(self) -> None:
        for node, name, i in self.places:
            if i is None:
                setattr(node, name, self.old)
            else:
                getattr(node, name)[i] = self.old


def judge(mutant: Mutant, text: str, work: Path) -> tuple[str, str, float]:
    """'killed' or 'survived', by which test file, in how many seconds."""
    target = work / mutant.path
    original = target.read_text()
    began = time.perf_counter()
    target.write_text(text)
    try:
        for file, words in TARGETS[mutant.path]:
            if not _passes(work, mutant.path, file, words):
                return "killed", file, time.perf_counter() - began
    finally:
        target.write_text(original)
    return "survived", "", time.perf_counter() - began


def _passes(work: Path, path: str, file: str, words: str) -> bool:
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", file]
    if words:
        command += ["-k", words]
    if "/kernels/" in path:
        command[3:3] = ["-p", "interpreted"]
    environment = os.environ | {
        "PYTHONPATH": f"{work}{os.pathsep}{work / 'benchmarks'}",
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    done = subprocess.run(
        command,
        cwd=work,
        env=environment,
        capture_output=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (LIMIT, LIMIT)),
    )
    return done.returncode == 0


def main() -> None:
    """Sample, judge, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutants", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    everything = [item for path in TARGETS for item in mutants(path)]
    rng = random.Random(options.seed)
    sample = rng.sample(everything, min(options.mutants, len(everything)))
    known = json.loads(RESULTS.read_text())["mutants"] if RESULTS.exists() else []
    done = {(item["path"], item["before"], item["after"], item["line"]): item for item in known}
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder) / "work"
        shutil.copytree(
            ROOT, work, ignore=shutil.ignore_patterns(".venv", ".git", "site", "runs/*/")
        )
        began = time.perf_counter()
        for count, (mutant, text) in enumerate(sample, 1):
            key = (mutant.path, mutant.before, mutant.after, mutant.line)
            if key not in done:
                verdict, by, seconds = judge(mutant, text, work)
                done[key] = asdict(mutant) | {"verdict": verdict, "by": by, "seconds": seconds}
                _write(options, len(everything), [done[k] for k in done])
                left = (time.perf_counter() - began) / count * (len(sample) - count)
                change = f"{mutant.path}:{mutant.line} {mutant.before} -> {mutant.after}"
                times = f"{seconds:.0f} s, {left / 60:.0f} min left"
                print(f"{count}/{len(sample)} {verdict:8} {change} ({times})", flush=True)
    killed = sum(item["verdict"] == "killed" for item in done.values())
    print(f"{killed} of {len(done)} mutants killed ({100.0 * killed / len(done):.1f} %)")


def _write(options: argparse.Namespace, total: int, found: list[dict[str, object]]) -> None:
    killed = sum(item["verdict"] == "killed" for item in found)
    RESULTS.write_text(
        json.dumps(
            {"seed": options.seed, "sites": total, "killed": killed, "mutants": found}, indent=1
        )
        + "\n"
    )


if __name__ == "__main__":
    main()
