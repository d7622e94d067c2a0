"""What a case says of its tolerances, checked: what cannot be kept for a share is refused."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.checks import CaseError
from ccd_casadi.cases.tables import Case
from ccd_casadi.extensions.tolerances.machines import Plan
from ccd_casadi.extensions.tolerances.prices import SHARES, tolerances_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_bandwidth import require_bandwidth
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.support.errors import UserError


@dataclass(frozen=True)
class ToleranceCase:
    """A case with the problem of its whole box.

    Attributes
    ----------
    case, problem : Case, CoDesignProblem
    plan : Plan or None
        Of its share, where it has one.
    distribution : mapping
        By tolerance; uniform where it has none.
    """

    case: Case
    problem: CoDesignProblem
    plan: Plan | None
    distribution: Mapping[str, str]


def tolerance_case(case: Case) -> ToleranceCase:
    """Check what a case says of its tolerances.

    Parameters
    ----------
    case : Case

    Returns
    -------
    ToleranceCase

    Raises
    ------
    UserError
        A key has no effect, or what it names cannot be kept for a share.
    """
    table = case.robust

    def fail(key: str, words: str) -> CaseError:
        return CaseError(f"{case.path}: robust.{key}: {words}")

    if table.share is None:
        for key in ("confidence", "distribution"):
            if getattr(table, key) != type(table).__dataclass_fields__[key].default:
                raise fail(key, "has no effect without share; give share, or drop it")
    elif table.cost_per_percent is not None:
        raise fail("cost_per_percent", "is of the whole box; drop it, or share")
    if table.half_width is not None and table.cost_per_percent is None:
        raise fail("half_width", "has no effect without cost_per_percent; give that, or drop it")
    problem = problem_of(replace(case, robust=replace(table, share=None)))
    if not isinstance(problem.controller, StructuredProblem):
        words = 'tolerances are of controller.structure = "sections"; choose that structure'
        raise UserError(f"{case.path}: controller.structure: {words}")
    require_bandwidth(problem, "tolerances")
    for name, _ in problem.listed:
        words = "tolerances need a range; give fixed, as the case.toml of a finished solve does"
        raise UserError(f"{case.path}: theta.{name}.values: {words}")
    known = tolerances_of(problem)
    if not known:
        raise UserError(f"{case.path}: robust: has no tolerance; give one, as resonance_shift")
    _require_known("distribution", table.distribution or (), known, fail)
    of_cost = [name for name in SHARES if name in known]
    _require_known("cost_per_percent", table.cost_per_percent or (), of_cost, fail)
    _require_known("half_width", table.half_width or (), table.cost_per_percent or (), fail)
    for name, (low, high) in (table.half_width or {}).items():
        own = getattr(table, name)
        if not low <= own <= high:
            words = f"is {low:g} to {high:g}, without the case's own {own:g}; widen it"
            raise fail(f"half_width.{name}", words)
        if wrong := type(table).__dataclass_fields__[name].metadata["check"](high):
            raise fail(f"half_width.{name}", wrong)
    plan = None if table.share is None else Plan(table.share, table.confidence)
    if plan is not None:
        plan.trial  # noqa: B018  raises where none exists, before anything is searched
    return ToleranceCase(case, problem, plan, table.distribution or {})


def _require_known(
    key: str, given: Iterable[str], known: Iterable[str], fail: Callable[[str, str], CaseError]
) -> None:
    for name in given:
        if name not in known:
            raise fail(f"{key}.{name}", f"has no such tolerance; known are {', '.join(known)}")
