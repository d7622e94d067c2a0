"""The difference equation as source code: C99 with a test, structured text, and an FMU."""

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ccd_casadi.analysis.setpoint import FeedforwardOptions
from ccd_casadi.deployment.realisation import (
    Realisation,
    difference_equation,
    dot,
    literal,
    literals,
    plain_title,
    takeover,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import package_text, template

FILE = "controller.fmu"
NAME = "controller"  # modelIdentifier
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden")
_LIBRARY = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("win", ".dll")}


def write_fmu(path: Path, realisation: Realisation, c_files: Mapping[str, str], title: str) -> bool:
    """Write the FMU of a controller whose C code is `c_files`; whether a binary is inside.

    Variables: e1, … in m, feedforward f1, … in N (0 at the start), and u1, … in N. A step of the
    co-simulation computes every sample that falls into it, at multiples of the controller's period
    from the start: u of a sample at t is there at the end of the step that begins at t, so a step
    as long as the delay gives the loop that was verified.

    Raises UserError where there is a compiler and it fails.
    """
    sources = {name: c_files[name] for name in ("controller.h", "controller.c")}
    wrapper = package_text("deployment/templates/fmu.c")
    guid = hashlib.sha256("".join([*sources.values(), wrapper]).encode()).hexdigest()[:32]
    sources["fmu.c"] = wrapper.replace("@GUID@", guid)
    K = realisation.system
    description = _description(K.B.shape[1], len(K.C), K.period, guid, title)
    library = compiled(sources)
    content: dict[str, bytes] = {"modelDescription.xml": description}
    content |= {f"sources/{name}": text.encode() for name, text in sources.items()}
    if library is not None:
        system, ending = _LIBRARY[sys.platform]
        bits = "64" if sys.maxsize > 2**32 else "32"
        content[f"binaries/{system}{bits}/{NAME}{ending}"] = library
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in content.items():
            # of the format's first day: the same controller is the same file
            file.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
    return library is not None


def compiled(sources: Mapping[str, str]) -> bytes | None:
    """The shared library of the sources; None where this machine has no compiler for it."""
    command = shlex.split(os.environ.get("CC", "cc"))
    # FMI 2.0 has names for binaries of x86 alone
    if sys.platform not in _LIBRARY or platform.machine().lower() not in ("x86_64", "amd64"):
        return None
    if not command or shutil.which(command[0]) is None:
        return None
    with TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        units = [name for name in sources if name.endswith(".c")]
        made = subprocess.run(
            [*command, *FLAGS, "-o", "library", *units],
            cwd=folder, capture_output=True, text=True, check=False,
        )  # fmt: skip
        if made.returncode:
            words = " ".join(made.stderr.split())[:200]
            raise UserError(f"{command[0]}: does not compile the FMU: {words}; set CC to another")
        return (Path(folder) / "library").read_bytes()


def _description(errors: int, forces: int, period: float, guid: str, title: str) -> bytes:
    """modelDescription.xml of FMI 2.0; value references count e, then f, then u."""
    groups = (
        ("e", errors, "m", 'causality="input" description="r - y"'),
        ("f", forces, "N", 'causality="input" description="feedforward, added before the limit"'),
        ("u", forces, "N",
         'causality="output" description="force" variability="discrete" initial="exact"'),
    )  # fmt: skip
    named = [(f"{letter}{i + 1}", *rest) for letter, n, *rest in groups for i in range(n)]
    first = errors + forces + 1
    text = template("deployment/templates/modelDescription.xml").render(
        model=NAME, guid=guid, title=title, period=f"{period:.17g}", variables=named,
        outputs=range(first, first + forces),
    )  # fmt: skip
    return text.encode()


COMPILE = (
    "cc -std=c99 -O2 -ffp-contract=off -Wall -Wextra -pedantic "
    "-o controller_test controller.c controller_test.c"
)
C_FILES, ST_FILE = ("controller.h", "controller.c", "controller_test.c"), "controller.st"


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
    forward: Array | None = None, kind: str = "Controller", tolerance: float = 1e-12,
) -> Mapping[str, str]:  # fmt: skip
    """The three files' texts by name; delay in s; the header says whether the loop was verified,
    and what `kind` of controller it is.

    `forward` (5, m, p) are the gains of `feedforward`; zeros where there are none. `tolerance`, of
    the largest force: what the test accepts.
    """
    K, limit = realisation.system, realisation.saturation
    errors, forwards, first, forces = vectors(realisation)
    values = _values(realisation, title, delay, verified, kind) | {
        "rate": f"{1.0 / K.period:.10g}", "ahead": f"{delay + 0.5 * K.period:.6g}",
        "room": max(len(K.A), 1), "limit": None if limit is None else f"{limit:.17g}",
        "blocks": realisation.blocks or (0,), "A": realisation.block_entries,
        "F": np.zeros((FeedforwardOptions().order + 1, *K.D.shape)) if forward is None else forward,
        "compile": COMPILE, "tolerance": f"{tolerance:g}", "samples": len(errors),
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


def vectors(
    realisation: Realisation, samples: int = 64, error: float = 1e-6
) -> tuple[Array, Array, Array, Array]:
    """Errors (k, p), feedforward (k, m), forces before (m,), and the forces (k, m) that follow.

    k = `samples` of a size of `error` in m. Where there is a limit the feedforward reaches beyond
    it, so that every path is tested.
    """
    K, limit = realisation.system, realisation.saturation
    rng = np.random.default_rng(0)
    errors = error * rng.standard_normal((samples, K.B.shape[1]))
    size = limit if limit is not None else error * float(np.abs(K.D).max() + 1.0)
    forwards = size * rng.standard_normal((samples, len(K.C)))
    first = np.full(len(K.C), 0.5 * size)
    start = [dot(row, [*errors[0], *first]) for row in takeover(K).tolist()]
    return errors, forwards, first, difference_equation(realisation, errors, forwards, start)
