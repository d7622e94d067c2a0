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
from ccd_casadi.support.package_text import filled

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
    K, limit, L = realisation.system, realisation.saturation, realisation.back_calculation
    n, p, m = len(K.A), K.B.shape[1], len(K.C)
    errors, forwards, first, forces = vectors(realisation)
    header = _part(
        FILES[0],
        title=plain_title(title), period=f"{K.period:.17g}", rate=f"{1.0 / K.period:.10g}",
        delay=f"{delay:.10g}",
        limits="v[k]" if limit is None else f"v[k] within +-{limit:.17g} N",
        back="" if L is None else " + L (u[k] - v[k])",
        ahead=f"{delay + 0.5 * K.period:.6g}", verified="verified" if verified else "NOT verified",
        n=n, p=p, m=m, room=max(n, 1),
    )  # fmt: skip
    clip = "" if limit is None else _part("clip.c", limit=f"{limit:.17g}")
    source = _part(
        FILES[1],
        blocks="{" + ", ".join(str(size) for size in realisation.blocks or (0,)) + "}",
        A=_numbers(realisation.block_entries), B=_numbers(K.B), C=_numbers(K.C),
        D=_numbers(K.D), room=max(n, 1), clip=clip,
        L="" if L is None else _part("back.c", L=_numbers(L)),
        X=_numbers(takeover(K)),
        F=_numbers(np.zeros((ORDER + 1, m, p)) if forward is None else forward),
        cut_declared="    double cut[CONTROLLER_FORCES];\n" if clip else "",
        cut_used="" if L is None else _part("lead_back.c"),
    )  # fmt: skip
    test = _part(
        FILES[2],
        compile=COMPILE, tolerance=f"{TOLERANCE:g}", samples=SAMPLES,
        errors=_numbers(errors), forwards=_numbers(forwards), first=_numbers(first),
        forces=_numbers(forces),
    )  # fmt: skip
    return dict(zip(FILES, (header, source, test), strict=True))


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


def _part(name: str, **values: object) -> str:
    return filled(f"deployment/templates/{name}", **values)


def _numbers(values: Array) -> str:
    """An initialiser."""
    return f"{{\n    {literals(values, 4)}\n}}"
