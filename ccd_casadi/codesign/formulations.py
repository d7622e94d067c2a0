"""The three formulations of the outer problem under one name; the direct one has no surrogate."""

from dataclasses import dataclass

from ccd_casadi.cases.controller_tables import OuterTable, SamplingTable
from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.lifted import Lifted
from ccd_casadi.codesign.nested import Nested
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import StructuredProblem


@dataclass(frozen=True)
class SurrogateLimits:
    """Limits up to which surrogates are fast: docs/development/method.md."""

    parameters: int = 12  # that a fit pays for
    samples: int = 1000  # inner problems of a plan over θ, some minutes


@dataclass(frozen=True)
class Direct:
    """Options of the direct formulation: local solves on the truth.

    Parameters
    ----------
    starts : int
        The start of the case, and a Sobol set over the box.
    tolerance : float
        Of the inner problem.
    box_points : int
        True inner problems over the box in the global check at the end.
    """

    starts: int = 4
    tolerance: float = 1e-3
    box_points: int = 32

    def sample_count(self, variables: int) -> int:
        """Return the number of designs of the plan."""
        return self.starts


Formulation = Nested | Lifted | Direct


def formulation_of(case: Case | None, name: str) -> Formulation:
    """The formulation of that name.

    Parameters
    ----------
    case : Case or None
        Whose [sampling] and [outer] give the options; without one they are the defaults.
    name : str
        "nested", "lifted" or "direct".

    Returns
    -------
    Nested, Lifted or Direct
        The options by which it is solved.
    """
    outer = OuterTable() if case is None else case.outer
    sampling = SamplingTable() if case is None else case.sampling
    rounds = (outer.starts, outer.tolerance, outer.max_refinements, outer.surrogate)
    if name == "nested":
        return Nested(sampling.design, sampling.points, *rounds, outer.box_points)
    if name == "lifted":
        return Lifted(sampling.lifted_points, *rounds, outer.box_points)
    return Direct(outer.direct_starts, outer.tolerance, outer.box_points)


def usual_name(case: Case, parameters: int) -> str:
    """The formulation where the user names none: nested, or direct where nested is too slow.

    With sections, of which each θ takes a second, it is lifted where that samples fewer θ;
    `direct_starts = 1` says that each θ is expensive: none is sampled.

    Parameters
    ----------
    case : Case
        The case file.
    parameters : int
        n_θ.

    Returns
    -------
    str
        "nested", "lifted" or "direct".
    """
    listed = any(len(one.values) > 1 for one in case.theta)
    return _usual(case, parameters, case.controller.structure == "sections", listed)


def usual_formulation(problem: CoDesignProblem) -> Formulation:
    """The same of a problem, whose case's [sampling] and [outer] are not known: with defaults."""
    sections = isinstance(problem.controller, StructuredProblem)
    return formulation_of(None, _usual(None, len(problem.names), sections, bool(problem.listed)))


def _usual(case: Case | None, parameters: int, sections: bool, listed: bool) -> str:
    nested, lifted = formulation_of(case, "nested"), formulation_of(case, "lifted")
    dear = listed or (case is not None and case.outer.direct_starts == 1)
    if (sections and dear) or slow_words(nested, parameters):
        return "direct"
    fewer = nested.sample_count(parameters) > lifted.sample_count(parameters)
    return "lifted" if sections and fewer else "nested"


def slow_words(
    formulation: Formulation, parameters: int, limits: SurrogateLimits = SurrogateLimits()
) -> str:
    """Explain why a formulation is slow.

    Parameters
    ----------
    formulation : Nested, Lifted or Direct
        With its plan of samples.
    parameters : int
        n_θ.
    limits : SurrogateLimits
        Up to where surrogates are fast.

    Returns
    -------
    str
        One line; empty where it is not slow.
    """
    why = ""
    if isinstance(formulation, Direct):
        return why
    if isinstance(formulation, Nested) and formulation.plan == "grid":
        count = formulation.sample_count(parameters)
        why = f"its grid is {count:.3g} inner problems" if count > limits.samples else ""
    if not why and parameters > limits.parameters:
        why = f"its surrogates are for {limits.parameters} at most"
    name = type(formulation).__name__.lower()
    return f"{name} is slow with {parameters} parameters: {why}; direct is not" if why else ""
