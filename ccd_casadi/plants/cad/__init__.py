"""A stage from CAD: one mesh that follows the solid's parameters, its modes and their slopes."""

from ccd_casadi.plants.cad.morph import Morph as Morph
from ccd_casadi.plants.cad.morph import draw_morph as draw_morph
from ccd_casadi.plants.cad.morph import read_morph as read_morph

__all__ = ["Morph", "draw_morph", "read_morph"]
