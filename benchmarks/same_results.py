"""Whether two run folders hold the same result: every number of result.json, to a tolerance.

    python benchmarks/same_results.py BEFORE AFTER [--tolerance 1e-9]

BEFORE and AFTER are run folders, or folders of run folders, which are paired by name. Numbers are
compared relative to their size (absolutely below 1e-6, where rounding alone is left); times,
versions and paths are left out. Exit code 1 where something differs.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

LEFT_OUT = {"seconds", "versions"}
SMALL = 1e-6  # residuals and shares below it are rounding


def numbers(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Every leaf with its place."""
    if isinstance(value, dict):
        for key, item in value.items():
            if key not in LEFT_OUT:
                yield from numbers(item, f"{name}.{key}" if name else key)
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from numbers(item, f"{name}[{i}]")
    else:
        yield name, value


def differences(before: Path, after: Path, tolerance: float) -> list[str]:
    """What differs, a line each, worst first."""
    old, new = (dict(numbers(json.loads((f / "result.json").read_text()))) for f in (before, after))
    found: list[tuple[float, str]] = [(9.0, f"{k}: gone") for k in old.keys() - new.keys()]
    for key in old.keys() & new.keys():
        a, b = old[key], new[key]
        if isinstance(a, float | int) and isinstance(b, float | int):
            size = max(abs(a), abs(b), SMALL)
            if abs(a - b) > tolerance * size:
                found.append((abs(a - b) / size, f"{key}: {a!r} -> {b!r}"))
        elif a != b:
            found.append((9.0, f"{key}: {a!r} -> {b!r}"))
    return [f"{size:.1e} {words}" for size, words in sorted(found, reverse=True)]


def main() -> int:
    """Print a line a pair, and the worst differences."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("before", type=Path)
    arguments.add_argument("after", type=Path)
    arguments.add_argument("--tolerance", type=float, default=1e-9)
    options = arguments.parse_args()
    single = (options.before / "result.json").exists()
    names = [""] if single else sorted(f.parent.name for f in options.before.glob("*/result.json"))
    failed = False
    for name in names:
        if not (options.after / name / "result.json").exists():
            print(f"{name:28s} not there")
            failed = True
            continue
        found = differences(options.before / name, options.after / name, options.tolerance)
        print(f"{name:28s} {'the same' if not found else f'{len(found)} differ'}")
        print("".join(f"    {line}\n" for line in found[:8]), end="")
        failed |= bool(found)
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
