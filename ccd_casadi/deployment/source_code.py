"""The difference equation as source code: C99 with a test."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.analysis.setpoint_feedforward import FeedforwardOptions
from ccd_casadi.deployment.realisation import (
    Realisation,
    difference_equation,
    dot,
    literals,
    numbers,
    plain_title,
    takeover,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import template

COMPILE = (
    "cc -std=c99 -O2 -ffp-contract=off -Wall -Wextra -pedantic "
    "-o controller_test controller.c controller_test.c"
)
C_FILES = ("controller.h", "controller.c", "controller_test.c")
# of the extension `formats`
ST_FILE, XML_FILE, FMU_FILE = "controller.st", "controller.xml", "controller.fmu"


def write_c(folder: Path, realisation: Realisation, **how: Any) -> Mapping[str, str]:
    """Write controller.h, controller.c and controller_test.c.

    Parameters
    ----------
    folder : Path
        Exists.
    realisation : Realisation
        The difference equation.
    how : keywords
        Of `c_files`.

    Returns
    -------
    mapping of str
        Their texts by name.
    """
    files = c_files(realisation, **how)
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    return files


def c_files(
    realisation: Realisation, *, title: str, delay: float, verified: bool,
    forward: Array | None = None, kind: str = "Controller", tolerance: float | None = None,
) -> Mapping[str, str]:  # fmt: skip
    """The three files' texts by name; delay in s; the header says whether the loop was verified,
    and what `kind` of controller it is.

    `forward` (5, m, p) are the gains of `feedforward`; zeros where there are none. `tolerance`, of
    the largest force: what the test accepts, by default 1e-12, of single precision 1e-6.
    """
    if realisation.fixed is not None:
        return _fixed_files(realisation, values_of(realisation, title, delay, verified, kind))
    tolerance = tolerance or (1e-6 if realisation.single else 1e-12)
    K, limit = realisation.system, realisation.saturation
    errors, forwards, first, forces = vectors(realisation)
    values = values_of(realisation, title, delay, verified, kind) | {
        "real": "float" if realisation.single else "double",
        "rate": f"{1.0 / K.period:.10g}", "ahead": f"{delay + 0.5 * K.period:.6g}",
        "room": max(len(K.A), 1), "limit": None if limit is None else f"{limit:.17g}",
        "blocks": realisation.blocks or (0,), "A": realisation.block_entries,
        "F": np.zeros((FeedforwardOptions().order + 1, *K.D.shape)) if forward is None else forward,
        "compile": COMPILE, "tolerance": f"{tolerance:g}", "samples": len(errors),
        "errors": errors, "forwards": forwards, "first": first, "forces": forces,
        "initialiser": lambda entries: f"{{\n    {literals(entries, 4)}\n}}",
    }  # fmt: skip
    return {name: template(f"deployment/templates/{name}").render(values) for name in C_FILES}


def _fixed_files(realisation: Realisation, values: Mapping[str, Any]) -> Mapping[str, str]:
    """The three files of integers."""
    fixed = realisation.fixed
    assert fixed is not None
    errors, forwards, first, forces = vectors(realisation)
    rows = (*fixed.to_forces, *fixed.to_states, *fixed.at_start)

    named = {
        "bits": fixed.bits, "guard": fixed.guard, "largest": fixed.largest,
        "wide": 32 if fixed.bits + fixed.guard <= 32 else 64,
        "rate": f"{1.0 / realisation.system.period:.10g}",
        "rows": rows, "limits": fixed.limits,
        "ends": [sum(map(len, rows[:i])) for i in range(len(rows) + 1)],
        "error_steps": fixed.errors.tolist(), "force_steps": fixed.forces.tolist(),
        "compile": COMPILE, "samples": len(errors), "errors": errors.ravel(),
        "forwards": forwards.ravel(), "first": first, "forces": forces.ravel(),
        "integers": lambda entries: "{" + ", ".join(str(int(x)) for x in entries) + "}",
    }  # fmt: skip
    return {name: template(f"deployment/templates/fixed_{name}").render({**values, **named})
            for name in C_FILES}  # fmt: skip


def values_of(
    realisation: Realisation, title: str, delay: float, verified: bool, kind: str
) -> dict[str, Any]:
    """Collect what every language needs of a controller.

    Parameters
    ----------
    realisation : Realisation
    title : str
    delay : float
        s.
    verified : bool
        Whether the run is.
    kind : str
        Of the controller, in words.

    Returns
    -------
    dict
        By the names of the templates.
    """
    K = realisation.system
    return {
        "title": plain_title(title), "kind": kind, "verified": verified,
        "period": f"{K.period:.17g}",
        "delay": f"{delay:.10g}", "n": len(K.A), "p": K.B.shape[1], "m": len(K.C),
        "B": K.B, "C": K.C, "D": K.D, "L": realisation.back_calculation, "X": takeover(K),
    }  # fmt: skip


def vectors(
    realisation: Realisation, samples: int = 64, error: float = 1e-6
) -> tuple[Array, Array, Array, Array]:
    """Errors (k, p), feedforward (k, m), forces before (m,), and the forces (k, m) that follow.

    k = `samples` of a size of `error` in m. Where there is a limit the feedforward reaches beyond
    it, so that every path is tested.
    """
    K, limit = realisation.system, realisation.saturation
    rng = np.random.default_rng(0)
    fixed = realisation.fixed
    if fixed is not None:  # the whole range of a word, so that every limit is met
        sizes = (samples, K.B.shape[1]), (samples, len(K.C)), len(K.C)
        draws = [rng.integers(-fixed.largest, fixed.largest + 1, size) for size in sizes]
        for draw in draws[:2]:  # and small ones, which move the last bits alone
            draw[: samples // 2] //= fixed.largest // 100
        began = fixed.begin(draws[0][0].tolist(), draws[2].tolist())
        words, ahead, held = (draw.astype(float) for draw in draws)
        return words, ahead, held, difference_equation(realisation, words, ahead, began)
    errors = error * rng.standard_normal((samples, K.B.shape[1]))
    size = limit if limit is not None else error * float(np.abs(K.D).max() + 1.0)
    forwards = size * rng.standard_normal((samples, len(K.C)))
    first = np.full(len(K.C), 0.5 * size)
    (before,) = numbers(realisation, np.concatenate([errors[0], first])[None])
    start = [float(dot(row, before)) for row in numbers(realisation, takeover(K))]
    return errors, forwards, first, difference_equation(realisation, errors, forwards, start)
