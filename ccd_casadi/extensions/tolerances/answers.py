"""What `ccd tolerances` reads and answers: a design for a share of machines, or prices."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccd_casadi.cases.case import case_to_toml
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.checks import CaseError
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.formulations import formulation_of, usual_name
from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.run import within
from ccd_casadi.codesign.structured_entries import design_dict, sections_controller
from ccd_casadi.codesign.verdict import Check, State, deployable
from ccd_casadi.extensions.tolerances.machines import Plan, ShareCertificate, certified_share
from ccd_casadi.extensions.tolerances.prices import (
    SHARES,
    Bought,
    WidthSearch,
    buy,
    prices,
    tolerances_of,
)
from ccd_casadi.extensions.tolerances.share_search import ShareSearch, search_share, start_search
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.inner_problem.objective import objective
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.searched_problem import state_of, with_state
from ccd_casadi.inner_problem.structured_bandwidth import require_bandwidth
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox, recertify
from ccd_casadi.inner_problem.structured_search import prepare_search
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.terminal import remark
from ccd_casadi.support.text import HZ, number
from ccd_casadi.support.time_budget import within_budget


@dataclass(frozen=True)
class ToleranceCase:
    """A case with the problem of its whole box."""

    case: Case
    problem: CoDesignProblem
    plan: Plan | None  # of its share, where it has one
    distribution: Mapping[str, str]  # by tolerance; uniform where it has none


def tolerance_case(case: Case) -> ToleranceCase:
    """Check what a case says of its tolerances. Raises UserError where a key has no effect, or what
    it names cannot be kept for a share.
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


@dataclass(frozen=True)
class Answer:
    """The result of a command."""

    entry: dict[str, Any]  # of tolerances.json
    words: tuple[str, ...]  # lines for the terminal
    good: bool  # whether what is required is shown
    files: dict[str, Any]  # content of further files by name: JSON values, or text


@dataclass(frozen=True)
class ShareDesign:
    """A design for a share of machines, judged."""

    whole: SectionsDesign | None  # for the whole box at `whole_theta`; None where there is none
    whole_theta: tuple[float, ...]
    search: ShareSearch
    design: SectionsDesign  # certified anew on its working set
    certificate: ShareCertificate


def design_for_share(
    of: ToleranceCase, sampler: Sampler, theta: tuple[float, ...] | None, seed: int, minutes: float
) -> ShareDesign:
    """The whole box first, from there the share, then fresh draws.

    `theta` is the machine in SI; None: it is searched. Each of the two searches has its `minutes`.
    """
    assert of.plan is not None

    def log(words: str) -> None:
        remark(f"share: {words}", sampler.quiet)

    problem, whole, at = sampler.problem, None, theta or of.problem.start
    if theta is not None:
        fixed = with_state(replace(problem, start=theta), seed=seed)
        with within_budget(minutes):
            problem, made, _ = prepare_search(fixed, log, sampler.workers)
        whole = made if made.certified else None
    else:
        formulation = formulation_of(of.case, usual_name(of.case, len(problem.names)))
        verified = within(minutes, sampler, formulation, seed).verified
        if verified is not None and verified.certified:
            problem, whole, at = verified.problem, verified.design, verified.theta
    kappa = None if whole is None else whole.kappa
    with within_budget(minutes):
        first = start_search(sampler.of(problem), at, kappa, of.plan, of.distribution, seed, log)
        found = search_share(first, log, moves=theta is None)
    design = recertify(found.problem, found.best.theta, found.design)
    on_box = DesignOnBox(found.problem, found.best.theta, design)
    judged = certified_share(on_box, of.plan, of.distribution, seed, sampler.workers)
    return ShareDesign(whole, at, found, design, judged)


