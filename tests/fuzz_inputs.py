"""Inputs that nobody should give, made from a seed: case files, thetas, plants, run folders.

`make(seed, folder, run)` writes an input into an empty folder and says how to call a command with
it. The same seed makes the same input.
"""

import json
import math
import random
import re
import shutil
import sqlite3
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
BASE = tomllib.loads((ROOT / "runs" / "two_mass.toml").read_text())
QUICK = {
    "sampling": {"points": 2, "lifted_points": 12},
    "outer": {"starts": 2, "direct_starts": 1, "max_refinements": 1},
}
NUMBERS = [
    math.nan,
    math.inf,
    -math.inf,
    0.0,
    -0.0,
    -1.0,
    1e308,
    -1e308,
    1e-308,
    5e-324,
    1e16,
    10**400,
    -(10**30),
    0,
    -1,
    1,
    2,
    10**9,
]
VALUES: list[Any] = [
    *NUMBERS,
    True,
    False,
    "",
    "x",
    "nan",
    "\u202e\x1b[2J\x07",
    "x" * 5000,
    "../../../etc/passwd",
    "<script>alert(1)</script>",
    [],
    [1],
    [1.0, 2.0],
    [2.0, 1.0],
    [math.nan, 1.0],
    [[1], [2, 3]],
    ["a", "b"],
    [True, False],
    [1e-300, 1e300],
    {},
    {"a": 1},
    {"a": {"b": {"c": []}}},
]
WORDS = [
    "m1",
    "m2",
    "lower",
    "unit",
    "[plant]",
    "theta.",
    '"',
    "'''",
    "\\u0000",
    "=",
    "\n\n",
    "#",
    "\ufeff",
    "é",
    "\x00",
    "\x7f",
    "1979-05-27",
    "[[",
    "]]",
    "{",
    "}",
    "0x",
    "1e999",
    "nan",
]


@dataclass(frozen=True)
class Input:
    """A command and its words; what befalls it: Ctrl-C after s seconds, or a fault by name."""

    family: str
    command: str
    argv: list[str]
    note: str = ""
    interrupt: float | None = None
    fault: str = ""
    amount: float = 0.0
    report: bool = False


def make(seed: str, folder: Path, run: Path) -> Input:
    """The input of a seed; `run` is a finished run folder to spoil copies of."""
    rng = random.Random(seed)
    families = list(FAMILIES)
    family = rng.choices(families, [FAMILIES[name][0] for name in families])[0]
    return FAMILIES[family][1](rng, folder, run)


# ---- case files ----------------------------------------------------------------------------------


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
    return _some_command(rng, path, "case", "; ".join(notes))


def _some_command(rng: random.Random, path: Path, family: str, note: str) -> Input:
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


# ---- options and thetas --------------------------------------------------------------------------

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


# ---- plants --------------------------------------------------------------------------------------

