"""What fuzzed inputs are made of: odd numbers and words, and the record of one input."""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
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
