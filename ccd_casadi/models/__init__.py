"""The plants of the case studies, each a model function as the case file names it."""

from ccd_casadi.models.two_mass import two_mass as two_mass
from ccd_casadi.plant import ModelFunction

MODELS: dict[str, ModelFunction] = {"two_mass": two_mass}