HEAD = "import math\nimport casadi as ca\nimport numpy as np\n\n"
PARTS = {
    "mass": 'ca.diag(ca.vertcat(t["m1"], t["m2"]))',
    "stiffness": "1e8 * ca.DM([[1, -1], [-1, 1]])",
    "damping_ratio": "0.01",
    "input": "ca.DM([1, 0])",
    "output": "ca.DM([[1, 0]])",
    "hardware_cost": 't["m1"] + t["m2"]',
}
ODD = [
    "None",
    "math.nan",
    "math.inf",
    "1j",
    "'x'",
    "[]",
    "{}",
    "()",
    "1e308",
    "-1",
    "0",
    "1e-308",
    "t",
    "lambda: 0",
    "float",
    "ca.SX.sym('z')",
    "ca.MX.sym('z', 2, 2)",
    "ca.SX.sym('z', 2, 2)",
    "np.zeros((0, 0))",
    "np.ones((2, 3))",
    "np.ones((3, 3))",
    "np.ones((2, 2))",
    "np.ones(2)",
    "np.eye(2) * 1j",
    "np.eye(2, dtype=object)",
    "np.eye(2) * math.nan",
    "-np.eye(2)",
    "np.ones((2, 2, 2))",
    "ca.SX.eye(10**6)",
    "ca.SX(10**6, 1)",
    "ca.SX(1, 10**6)",
    "ca.DM.eye(10**6)",
    "np.ones((10**6, 10**6))",
    "ca.DM.ones(0, 2)",
    "ca.DM.ones(2, 0)",
    "ca.diag(ca.vertcat(t['m1'] - 62, 60))",
    "ca.sqrt(t['m1'] - 60)",
    "1 / (t['m1'] - 60)",
    "ca.if_else(t['m1'] > 60, 1.0, math.nan)",
    "ca.log(t['m1'] - 58) * ca.DM.eye(2)",
    "ca.DM([[1, -1], [-1, 1]])",
    "ca.DM([[1, 2], [3, 4]])",
    "1e30 * ca.DM([[1, -1], [-1, 1]])",
    "1e-30 * ca.DM([[1, -1], [-1, 1]])",
    "ca.DM([[1, 0], [0, 0]])",
    "ca.DM([[0, 0], [0, 0]])",
    "ca.DM([0, 0])",
    "ca.DM([[0, 0]])",
    "ca.DM([[1, 0], [0, 1]])",
    "ca.diag(ca.vertcat(1e12, 1e-12))",
    "t['m1'] ** t['m2'] ** 9",
    "ca.DM([[1e3, 999.9999999], [999.9999999, 1e3]])",
    "True",
    "b'x'",
    "np.array([['a', 'b'], ['c', 'd']])",
    "float('1e400')",
    "ca.Sparsity.dense(2, 2)",
    "10**400",
]
BODIES = [
    "raise ValueError('no')",
    "raise KeyError('m1')",
    "raise TypeError('x')",
    "raise SystemExit(3)",
    "raise KeyboardInterrupt",
    "raise StopIteration",
    "raise GeneratorExit",
    "raise MemoryError",
    "raise RecursionError",
    "raise BaseException('base')",
    "raise OSError(5, 'disk')",
    "raise Exception('two\\nlines \\x1b[2J \\u202e')",
    "raise Exception('x' * 10**6)",
    "raise UnicodeDecodeError('utf-8', b'x', 0, 1, 'no')",
    "raise BrokenPipeError",
    "raise type('Odd', (Exception,), {'__str__': lambda self: 1 / 0})()",
    "return f(t, **o)",
    "return 1",
    "return None",
    "return [1, 2]",
    "return {1: 2}",
    "return iter(())",
    "yield 1",
    "import sys; sys.exit('bye')",
    "import os; os.chdir('/')",
    "raise ExceptionGroup('g', [OSError()])",
    "return dict.fromkeys(('mass', 'stiffness', 'input', 'output', 'hardware_cost'))",
    "t.clear()",
    "return t",
    "assert False",
    "return {'mass': t}",
    "raise type('A', (SystemExit,), {})",
]
HANGS = [
    "while True: pass",
    "import time; time.sleep(1e9)",
    "[0 for _ in iter(int, 1)]",
    "while True:\n        try:\n            while True: pass\n        except Exception: 0",
]
FILES = [
    b"",
    b"\x00",
    b"def f(",
    b"\xff\xfe",
    b"f = 1\n",
    b"f = None\n",
    b"class f: pass\n",
    b"async def f(t): return {}\n",
    b"f = lambda: 1\n",
    b"import nothing_like_this\n",
    b"1/0\n",
    b"raise SystemExit\n",
    b"raise KeyboardInterrupt\n",
    b"from f import f\n",
    b"import this_file\n",
    b"def f(t, *, must): return {}\n",
    b"f = print\n",
    b"f = int\n",
    b"import casadi as f\n",
    b"# -*- coding: nonsense -*-\n",
    b"def f(t): " + b"(" * 500 + b")" * 500 + b"\n",
    b"del f\n",
    b"def __getattr__(name): raise ValueError(name)\n",
]


