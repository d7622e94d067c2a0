"""The three formulations of the outer problem under one name."""

from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.direct import Direct
from ccd_casadi.codesign.lifted import Lifted
from ccd_casadi.codesign.nested import Nested

Formulation = Nested | Lifted | Direct
MANY = 12  # parameters up to which surrogates pay for their fit: docs/development/method.md
SAMPLES = 1000  # inner problems of a plan over θ, some minutes


def formulation_of(case: Case, name: str) -> Formulation:
    """The formulation of that name with the options of a case file."""
    outer, sampling = case.outer, case.sampling
    rounds = (outer.starts, outer.tolerance, outer.max_refinements, outer.surrogate)
    if name == "nested":
        return Nested(sampling.design, sampling.points, *rounds, outer.box_points)
    if name == "lifted":
        return Lifted(sampling.lifted_points, *rounds, outer.box_points)
    return Direct(outer.direct_starts, outer.tolerance, outer.box_points)


def usual_name(case: Case, parameters: int) -> str:
    """The formulation where the user names none: nested, or direct where nested has no end.

    With sections `direct_starts = 1` says that each θ is dear: none is sampled.
    """
    listed = any(len(one.values) > 1 for one in case.theta)
    dear = listed or case.outer.direct_starts == 1
    slow = (dear and case.controller.structure == "sections") or slow_words(
        formulation_of(case, "nested"), parameters
    )
    return "direct" if slow else "nested"


def slow_words(formulation: Formulation, parameters: int) -> str:
    """Why a formulation is slow with so many parameters, in one line; empty where it is not."""
    why = ""
    if isinstance(formulation, Direct):
        return why
    if isinstance(formulation, Nested) and formulation.plan == "grid":
        count = formulation.points**parameters
        why = f"its grid is {count:.3g} inner problems" if count > SAMPLES else ""
    if not why and parameters > MANY:
        why = f"its surrogates are for {MANY} at most"
    name = type(formulation).__name__.lower()
    return f"{name} is slow with {parameters} parameters: {why}; direct is not" if why else ""
