"""The plants of the case studies as the case file names them.

A model function speaks CasADi; a plant builder takes the names of θ and evaluates by numbers.
"""

from collections.abc import Callable

from ccd_casadi.plants.cad.plant import cad_stage
from ccd_casadi.plants.imported.plant import modal_table, sampled_matrices
from ccd_casadi.plants.plant import ModelFunction, Plant
from ccd_casadi.plants.rib_stage.plant import rib_stage
from ccd_casadi.plants.two_mass import two_mass

MODELS: dict[str, ModelFunction] = {"two_mass": two_mass}
BUILDERS: dict[str, Callable[..., Plant]] = {
    "rib_stage": rib_stage,
    "modal_table": modal_table,
    "sampled_matrices": sampled_matrices,
    "cad_stage": cad_stage,
}
# The option of a model that names its data, relative to the case file.
DATA: dict[str, str] = {"modal_table": "table", "sampled_matrices": "folder", "cad_stage": "morph"}
SHIPPED = frozenset({"two_mass", "rib_stage"})  # known to be sound: not diagnosed on loading
