"""Formats of a deployed controller beside C: structured text, PLCopen XML of it, and an FMU."""

from ccd_casadi.support.extensions import Extension

TEMPLATES = "extensions/formats/templates"
EXTENSION = Extension(
    functions={
        "fmu": "ccd_casadi.extensions.formats.code_formats:write_fmu",
        "plcopen_xml": "ccd_casadi.extensions.formats.code_formats:plcopen_xml",
        "structured_text": "ccd_casadi.extensions.formats.code_formats:structured_text",
    }
)
