"""A stage from CAD: one mesh that follows the solid's parameters, its modes and their slopes."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(plants={"cad_stage": "ccd_casadi.extensions.cad.cad_stage:MODEL"})
