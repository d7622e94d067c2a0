"""Controllers of fixed structure for sets of plants, continuous or sampled."""

from ccd_casadi.fixed_structure.bounds import Bounds as Bounds
from ccd_casadi.fixed_structure.bounds import ChannelBounds as ChannelBounds
from ccd_casadi.fixed_structure.bounds import ShapeEnd as ShapeEnd
from ccd_casadi.fixed_structure.certificate import SetCertificate as SetCertificate
from ccd_casadi.fixed_structure.certificate import certify as certify
from ccd_casadi.fixed_structure.channel_design import synthesise_sections as synthesise  # noqa: F401
from ccd_casadi.fixed_structure.channel_design import synthesise_sections as synthesise_sections
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure as ChannelStructure
from ccd_casadi.fixed_structure.design import SectionsDesign as SectionsDesign
from ccd_casadi.fixed_structure.design import SectionsOutcome as SectionsOutcome
from ccd_casadi.fixed_structure.structure import Structure as Structure
from ccd_casadi.lti.loop import Sampling as Sampling
