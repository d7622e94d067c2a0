"""The difference equation as source code: C99 with a test of its own, and structured text.

No allocation, no library but the test's, double precision. Data are row-major: the blocks of A one
after the other (in structured text A whole), then B (states × errors), C (forces × states),
D (forces × errors). The output is computed before the state is advanced, so that u leaves as early
as it can. The structured text (IEC 61131-3) is one function block for a PLC's fast task, with the
same order of operations in LREAL. Only what every PLC has is used: FOR, IF, arrays of constants.
`RESET` puts it to rest, `TAKEOVER` begins with the forces U_BEFORE, otherwise a call is one sample.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.analysis.feedforward import ORDER
from ccd_casadi.deployment.anti_windup import takeover
from ccd_casadi.deployment.realisation import (
    Realisation,
    difference_equation,
    dot,
    literal,
    literals,
    plain_title,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.package_text import template

COMPILE = (
    "cc -std=c99 -O2 -ffp-contract=off -Wall -Wextra -pedantic "
    "-o controller_test controller.c controller_test.c"
)
C_FILES, ST_FILE = ("controller.h", "controller.c", "controller_test.c"), "controller.st"
SAMPLES = 64  # of the test vectors
ERROR = 1e-6  # m; size of the errors in the test vectors
TOLERANCE = 1e-12  # of the largest force


def write_c(folder: Path, realisation: Realisation, **how: Any) -> Mapping[str, str]:
    """controller.h, controller.c and controller_test.c in `folder`, and their texts; `how` as in
    `c_files`."""
    files = c_files(realisation, **how)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return files


def c_files(
    realisation: Realisation, *, title: str, delay: float, verified: bool,
    forward: Array | None = None, kind: str = "Controller",
) -> Mapping[str, str]:  # fmt: skip
    """The three files' texts by name; delay in s; the header says whether the loop was verified,
    and what `kind` of controller it is.

    `forward` (5, m, p) are the gains of `feedforward`; zeros where there are none.
    """
    K, limit = realisation.system, realisation.saturation
    errors, forwards, first, forces = vectors(realisation)
    values = _values(realisation, title, delay, verified, kind) | {
        "rate": f"{1.0 / K.period:.10g}", "ahead": f"{delay + 0.5 * K.period:.6g}",
        "room": max(len(K.A), 1), "limit": None if limit is None else f"{limit:.17g}",
        "blocks": realisation.blocks or (0,), "A": realisation.block_entries,
        "F": np.zeros((ORDER + 1, *K.D.shape)) if forward is None else forward,
        "compile": COMPILE, "tolerance": f"{TOLERANCE:g}", "samples": SAMPLES,
        "errors": errors, "forwards": forwards, "first": first, "forces": forces,
        "initialiser": lambda entries: f"{{\n    {literals(entries, 4)}\n}}",
    }  # fmt: skip
    return {name: template(f"deployment/templates/{name}").render(values) for name in C_FILES}


def structured_text(
    realisation: Realisation, *, title: str, delay: float, verified: bool, kind: str = "Controller"
) -> str:
    """The function block; delay in s. A controller without states keeps one that stays at rest."""
    K, limit, sizes = realisation.system, realisation.saturation, realisation.blocks or (1,)
    n, (m, p), rest = sum(sizes), K.D.shape, {}
    if not len(K.A):
        shapes = {"A": (1, 1), "B": (1, p), "C": (m, 1), "X": (1, p + m), "L": (1, m)}
        rest = {name: np.zeros(shape) for name, shape in shapes.items()}
    starts = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes)
    L = realisation.back_calculation
    values = _values(realisation, title, delay, verified, kind) | {
        "n": n, "limit": literal(1e308 if limit is None else limit), "starts": starts,
        "ends": starts + np.repeat(sizes, sizes) - 1, "A": K.A,
        "L": np.zeros((n, m)) if L is None else L, "numbers": lambda entries: literals(entries, 8),
    }  # fmt: skip
    return template(f"deployment/templates/{ST_FILE}").render(values | rest)


def _values(
    realisation: Realisation, title: str, delay: float, verified: bool, kind: str
) -> dict[str, Any]:
    """What both languages need."""
    K = realisation.system
    return {
        "title": plain_title(title), "kind": kind, "verified": verified,
        "period": f"{K.period:.17g}",
        "delay": f"{delay:.10g}", "n": len(K.A), "p": K.B.shape[1], "m": len(K.C),
        "B": K.B, "C": K.C, "D": K.D, "L": realisation.back_calculation, "X": takeover(K),
    }  # fmt: skip


def vectors(realisation: Realisation) -> tuple[Array, Array, Array, Array]:
    """Errors (k, p), feedforward (k, m), forces before (m,), and the forces (k, m) that follow.

    Where there is a limit the feedforward reaches beyond it, so that every path is walked.
    """
    K, limit = realisation.system, realisation.saturation
    rng = np.random.default_rng(0)
    errors = ERROR * rng.standard_normal((SAMPLES, K.B.shape[1]))
    size = limit if limit is not None else ERROR * float(np.abs(K.D).max() + 1.0)
    forwards = size * rng.standard_normal((SAMPLES, len(K.C)))
    first = np.full(len(K.C), 0.5 * size)
    start = [dot(row, [*errors[0], *first]) for row in takeover(K).tolist()]
    return errors, forwards, first, difference_equation(realisation, errors, forwards, start)
