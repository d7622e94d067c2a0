# What ccd_casadi/__init__.py imports when it is first used, for editors and type checkers.
from ccd_casadi.cases.case import TWO_MASS as TWO_MASS
from ccd_casadi.cases.case import load_case as load_case
from ccd_casadi.cases.case import parse_case as parse_case
from ccd_casadi.cases.case_problem import problem_of as problem_of
from ccd_casadi.cases.run_folder import read_run as read_run
from ccd_casadi.codesign.comparison import compare as compare
from ccd_casadi.codesign.direct import Direct as Direct
from ccd_casadi.codesign.lifted import Lifted as Lifted
from ccd_casadi.codesign.nested import Nested as Nested
from ccd_casadi.codesign.run import solve as solve
from ccd_casadi.codesign.solution import Solution as Solution
from ccd_casadi.codesign.verify import verify as verify
from ccd_casadi.deployment.pipeline import deploy as deploy
from ccd_casadi.fixed_structure.bounds import Bounds as Bounds
from ccd_casadi.fixed_structure.certificate import certify as certify
from ccd_casadi.fixed_structure.existing_plants import synthesise_sections as synthesise_sections
from ccd_casadi.fixed_structure.hold_and_delay import Sampling as Sampling
from ccd_casadi.fixed_structure.measured import (
    read_frequency_response as read_frequency_response,
)
from ccd_casadi.fixed_structure.modal_fit import fit_modes as fit_modes
from ccd_casadi.fixed_structure.sections_design import SectionsDesign as SectionsDesign
from ccd_casadi.fixed_structure.structure import Structure as Structure
from ccd_casadi.inner_problem.problem import CoDesignProblem as CoDesignProblem
from ccd_casadi.inner_problem.problem import scaled_plant as scaled_plant
from ccd_casadi.inner_problem.problem import true_design as true_design
from ccd_casadi.inner_problem.problem import true_inner as true_inner
from ccd_casadi.inner_problem.true_function import TrueQuantities as TrueQuantities
from ccd_casadi.interop.frames import samples_frame as samples_frame
from ccd_casadi.plants.plant import Plant as Plant
from ccd_casadi.plants.plant import build_plant as build_plant
from ccd_casadi.plants.scaling import StateSpace as StateSpace
from ccd_casadi.robust.study import robustness as robustness
from ccd_casadi.support.errors import UserError as UserError
from ccd_casadi.support.units import HZ as HZ
from ccd_casadi.synthesis.interchange import plant_from_control as plant_from_control
from ccd_casadi.synthesis.synthesis import synthesise as synthesise
from ccd_casadi.synthesis.weights import Weights as Weights

__version__: str