def share_answer(found: ShareDesign) -> Answer:
    """The verdict, the design, and what it gains over that for the whole box."""
    search, design, whole = found.search, found.design, found.whole
    problem, theta, line = search.problem, search.best.theta, found.certificate.line
    good = found.certificate.passed and design.certified
    at = ", ".join(f"{name} = {number(v)} {unit}" for name, v, unit in
                   zip(problem.names, theta, problem.units, strict=True))  # fmt: skip
    words = [f"share         {line.state.value}: {line.words}"]
    words += [f"              {detail}" for detail in line.details]
    words.append(f"design        {_figures_words(problem, theta, design)}; {at}")
    if not design.certified:
        words.insert(0, f"certified     failed: {design.words}")
    if not search.settled:
        words.append("search        ended before new draws accepted the design")
    own: dict[str, Any] = {}
    if whole is not None:
        own = {"theta": dict(zip(problem.names, found.whole_theta, strict=True)),
               "bandwidth_hz": whole.bandwidth / HZ,
               "hardware_cost": hardware_cost(plant_of(problem), found.whole_theta)}  # fmt: skip
        gain = 100.0 * (design.bandwidth / whole.bandwidth - 1.0)
        figures = _figures_words(problem, found.whole_theta, whole)
        words.append(f"whole box     {figures}; the share has {gain:+z.1f} % of bandwidth")
    else:
        words.append("whole box     no controller was found for it")
    kept = [{"option": option, "point": list(point)}
            for option, point in state_of(problem).scenarios]  # fmt: skip
    entry = {
        "status": "verified" if good else "not_verified",
        "verdict": {"share": line.entry},
        "theta": dict(zip(problem.names, theta, strict=True)),
        "hardware_cost": hardware_cost(plant_of(problem), theta),
        **json_values(design_dict(problem, theta, design)),
        "whole_box": own or None,
        "search": {
            "drawn": search.rounds * search.plan.draws, "rounds": search.rounds,
            "settled": search.settled,
            "set": kept,
        },
    }  # fmt: skip
    if design.controller is None:
        return Answer(entry, tuple(words), good, {})
    of_run = entry | {  # what `read_run` takes
        "formulation": "share", "objective": objective(problem, theta, design.bandwidth),
        "cost_unit": problem.cost_unit, "units": problem.parameter_units,
        "reason": "" if good else words[0], "anchors": [design.kappa.tolist()],
        "robust": {"set": kept}, "seed": search.seed,
        "verdict": {
            "certified": Check(
                "certified", State.PASSED if design.certified else State.FAILED,
                (Reason.DESIGNED_ON(words=design.words),), {},
            ).entry,
            "survives": line.entry,
            "deployable": deployable(None, problem.sampling).entry,
        },
    }  # fmt: skip
    files = {"controller.json": sections_controller(design, problem.sampling),
             "result.json": of_run}  # fmt: skip
    return Answer(entry, tuple(words), good, files)


def price_answer(run: FinishedRun, sampler: Sampler, quiet: bool) -> Answer:
    """The price list of a run; with `cost_per_percent` the half-widths that cost least."""

    def log(words: str) -> None:
        remark(f"prices: {words}", quiet)

    assert run.kappa is not None
    table = run.case.robust
    bandwidth, found = prices(run.problem, run.theta, run.kappa, sampler.workers, log)
    entry: dict[str, Any] = {"bandwidth_hz": bandwidth / HZ, "prices": [p.entry for p in found]}
    words = [f"design        {number(bandwidth / HZ)} Hz with all tolerances",
             *(f"price         {price.words}" for price in found)]  # fmt: skip
    if table.cost_per_percent is None:
        return Answer(entry, tuple(words), True, {})

    def report_bought(one: Bought) -> None:
        log(f"J = {number(one.objective, 7)} at {_widths_words(one)}")

    best = buy(sampler, run.theta, run.kappa, table.cost_per_percent, table.half_width or {},
               report_bought)  # fmt: skip
    if best is None:
        words.insert(0, "widths        the run's design was not found again")
        return Answer(entry, tuple(words), False, {})
    entry["widths"] = _widths_entry(run.problem, best)
    name = "tolerances_bought.toml"
    words += [
        f"widths        {_widths_words(best.best)}: {number(best.best.bandwidth / HZ)} Hz, "
        f"J = {number(best.best.objective, 7)} instead of {number(best.first.objective, 7)}",
        f"              best of {best.evaluations}; the slopes promise at most "
        f"{number(best.gap, 2)} more in J, where J is convex; solve {name} to verify it",
    ]
    bought = case_to_toml(_with_bought(run.case, best.best))
    return Answer(entry, tuple(words), True, {name: bought})


def _figures_words(
    problem: CoDesignProblem, theta: tuple[float, ...], design: SectionsDesign
) -> str:
    cost = hardware_cost(plant_of(problem), theta)
    return f"{number(design.bandwidth / HZ)} Hz, f = {number(cost)} {problem.cost_unit}".rstrip()


def _widths_words(one: Bought) -> str:
    return ", ".join(f"{name} ±{number(100.0 * t, 3)} %" for name, t in one.widths.items())


def _widths_entry(problem: CoDesignProblem, found: WidthSearch) -> dict[str, Any]:
    def of(one: Bought) -> dict[str, Any]:
        return {"half_widths": dict(one.widths), "objective": one.objective,
                "bandwidth_hz": one.bandwidth / HZ, "slopes": dict(one.slopes),
                "theta": dict(zip(problem.names, one.theta, strict=True))}  # fmt: skip

    gap = found.gap if np.isfinite(found.gap) else None
    return {"best": of(found.best), "of_the_case": of(found.first), "gap_if_convex": gap,
            "evaluations": found.evaluations}  # fmt: skip


def _with_bought(case: Case, best: Bought) -> Case:
    """The case with these half-widths, its start at the machine; without prices, which are of the
    case's own half-widths."""
    widths: dict[str, Any] = dict(best.widths)
    bare = replace(case.robust, cost_per_percent=None, half_width=None, **widths)
    theta = tuple(replace(one, start=v) for one, v in zip(case.theta, best.theta, strict=True))
    return replace(case, robust=bare, theta=theta)
