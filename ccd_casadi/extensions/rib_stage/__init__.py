"""Case study 2: a rib-reinforced levitated stage by finite elements, open and differentiable."""

from ccd_casadi.support.extensions import Extension

EXTENSION = Extension(plants={"rib_stage": "ccd_casadi.extensions.rib_stage.stage_plant:MODEL"})
