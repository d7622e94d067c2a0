"""Case study 2: a rib-reinforced levitated stage by finite elements, open and differentiable."""

from ccd_casadi.plants.eigenpairs import StageError
from ccd_casadi.plants.rib_stage.geometry import LOWER, NAMES, UPPER, Geometry, Material, PointMass
from ccd_casadi.plants.rib_stage.mesh import COARSE, FINE, MeshOrder
from ccd_casadi.plants.rib_stage.model import RibStage
from ccd_casadi.plants.rib_stage.pictures import ModeShape, mode_shape
from ccd_casadi.plants.rib_stage.truncation import Mode, ModeCount

__all__ = [
    "COARSE",
    "FINE",
    "LOWER",
    "NAMES",
    "UPPER",
    "Geometry",
    "Material",
    "MeshOrder",
    "Mode",
    "ModeCount",
    "ModeShape",
    "PointMass",
    "RibStage",
    "StageError",
    "mode_shape",
]
