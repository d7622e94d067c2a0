"""A function block as PLCopen XML (TC6, version 2.01), of its structured text."""

import re
from xml.etree.ElementTree import Element, SubElement, indent, register_namespace, tostring

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