def plant(rng: random.Random, folder: Path, run: Path) -> Input:
    data = case_data()
    data["plant"] = {"function": "plant.py:f"}
    data["limits"] = {"plant_seconds": 0.3}
    kind = rng.choices(["part", "parts", "body", "file", "hang", "option"], [10, 6, 4, 2, 0.4, 1])[
        0
    ]
    parts = dict(PARTS)
    note, source = kind, ""
    if kind in ("part", "parts"):
        for _ in range(1 if kind == "part" else rng.choice([2, 3])):
            name = rng.choice([*parts, "constraints", "damping", "extra"])
            odd = rng.choice(ODD)
            if name == "constraints":
                odd = rng.choice([odd, f"{{'a': {odd}}}", f"{{'<b>\\n': {odd}}}", f"{{1: {odd}}}"])
            elif rng.random() < 0.1 and name in parts:
                del parts[name]
                note += f" no {name}"
                continue
            elif rng.random() < 0.3 and name in parts:
                odd = f"{parts[name]} * {odd}"
            parts[name] = odd
            note += f" {name}={odd}"
        items = ", ".join(f"{name!r}: {text}" for name, text in parts.items())
        source = f"{HEAD}def f(t, **o):\n    return {{{items}}}\n"
    elif kind == "body":
        note = rng.choice(BODIES)
        source = f"{HEAD}def f(t, **o):\n    {note}\n"
    elif kind == "hang":
        note = rng.choice(HANGS)
        place = "" if rng.random() < 0.5 and "try" not in note else "def f(t, **o):\n    "
        source = f"{HEAD}{place}{note}\n"
    elif kind == "option":
        key = rng.choice(["x", "self", "theta", "t", "model", "class", "a b", "", "__class__"])
        data["plant"][key] = rng.choice(VALUES)
        data["plant"]["function"] = rng.choice(
            ["plant.py:f", "plant.py:g", "plant.py:__name__", "plant.py", "../plant.py:f", "/:f",
             "plant.py:", ":f", "plant.txt:f", "no.py:f", ".py:f", "\x00.py:f", "x" * 300 + ".py:f"]
        )  # fmt: skip
        items = ", ".join(f"{name!r}: {text}" for name, text in parts.items())
        source = f"{HEAD}def f(t, **o):\n    return {{{items}}}\n"
        note = f"{key} {data['plant']['function']}"
    if kind == "file":
        content = rng.choice(FILES)
        note = repr(content[:40])
        (folder / "plant.py").write_bytes(content)
    else:
        (folder / "plant.py").write_text(source)
    path = folder / "case.toml"
    path.write_text(toml(data))
    return _some_command(rng, path, "plant", note[:200])


# ---- run folders ---------------------------------------------------------------------------------


def pick(rng: random.Random, value: Any) -> tuple[Any, Any] | None:
    """A container inside a JSON value, and a key of it."""
    places: list[tuple[Any, Any]] = []
    stack = [value]
    while stack and len(places) < 5000:
        item = stack.pop()
        keys: list[Any] = []
        if isinstance(item, dict):
            keys = list(item)
        elif isinstance(item, list):
            keys = rng.sample(range(len(item)), min(len(item), 4))
        places += [(item, key) for key in keys]
        stack += [item[key] for key in keys]
    return rng.choice(places) if places else None


def spoil_json(rng: random.Random, path: Path) -> str:
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError):
        return "spoilt already"
    found = pick(rng, value)
    if found is None:
        return "nothing to change"
    container, key = found
    if rng.random() < 0.3:
        del container[key]
        note = f"without {key}"
    else:
        odd = rng.choice(VALUES)
        if isinstance(container[key], float) and rng.random() < 0.5:
            odd = container[key] * math.exp(rng.gauss(0.0, 5.0))
        container[key] = odd
        note = f"{key} = {odd!r:.60}"
    path.write_text(json.dumps(value))
    return note


