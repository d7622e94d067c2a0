"""The three formulations of the outer problem under one name."""

from ccd_casadi.cases.sections import Case
from ccd_casadi.codesign.direct import Direct
from ccd_casadi.codesign.lifted import Lifted
from ccd_casadi.codesign.nested import Nested

Formulation = Nested | Lifted | Direct


def formulation_of(case: Case, name: str) -> Formulation:
    """The formulation of that name with the options of a case file."""
    outer, sampling = case.outer, case.sampling
    rounds = (outer.starts, outer.tolerance, outer.max_refinements, outer.surrogate)
    if name == "nested":
        return Nested(sampling.design, sampling.points, *rounds, outer.box_points)
    if name == "lifted":
        return Lifted(sampling.lifted_points, *rounds, outer.box_points)
    return Direct(outer.direct_starts, outer.tolerance, outer.box_points)
