"""A controller as an FMU: FMI 2.0, co-simulation."""

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

from ccd_casadi.deployment.realisation import Realisation
from ccd_casadi.extensions.formats import TEMPLATES
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import package_text, template

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
    wrapper = package_text(f"{TEMPLATES}/fmu.c")
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
    text = template(f"{TEMPLATES}/modelDescription.xml").render(
        model=NAME, guid=guid, title=title, period=f"{period:.17g}", variables=named,
        outputs=range(first, first + forces),
    )  # fmt: skip
    return text.encode()