SQL = [
    "update samples set {column} = {value} where rowid % {modulus} = 0",
    "delete from samples where rowid % {modulus} = 0",
    "update results set json = {value}",
    "update results set json = '[]'",
    "update results set json = '{{}}'",
    "update results set json = json_set(json, '$.bandwidth', {value})",
    "update results set json = json_set(json, '$.gradient', {value})",
    "update results set json = json_set(json, '$.omega_S', {value})",
    "update results set json = json_set(json, '$.active', {value})",
    "update results set json = json_set(json, '$.syntheses', {value})",
    "update results set json = json_remove(json, '$.shortfall')",
    "update results set theta = {value}",
    "update results set theta = '[1]'",
    "delete from results",
    "drop table results",
    "drop table samples",
    "drop table meta",
    "delete from meta",
    "update meta set value = '2'",
    "update meta set value = {value}",
    "alter table samples drop column seconds",
    "alter table samples add column more text",
    "alter table samples rename column gamma to gama",
    "update problems set json = {value}",
    "create trigger t after insert on samples begin delete from samples; end",
    "create trigger t before insert on samples begin select raise(abort, 'no'); end",
    "create view v as select 1",
    "pragma user_version = 99",
    "pragma application_id = 7",
    "pragma journal_mode = delete",
    "vacuum",
    "delete from problems",
]
SQL_VALUES = [
    "null",
    "'x'",
    "''",
    "1e308",
    "-1",
    "0",
    "9e999",
    "x'ff00'",
    "'[null]'",
    "'[1, 2'",
    "'{\"a\": 1}'",
    "zeroblob(1000)",
    "'nan'",
    "cast(x'80' as text)",
    "3",
]
COLUMNS = [
    "key",
    "problem",
    "theta",
    "omega_S",
    "omega_T",
    "outcome",
    "reason",
    "gamma_opt",
    "gamma",
    "bandwidth",
    "sensitivity_peak",
    "sensitivity_low",
    "certified",
    "gradients",
]


def spoil_store(rng: random.Random, path: Path) -> str:
    statement = rng.choice(SQL).format(
        column=rng.choice(COLUMNS), value=rng.choice(SQL_VALUES), modulus=rng.choice([1, 2, 7])
    )
    database = sqlite3.connect(path, isolation_level=None)
    try:
        database.execute(statement)
    except sqlite3.Error as error:
        return f"{statement}: {error}"
    finally:
        database.close()
    return statement


def spoil_folder(rng: random.Random, folder: Path) -> str:
    """Damage one file of a run folder; what was done."""
    files = [
        "samples.sqlite",
        "surrogate.json",
        "controller.json",
        "result.json",
        "case.toml",
        "truth.json",
        "surrogates/0001.json",
        "surrogates/index.json",
        "retrain.jsonl",
    ]
    name = rng.choice(files)
    path = folder / name
    if not path.is_file():
        return f"{name}: spoilt already"
    kind = rng.choices(["inside", "bytes", "gone", "folder", "link", "other"], [10, 4, 1, 1, 1, 1])[
        0
    ]
    if kind == "inside":
        if name.endswith(".json"):
            return f"{name}: {spoil_json(rng, path)}"
        if name.endswith(".sqlite"):
            return f"{name}: {spoil_store(rng, path)}"
        if name == "case.toml":
            data = tomllib.loads(path.read_text())
            note = mutate(rng, data)
            path.write_bytes(toml(data).encode("utf-8", "surrogatepass"))
            return f"{name}: {note}"
        kind = "bytes"
    if kind == "bytes":
        content, note = spoil(rng, path.read_bytes())
        path.write_bytes(content)
        return f"{name}: {note}"
    path.unlink()
    if kind == "folder":
        path.mkdir()
        (path / "x").touch()
    elif kind == "link":
        path.symlink_to(rng.choice([path.name, "/nowhere", "/", "."]))
    elif kind == "other" and name in ("truth.json", "samples.sqlite"):
        path.write_text("[]" * rng.choice([1, 1000]))
    elif kind == "other":
        shutil.copy(folder / rng.choice(["truth.json", "index.html", "samples.sqlite"]), path)
    return f"{name}: {kind}"


def run_folder(rng: random.Random, folder: Path, run: Path) -> Input:
    copy = Path(shutil.copytree(run, folder / "run"))
    (copy / "index.html").write_text("<html>")
    note = "; ".join(spoil_folder(rng, copy) for _ in range(rng.choice([1, 1, 1, 2])))
    kind = rng.choices(["read", "solve", "retrain", "insight", "surrogate"], [200, 3, 1, 2, 3])[0]
    quick = ["--workers", "1", "--quiet"]
    if kind == "read":
        return Input("folder", "read", [str(copy)], note)
    if kind == "retrain":
        return Input("folder", "retrain", [str(copy), "--budget", "4", *quick], note)
    if kind == "insight":
        return Input("folder", "insight", [str(copy), "--points", "2", *quick], note)
    name = ["--surrogate", rng.choice(["0001", "0001", "0002", "../0001", "index", "", "1"])]
    more = name if kind == "surrogate" else []
    words = [str(copy / "case.toml"), "--out", str(copy), "--formulation", "lifted", *quick, *more]
    return Input("folder", "solve", words, note, report=rng.random() < 0.2)


