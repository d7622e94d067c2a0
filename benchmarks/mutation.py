"""Mutation testing of the numerical core: a seeded sample of mutants, and which the tests kill.

    python benchmarks/mutation.py --mutants 150 --seed 0
    python benchmarks/mutation.py --survivors --tests tests/plants/test_plant.py    # these again

Each mutant is one changed operator, comparison, constant or condition in a copy of the sources;
the tests of its group (`mutation_tests`) run on it until one fails, the cheapest first. Kernels
run as plain Python (`interpreted`), as compiling each mutant would take minutes. The sources as
they are have to pass first: tests that fail on these would kill everything. A mutant that takes
four times the processor time of the unchanged sources, and 30 s more, is counted as timed out.

Results go to benchmarks/mutation.json after every mutant; the same command goes on from there. A
mutant is known by its function and what changes there, so that edits elsewhere leave the sample
as it is. Survivors are for reading: what they are is written in their field "why" by hand, and
"earlier" keeps what was said of a mutant before the tests that survivors led to.
"""

import argparse
import ast
import copy
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from mutation_tests import GROUPS, Group

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).with_suffix(".json")
MEMORY = 6 << 30  # bytes: a mutant may ask for any array
SWAPS: dict[type, type] = {
    ast.Lt: ast.GtE, ast.LtE: ast.Lt, ast.Gt: ast.LtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Pow: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
CALLS = {"min": "max", "max": "min"}
SCOPES = (ast.FunctionDef, ast.ClassDef)


@dataclass(frozen=True)
class Mutant:
    """One change: in which file and function, the how-manyth of its kind there, and the line."""

    path: str
    scope: str
    before: str
    after: str
    nth: int
    line: int

    @property
    def key(self) -> str:
        """What it is known by; a line may move."""
        return f"{self.path} {self.scope} {self.before} -> {self.after} #{self.nth}"


# ---- what can be changed -------------------------------------------------------------------------


def sites(node: ast.AST, scope: str = "") -> Iterator[tuple[str, ast.AST, ast.AST]]:
    """(function, node, its mutated copy) of every place that changes a number or a decision."""
    for child in _numbers_and_decisions(node):
        changed = _mutated(child)
        if changed is not None:
            yield scope, child, changed
        inner = f"{scope}.{child.name}".lstrip(".") if isinstance(child, SCOPES) else scope
        yield from sites(child, inner)


def _numbers_and_decisions(node: ast.AST) -> Iterator[ast.AST]:
    """Children without annotations, messages (raise, assert, f-strings) and `__all__`."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.Raise | ast.Assert | ast.JoinedStr):
                continue
            if isinstance(child, ast.Assign) and ast.unparse(child.targets[0]) == "__all__":
                continue
            if isinstance(child, ast.AST):
                yield child


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


def mutants(path: str) -> list[Mutant]:
    """Every mutant of a file."""
    return [mutant for mutant, *_ in _numbered(path, ast.parse((ROOT / path).read_text()))]


def _numbered(path: str, tree: ast.Module) -> Iterator[tuple[Mutant, ast.AST, ast.AST]]:
    seen: Counter[tuple[str, str, str]] = Counter()
    for scope, node, changed in sites(tree):
        before, after = (ast.unparse(part).split("\n")[0] for part in (node, changed))
        seen[scope, before, after] += 1
        nth = seen[scope, before, after]
        yield Mutant(path, scope, before, after, nth, getattr(node, "lineno", 0)), node, changed


class _Replace(ast.NodeTransformer):
    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self.old, self.new = old, new

    def visit(self, node: ast.AST) -> ast.AST:
        return self.new if node is self.old else self.generic_visit(node)


def text_of(mutant: Mutant) -> str:
    """The file's source with this one change."""
    tree = ast.parse((ROOT / mutant.path).read_text())
    (node, changed), *_ = [
        pair for found, *pair in _numbered(mutant.path, tree) if found.key == mutant.key
    ]
    return ast.unparse(ast.fix_missing_locations(_Replace(node, changed).visit(tree)))


def sample(count: int, seed: int) -> list[Mutant]:
    """`count` mutants of all files, each as likely; another file's edits do not change the draw."""
    everything = [item for group in GROUPS for path in group.files for item in mutants(path)]
    return sorted(everything, key=lambda m: random.Random(f"{seed} {m.key}").random())[:count]


# ---- what the tests say --------------------------------------------------------------------------


class Judge:
    """The tests of one group in a copy of the sources, which must pass on these as they are."""

    def __init__(self, group: Group, folder: Path) -> None:
        self.group = group
        self.order = folder / f"{Path(group.files[0]).stem}.json"
        self.work = folder / ("interpreted" if group.interpreted else "compiled")
        self.cache = folder / "numba"
        fresh = not self.work.exists()
        if fresh:
            ignored = shutil.ignore_patterns(".venv", ".git", "site", "runs/*/", ".*_cache")
            shutil.copytree(ROOT, self.work, ignore=ignored)
        self.texts = {
            path: ast.unparse(ast.parse((ROOT / path).read_text())) for path in group.files
        }
        for path, text in self.texts.items():
            (self.work / path).write_text(text)
        self.limit: int | None = None
        if group.interpreted and fresh:
            self._run()  # compiles the LAPACK wrappers, which is not to count
            self.order.unlink(missing_ok=True)
        for _ in range(2):  # in the files' order, which measures each test; then as mutants are
            began, used = time.perf_counter(), _children()
            failed, said = self._run()
            if failed:
                raise SystemExit(
                    f"{', '.join(group.files)}: unchanged, {failed}; mend the test or leave it "
                    f"out\n{said[-3000:]}"
                )
            self.limit = self.limit or int(4.0 * (_children() - used)) + 30
        self.seconds = time.perf_counter() - began

    def verdict(self, mutant: Mutant) -> tuple[str, str]:
        """'killed', 'timed out' or 'survived', and by which test."""
        place = self.work / mutant.path
        place.write_text(text_of(mutant))
        try:
            by, _ = self._run()
        finally:
            place.write_text(self.texts[mutant.path])
        if by == "the limit of time":
            return "timed out", ""
        return ("killed", by) if by else ("survived", "")

    def _run(self) -> tuple[str, str]:
        """What failed first ('' if nothing), and all that pytest said."""
        limit = self.limit
        plugins = ["cheapest_first", *(["interpreted"] if self.group.interpreted else [])]
        words = [part for name in plugins for part in ("-p", name)]
        command = [sys.executable, "-m", "pytest", *words, "-x", "-p", "no:cacheprovider"]
        command += ["--tb=short", *self.group.tests]
        if self.group.words:
            command += ["-k", self.group.words]
        environment = os.environ | {
            "PYTHONPATH": f"{self.work}{os.pathsep}{self.work / 'benchmarks'}",
            "PYTHONDONTWRITEBYTECODE": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "MUTATION_ORDER": str(self.order),
        }
        if self.group.interpreted:  # a cache beside the kernels is dropped when one changes
            environment["NUMBA_CACHE_DIR"] = str(self.cache)

        def limits() -> None:
            # soft ones: a test that sets limits of its own may do so
            for kind, most in ((resource.RLIMIT_AS, MEMORY), (resource.RLIMIT_CPU, limit)):
                if most is not None:
                    resource.setrlimit(kind, (most, resource.getrlimit(kind)[1]))

        process = subprocess.Popen(
            command, cwd=self.work, env=environment, text=True, preexec_fn=limits,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            said, _ = process.communicate(timeout=None if limit is None else 3 * limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            said, _ = process.communicate()
        if process.returncode == 0:
            return "", said
        if process.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
            return "the limit of time", said
        found = re.search(r"^(?:FAILED|ERROR) (.*?)(?: - .*)?$", said, re.MULTILINE)
        return (found[1] if found else f"pytest ended with {process.returncode}"), said


def _children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


# ---- the run -------------------------------------------------------------------------------------


def main() -> None:
    """Sample, judge, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutants", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="files with this in their path")
    parser.add_argument("--survivors", action="store_true", help="judge these again")
    parser.add_argument("--tests", nargs="*", default=[], help="by these files only")
    options = parser.parse_args()
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {"mutants": []}
    done: dict[str, dict[str, Any]] = {item["key"]: item for item in known["mutants"]}
    todo = [m for m in sample(options.mutants, options.seed) if options.only in m.path]
    if options.survivors:
        todo = [
            m
            for m in todo
            if done.get(m.key, {}).get("verdict") == "survived" and "why" not in done[m.key]
        ]
    else:
        todo = [m for m in todo if m.key not in done]
    judges: dict[Group, Judge] = {}
    with tempfile.TemporaryDirectory() as folder:
        for count, mutant in enumerate(todo, 1):
            group = next(group for group in GROUPS if mutant.path in group.files)
            if options.tests:
                group = replace(group, tests=tuple(options.tests), words="")
            if group not in judges:
                judges[group] = Judge(group, Path(folder))
                print(f"unchanged: {judges[group].seconds:.0f} s", *group.files, flush=True)
            began = time.perf_counter()
            verdict, by = judges[group].verdict(mutant)
            seconds = round(time.perf_counter() - began, 1)
            item = {"key": mutant.key} | asdict(mutant)
            item |= {"verdict": verdict, "by": by, "seconds": seconds}
            done[mutant.key] = done.get(mutant.key, {}) | item
            _write(options.seed, list(done.values()))
            change = f"{mutant.path}:{mutant.line} {mutant.before[:60]} -> {mutant.after[:60]}"
            print(f"{count}/{len(todo)} {verdict:9} {change} ({seconds:.0f} s) {by}", flush=True)
    print(json.dumps(_write(options.seed, list(done.values())), indent=1))


def _write(seed: int, found: list[dict[str, Any]]) -> dict[str, int]:
    verdicts = Counter(item["verdict"] for item in found)
    earlier = Counter(item["earlier"] for item in found if "earlier" in item)
    figures = {
        "seed": seed,
        "mutants tried": len(found),
        "killed": verdicts["killed"],
        "timed out": verdicts["timed out"],
        "survived": verdicts["survived"],
        "survived, explained": sum("why" in i for i in found if i["verdict"] == "survived"),
        "tried before the tests that survivors led to": earlier.total(),
        "killed before these": earlier["killed"],
    }
    RESULTS.write_text(json.dumps(figures | {"mutants": found}, indent=1) + "\n")
    return figures


if __name__ == "__main__":
    main()
