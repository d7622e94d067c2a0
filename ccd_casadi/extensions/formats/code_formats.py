"""A controller as structured text of IEC 61131-3, PLCopen XML (TC6, 2.01) of it, and an FMU."""

import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree.ElementTree import Element, SubElement, indent, register_namespace, tostring

import numpy as np

from ccd_casadi.deployment.realisation import Realisation, literal, literals
from ccd_casadi.deployment.source_code import ST_FILE, values_of
from ccd_casadi.extensions.formats import TEMPLATES
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import package_text, template


def structured_text(
    realisation: Realisation, *, title: str, delay: float, verified: bool, kind: str = "Controller",
    no_limit: float = 1e30,
) -> str:  # fmt: skip
    """The function block; delay in s. A controller without states keeps one that stays at rest.

    Its words are such that matiec compiles them: no name of a standard function (LIMIT), no single
    letter that qualifies an action (D, L), and no FOR, which it skips where both ends are equal.
    """
    K, limit, sizes = realisation.system, realisation.saturation, realisation.blocks or (1,)
    n, (m, p), rest = sum(sizes), K.D.shape, {}
    if not len(K.A):
        shapes = {"A": (1, 1), "B": (1, p), "C": (m, 1), "X": (1, p + m), "L": (1, m)}
        rest = {name: np.zeros(shape) for name, shape in shapes.items()}
    starts = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes)
    L = realisation.back_calculation
    values = values_of(realisation, title, delay, verified, kind) | {
        "n": n, "limit": literal(no_limit if limit is None else limit), "starts": starts,
        "ends": starts + np.repeat(sizes, sizes) - 1, "A": K.A,
        "L": np.zeros((n, m)) if L is None else L, "numbers": lambda entries: literals(entries, 8),
    }  # fmt: skip
    return template(f"{TEMPLATES}/{ST_FILE}").render(values | rest)


SPACE, XHTML = "http://www.plcopen.org/xml/tc6_0201", "http://www.w3.org/1999/xhtml"
SECTIONS = {"VAR_INPUT": "inputVars", "VAR_OUTPUT": "outputVars", "VAR": "localVars",
            "VAR CONSTANT": "localVars"}  # fmt: skip
_SECTION = re.compile(r"^(VAR\w*(?: CONSTANT)?)\n(.*?)^END_VAR\n", re.DOTALL | re.MULTILINE)
_VARIABLE = re.compile(r"(\w+) : (?:ARRAY\[0\.\.(\d+)\] OF )?(\w+)(?: := (.*?))?;", re.DOTALL)


def plcopen_xml(text: str, name: str) -> str:
    """Write a function block as a project that PLC programs import.

    Parameters
    ----------
    text : str
        Structured text, as of `structured_text`.
    name : str
        Of the project.

    Returns
    -------
    str
        Without a date of its own: the same block is the same file.
    """
    remark, block = text.split("*)", 1)
    _, title, block = re.split(r"FUNCTION_BLOCK (\w+)\n", block)
    *_, last = _SECTION.finditer(block)
    body = block[last.end() :].removesuffix("END_FUNCTION_BLOCK\n").strip("\n")
    project = Element("project", xmlns=SPACE)
    SubElement(project, "fileHeader", companyName="ccd-casadi", productName="ccd-casadi",
               productVersion="1", creationDateTime="1980-01-01T00:00:00")  # fmt: skip
    header = SubElement(project, "contentHeader", name=name)
    SubElement(header, "Comment").text = " ".join(remark.strip("(* \n").split())
    places = SubElement(header, "coordinateInfo")
    for language in ("fbd", "ld", "sfc"):
        SubElement(SubElement(places, language), "scaling", x="1", y="1")
    types = SubElement(project, "types")
    SubElement(types, "dataTypes")
    pou = SubElement(SubElement(types, "pous"), "pou", name=title, pouType="functionBlock")
    interface = SubElement(pou, "interface")
    for kind, lines in _SECTION.findall(block):
        constant = {"constant": "true"} if kind.endswith("CONSTANT") else {}
        held = SubElement(interface, SECTIONS[kind], constant)
        for variable in _VARIABLE.findall(lines):
            _declare(held, *variable)
    code = SubElement(SubElement(SubElement(pou, "body"), "ST"), f"{{{XHTML}}}p")
    code.text = f"\n{body}\n"
    SubElement(SubElement(project, "instances"), "configurations")
    register_namespace("xhtml", XHTML)
    indent(project)
    code.text = f"\n{body}\n"
    return '<?xml version="1.0" encoding="utf-8"?>\n' + tostring(project, "unicode") + "\n"


def _declare(held: Element, name: str, last: str, kind: str, value: str) -> None:
    variable = SubElement(held, "variable", name=name)
    place = SubElement(variable, "type")
    if last:
        place = SubElement(place, "array")
        SubElement(place, "dimension", lower="0", upper=last)
        place = SubElement(place, "baseType")
    SubElement(place, kind)
    if not value:
        return
    start = SubElement(variable, "initialValue")
    if not last:
        SubElement(start, "simpleValue", value=value)
        return
    entries = SubElement(start, "arrayValue")
    for entry in value.strip("[] \n").split(","):
        SubElement(SubElement(entries, "value"), "simpleValue", value=entry.strip())


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
    library = compile_library(sources)
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


def compile_library(sources: Mapping[str, str]) -> bytes | None:
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
