"""Formats of a deployed controller beside C: structured text, PLCopen XML of it, and an FMU."""

from ccd_casadi.support.extensions import Extension

TEMPLATES = "extensions/formats/templates"
EXTENSION = Extension(
    functions={
        "fmu": "ccd_casadi.extensions.formats.fmu:write_fmu",
        "plcopen_xml": "ccd_casadi.extensions.formats.plcopen:plcopen_xml",
        "structured_text": "ccd_casadi.extensions.formats.structured_text:structured_text",
    }
)
