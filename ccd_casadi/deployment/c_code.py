"""The difference equation as C99: a header, a source, and a test with its own vectors.

No allocation, no library but the test's, double precision. Data are row-major: the blocks of A one
after the other, then B (states × errors), C (forces × states), D (forces × errors). The output is
computed before the state is advanced, so that u leaves as early as it can.
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
    literals,
    plain_title,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.package_text import template

COMPILE = (
    "cc -std=c99 -O2 -ffp-contract=off -Wall -Wextra -pedantic "
    "-o controller_test controller.c controller_test.c"
)
FILES = ("controller.h", "controller.c", "controller_test.c")
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
    forward: Array | None = None,
) -> Mapping[str, str]:  # fmt: skip
    """The three files' texts by name; delay in s; the header says whether the loop was verified.

    `forward` (5, m, p) are the gains of `feedforward`; zeros where there are none.
    """
    K, limit = realisation.system, realisation.saturation
    n, p, m = len(K.A), K.B.shape[1], len(K.C)
    errors, forwards, first, forces = vectors(realisation)
    values = {
        "title": plain_title(title), "verified": verified, "n": n, "p": p, "m": m,
        "period": f"{K.period:.17g}", "rate": f"{1.0 / K.period:.10g}", "delay": f"{delay:.10g}",
        "ahead": f"{delay + 0.5 * K.period:.6g}", "room": max(n, 1),
        "limit": None if limit is None else f"{limit:.17g}", "L": realisation.back_calculation,
        "blocks": realisation.blocks or (0,), "A": realisation.block_entries,
        "B": K.B, "C": K.C, "D": K.D, "X": takeover(K),
        "F": np.zeros((ORDER + 1, m, p)) if forward is None else forward,
        "compile": COMPILE, "tolerance": f"{TOLERANCE:g}", "samples": SAMPLES,
        "errors": errors, "forwards": forwards, "first": first, "forces": forces,
    }  # fmt: skip
    made = (template(f"deployment/templates/{name}", initialiser=_initialiser) for name in FILES)
    return {name: each.render(values) for name, each in zip(FILES, made, strict=True)}


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


def _initialiser(values: Array) -> str:
    return f"{{\n    {literals(values, 4)}\n}}"
