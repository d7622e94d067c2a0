"""Fuzzed case files, thetas and options."""

import json
import math
import random
import re
from pathlib import Path
from typing import Any

from oracles.fuzz_values import BASE, QUICK, VALUES, WORDS, Input


def case_data() -> dict[str, Any]:
    data = json.loads(json.dumps(BASE))
    return data | {name: dict(table) for name, table in QUICK.items()}


def toml(data: dict[str, Any]) -> str:
    """Any nested values as TOML, or as what looks like it."""
    lines: list[str] = []
    for name, table in data.items():
        if not isinstance(table, dict):
            lines.insert(0, f"{_key(name)} = {_toml(table)}")
            continue
        flat = {k: v for k, v in table.items() if not (name == "theta" and isinstance(v, dict))}
        lines += [f"[{_key(name)}]", *(f"{_key(k)} = {_toml(v)}" for k, v in flat.items())]
        for key, value in table.items():
            if key not in flat:
                lines.append(f"[{_key(name)}.{_key(key)}]")
                lines += [f"{_key(k)} = {_toml(v)}" for k, v in value.items()]
    return "\n".join(lines) + "\n"


def _key(key: str) -> str:
    return key if re.fullmatch("[A-Za-z0-9_-]+", key) else _toml(key)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escape = {'"': '\\"', "\\": "\\\\"}
        return '"' + "".join(
            escape.get(c, c if c.isprintable() else f"\\U{ord(c):08X}") for c in value
        ) + '"'  # fmt: skip
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(k)} = {_toml(v)}" for k, v in value.items()) + "}"
    return repr(value)


def scaled(rng: random.Random, value: Any) -> Any:
    """A number of another size, so that a case stays well formed but is no longer sensible."""
    if isinstance(value, bool) or not isinstance(value, int | float | list):
        return rng.choice(VALUES)
    if isinstance(value, list):
        return [scaled(rng, item) if rng.random() < 0.5 else item for item in value]
    if isinstance(value, int):  # a count: few, or far too many
        return rng.choice([0, 1, 2, 3, 4, -1, 10**8, 10**12])
    return value * math.exp(rng.choice([0.2, 1.0, 4.0, 12.0]) * rng.gauss(0.0, 1.0))


def mutate(rng: random.Random, data: dict[str, Any]) -> str:
    """Change a case at one place; what was done."""
    tables: list[tuple[str, dict[str, Any]]] = [("", data)]
    tables += [(name, t) for name, t in data.items() if isinstance(t, dict)]
    theta = data.get("theta")
    if isinstance(theta, dict):
        tables += [(f"theta.{name}", t) for name, t in theta.items() if isinstance(t, dict)]
    name, table = rng.choice(tables[1:] if len(tables) > 1 and rng.random() < 0.9 else tables)
    keys = list(table)
    kind = rng.choices(["scale", "value", "drop", "add", "rename", "swap"], [8, 6, 2, 1, 1, 1])[0]
    if not keys:
        kind = "add"
    key = rng.choice(keys) if keys else "x"
    if kind == "scale":
        table[key] = scaled(rng, table[key])
    elif kind == "value":
        table[key] = rng.choice(VALUES)
    elif kind == "drop":
        del table[key]
    elif kind == "add":
        table[rng.choice(["S_mx", "x", "", "a b", "method", "sweep_points", "zeta", "limits"])] = (
            rng.choice(VALUES)
        )
    elif kind == "rename":
        table[key + rng.choice(["s", "_", " ", "\u0301"])] = table.pop(key)
    else:
        other = rng.choice(keys)
        table[key], table[other] = table[other], table[key]
    return f"{kind} {name}.{key}"[:60]


def spoil(rng: random.Random, content: bytes) -> tuple[bytes, str]:
    """Bytes with a fault: truncated, flipped, inserted, doubled."""
    kind = rng.choice(["truncate", "flip", "insert", "double", "delete", "empty", "random"])
    size = len(content)
    at = rng.randrange(size + 1)
    end = min(size, at + rng.choice([1, 2, 16, 200]))
    if kind == "truncate":
        content = content[:at]
    elif kind == "flip":
        changed = bytearray(content)
        for _ in range(rng.choice([1, 1, 3, 30])):
            if changed:
                changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        content = bytes(changed)
    elif kind == "insert":
        content = content[:at] + rng.choice(WORDS).encode() + content[at:]
    elif kind == "double":
        content = content[:end] + content[at:]
    elif kind == "delete":
        content = content[:at] + content[end:]
    elif kind == "empty":
        content = b""
    else:
        content = rng.randbytes(rng.choice([1, 100, 5000]))
    return content, f"{kind} at {at} of {size}"