# ---- faults, and Ctrl-C --------------------------------------------------------------------------


def faulty(rng: random.Random, folder: Path, run: Path) -> Input:
    copy = Path(shutil.copytree(run, folder / "run"))
    fault = rng.choice(["full", "full", "clock", "locked", "readonly"])
    quick = ["--workers", "1", "--quiet"]
    if rng.random() < 0.6:
        for path in copy.glob("samples.sqlite*"):
            path.unlink()
    words = [str(copy / "case.toml"), "--out", str(copy), *quick]
    words += ["--formulation", rng.choice(["lifted", "direct", "nested"])]
    command = "solve"
    if rng.random() < 0.25 and (copy / "samples.sqlite").exists():
        command, words = "retrain", [str(copy), "--budget", "4", *quick]
    amount = float(int(10 ** rng.uniform(0.0, 5.5)))
    return Input("fault", command, words, fault, None, fault, amount, rng.random() < 0.3)


def interrupted(rng: random.Random, folder: Path, run: Path) -> Input:
    copy = Path(shutil.copytree(run, folder / "run"))
    for path in copy.glob("samples.sqlite*"):
        path.unlink()
    words = [str(copy / "case.toml"), "--out", str(copy), "--workers", "1", "--quiet"]
    words += ["--formulation", rng.choice(["lifted", "direct", "nested"])]
    return Input("interrupt", "solve", words, "", rng.uniform(0.0, 2.5), report=rng.random() < 0.3)


# ---- well-formed random cases --------------------------------------------------------------------


def valid(rng: random.Random, folder: Path, run: Path) -> Input:
    """A random chain of masses with random weights: whatever comes out must be true."""
    data = case_data()
    n = rng.choice([2, 2, 3, 4, 6])
    data["plant"] = {"function": "plant.py:f"}
    fixed = [round(10 ** rng.uniform(0.0, 2.3), 4) for _ in range(n)]
    springs = [round(10 ** rng.uniform(5.0, 9.0), 2) for _ in range(n - 1)]
    place = rng.randrange(n)
    source = (
        f"{HEAD}N = {n}\nFIXED = {fixed}\nSPRINGS = {springs}\n\ndef f(t):\n"
        '    masses = [t["m1"], t["m2"], *FIXED][:N]\n    K = ca.DM(N, N)\n'
        "    for i, k in enumerate(SPRINGS):\n        K[i, i] += k\n        K[i + 1, i + 1] += k\n"
        "        K[i, i + 1] -= k\n        K[i + 1, i] -= k\n"
        f'    return {{"mass": ca.diag(ca.vertcat(*masses)), "stiffness": K,\n'
        f'            "damping_ratio": {10 ** rng.uniform(-3, -0.5):.4g},\n'
        f'            "input": ca.DM.eye(N)[:, 0], "output": ca.DM.eye(N)[{place}, :],\n'
        '            "hardware_cost": t["m1"] + t["m2"]}\n'
    )
    (folder / "plant.py").write_text(source)
    for table in ("weights", "inner"):
        for key in list(data[table]):
            if rng.random() < 0.4 and isinstance(data[table][key], float):
                data[table][key] *= math.exp(rng.gauss(0.0, 0.7))
    path = folder / "case.toml"
    path.write_text(toml(data))
    return _some_command(rng, path, "valid", f"{n} masses, output {place}")


Maker = Callable[[random.Random, Path, Path], Input]
FAMILIES: dict[str, tuple[float, Maker]] = {
    "case": (36, case_file),
    "theta": (18, theta),
    "plant": (22, plant),
    "folder": (16, run_folder),
    "fault": (0.3, faulty),
    "interrupt": (0.3, interrupted),
    "valid": (3, valid),
}
