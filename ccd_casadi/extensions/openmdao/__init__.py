"""Certified loops as components of OpenMDAO: a library, without a command."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension()