def case_file(rng: random.Random, folder: Path, run: Path) -> Input:
    data = case_data()
    if rng.random() < 0.15:
        data["inner"]["method"], data["inner"]["sweep_points"] = "sweep", [4, 4]
    notes = [mutate(rng, data) for _ in range(rng.choice([1, 1, 2, 3]))]
    content = toml(data).encode("utf-8", "surrogatepass")
    if rng.random() < 0.25:
        content, note = spoil(rng, content)
        notes.append(note)
    path = folder / "case.toml"
    path.write_bytes(content)
    return some_command(rng, path, "case", "; ".join(notes))


def some_command(rng: random.Random, path: Path, family: str, note: str) -> Input:
    out = ["--out", str(path.parent / "run")]
    kind = rng.choices(["one", "inner", "solve"], [70, 20, 1])[0]
    theta = ["--theta", "m1=60,m2=60", *out]
    if kind == "one":
        hz = ["--omega-s-hz", f"{10 ** rng.uniform(0, 4):.3g}"]
        hz += ["--omega-t-hz", f"{10 ** rng.uniform(0, 4):.3g}"]
        return Input(family, "inner", [str(path), *theta, *hz], note)
    if kind == "inner":
        return Input(family, "inner", [str(path), *theta], note)
    formulation = rng.choice(["nested", "lifted", "direct"])
    words = [str(path), *out, "--workers", "1", "--quiet", "--formulation", formulation]
    return Input(family, "solve", words, note, report=rng.random() < 0.2)


NAMES = ["m1", "m2", "m1", "m2", "m3", "", "M1", " m1", "м1", "m1\n", "theta.m1"]
SIGNS = ["=", "=", "=", "=", "==", ":", "", " = ", "\t="]
NUMERALS = [
    "60",
    "60.5",
    "6e1",
    "nan",
    "inf",
    "-60",
    "1e400",
    "0x3C",
    "6_0",
    "６０",
    "",
    "60kg",
    "7" * 400,
    "\n60",
    "5" + "5.0",
    "+60",
    "60,",
    "'60'",
    "1e-400",
    "60\u00a0",
    "70",
    "\udcff",
]
WHOLE = ["0", "-1", "1.5", "1e3", "²", "9" * 50, "", " 1", "+1", "1", "7", "x", "0x1", "\udcff"]


def theta(rng: random.Random, folder: Path, run: Path) -> Input:
    path = folder / "case.toml"
    path.write_text(toml(case_data()))
    if rng.random() < 0.8:
        count = rng.choice([0, 1, 2, 2, 2, 2, 3])
        names = ["m1", "m2", "m1"][:count] if rng.random() < 0.5 else rng.choices(NAMES, k=count)
        signs = ["="] * count if rng.random() < 0.7 else rng.choices(SIGNS, k=count)
        parts = [n + s + rng.choice(NUMERALS) for n, s in zip(names, signs, strict=True)]
        words = ["--theta", rng.choice([",", ",", ",", ", ", ";", "&", ",,"]).join(parts)]
    else:
        words = ["--theta", "m1=60,m2=60"]
    if rng.random() < 0.7:
        words += ["--omega-s-hz", rng.choice(["800", "800", *NUMERALS])]
        words += ["--omega-t-hz", rng.choice(["40", "40", *NUMERALS])]
    for name in ("--workers", "--seed"):
        if rng.random() < 0.15:
            words += [name, rng.choice(WHOLE)]
    if rng.random() < 0.1:
        words.insert(rng.randrange(len(words)), rng.choice(["--", "-", "--x", "--theta", "\udcff"]))
    out = rng.choice(["run", "run", "a/b/c", "case.toml", "ümlaut \u202e", "\udcff", "x" * 300])
    if rng.random() < 0.5:
        words += ["--out", str(folder / out)]
    return Input("theta", "inner", [str(path), *words], out)
