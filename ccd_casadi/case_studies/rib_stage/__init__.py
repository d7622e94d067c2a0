"""Case study 2: a rib-reinforced levitated stage by finite elements, open and differentiable."""

from ccd_casadi.case_studies.rib_stage.geometry import LOWER as LOWER
from ccd_casadi.case_studies.rib_stage.geometry import NAMES as NAMES
from ccd_casadi.case_studies.rib_stage.geometry import UPPER as UPPER
from ccd_casadi.case_studies.rib_stage.geometry import Geometry as Geometry
from ccd_casadi.case_studies.rib_stage.geometry import Material as Material
from ccd_casadi.case_studies.rib_stage.geometry import PointMass as PointMass
from ccd_casadi.case_studies.rib_stage.mesh import COARSE as COARSE
from ccd_casadi.case_studies.rib_stage.mesh import FINE as FINE
from ccd_casadi.case_studies.rib_stage.mesh import MeshOrder as MeshOrder
from ccd_casadi.case_studies.rib_stage.model import Mode as Mode
from ccd_casadi.case_studies.rib_stage.model import ModeCount as ModeCount
from ccd_casadi.case_studies.rib_stage.model import RibStage as RibStage
from ccd_casadi.case_studies.rib_stage.pictures import mode_shapes as mode_shapes
from ccd_casadi.plants.eigenpairs import StageError as StageError
