"""Case study 2: a rib-reinforced levitated stage by finite elements, open and differentiable."""

from ccd_casadi.case_studies.rib_stage.geometry import (
    LOWER,
    NAMES,
    UPPER,
    Geometry,
    Material,
    PointMass,
)
from ccd_casadi.case_studies.rib_stage.mesh import COARSE, FINE, MeshOrder
from ccd_casadi.case_studies.rib_stage.model import RibStage
from ccd_casadi.case_studies.rib_stage.pictures import mode_shapes
from ccd_casadi.case_studies.rib_stage.truncation import Mode, ModeCount
from ccd_casadi.plants.eigenpairs import StageError

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
    "PointMass",
    "RibStage",
    "StageError",
    "mode_shapes",
]
