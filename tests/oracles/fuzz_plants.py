"""Fuzzed plant functions: odd values, wrong shapes, exceptions, endless loops, odd files;
and random plants that are well formed.
"""

import math
import random
from pathlib import Path

from oracles.fuzz_cases import case_data, some_command, toml
from oracles.fuzz_values import VALUES, Input

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
    return some_command(rng, path, "plant", note[:200])


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
    return some_command(rng, path, "valid", f"{n} masses, output {place}")
