"""What a solve writes into its run folder; result.json, alike for every kind of controller.

Lines of the verdict that later commands find are written back into it. A line keeps what the solve
itself said of it (`at_solve`), so that a command may be given again.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.cases.case import case_to_toml
from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.gaussian_processes import quality_dict
from ccd_casadi.codesign.outer_problem import (
    FormulationResult,
    GlobalCheck,
    OuterSolution,
    RunTerms,
)
from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.requirements import requirements
from ccd_casadi.codesign.result_entries import budget_entry, iso_entry, move_entry
from ccd_casadi.codesign.verdict import Check, State, confirm, deployable, judge_prediction, optimal
from ccd_casadi.codesign.verified import Solution, Verified
from ccd_casadi.inner_problem.problem import notes_of
from ccd_casadi.sampling.inner_samples import spent_entry
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.json_files import json_values, write_json
from ccd_casadi.support.text import versions
from ccd_casadi.support.time_budget import TimeBudget
from surrogates import Quality, save
from surrogates.files import write_whole

if TYPE_CHECKING:
    from ccd_casadi.cases.run_folder import FinishedRun

FORMAT = 1  # of result.json: raised when a key of result.schema.json goes or changes its meaning


def result_dict(
    terms: RunTerms,
    outcome: FormulationResult,
    verified: Verified,
    spent: Mapping[str, int],
    quality: tuple[Quality, ...] = (),
    global_check: GlobalCheck | None = None,
) -> dict[str, Any]:
    """result.json of a solved run; `status` says whether it is verified, `reason` why not."""
    problem, tolerance = verified.problem, terms.tolerance
    promised = outcome.foreseen
    learnt = promised is not None
    if promised is None:
        promised = predicted_value(outcome, verified.point, verified.value)
    error = abs(promised / verified.value - 1.0)
    optimality = partial(
        optimal, verified.kkt, level=verified.kkt_level, saddle=verified.saddle,
        tolerance=tolerance, better=verified.better(), unknown=verified.no_gradient(),
        searched=verified.search_findings(outcome, global_check),
    )  # fmt: skip
    judged = quality[0] if quality else None
    verdict = (  # in the order in which they matter
        confirm(verified.certified_line(), verified.second),
        optimality(gap=verified.inner_gap),
        judge_prediction(error, tolerance, verified.value, problem.figure, judged, learnt),
        verified.survives_line(),
        deployable(verified.survival, problem.sampling, verified.between, problem.inner.S_max),
    )
    evidence = verified.evidence(promised)
    held = {k: v for k, v in problem.source.held.items() if k not in evidence.get("varies", {})}
    checks: dict[str, bool | None] = {  # None: it could not be made, or there is nothing to check
        "certificate": verified.certified,
        "constraints": verified.feasible,
        "judge": verified.judgement.passed,
        "second_engine": verified.second.agrees,
        "prediction": None if learnt or judged is None else bool(error <= tolerance),
        "inner_optimum": None if np.isnan(verified.inner_gap) else verified.inner_gap <= tolerance,
        "optimality": optimality(gap=0.0).state is not State.FAILED,
        **verified.checks(),
    }
    failed = [name for name, passed in checks.items() if passed is False]
    lost = [f"{line.name}: {line.words}" for line in verdict if line.state is State.FAILED]
    failed = failed or [line.name for line in verdict if line.state is State.FAILED]
    why = f"failed: {', '.join(failed)} ({'; '.join(lost)})"
    words = "; ".join(part for part in (why, outcome.message) if part) if failed else ""
    figures = verified.figures()
    result = {
        **figures,
        "status": "not_verified" if failed else "verified",
        "reason": words,
        "verdict": {line.name: line.entry for line in verdict},
        "formulation": terms.formulation,
        "theta": dict(zip(problem.names, verified.theta, strict=True)),
        "units": problem.parameter_units,
        "cost_unit": problem.cost_unit,
        **({"fixed": held} if held else {}),
        "objective": verified.objective,
        "hardware_cost": verified.hardware_cost,
        "minimise": problem.figure.key,
        "verification_error": error,
        "checks": checks,
        "active": list(verified.active),
        "inner_gap": verified.inner_gap,
        # a vertex has no second-order figure, and says so
        "kkt": {**vars(verified.kkt), "vertex": verified.kkt.second_order == math.inf},
        "globality": outcome.outer or OuterSolution((), 0),
        "judge": verified.judgement.entry,
        "requirements": [
            one.entry
            for one in requirements(verified, figures.get("sensitivity_peak_hz", math.nan))
        ],
        "second_engine": verified.second.entry,
        "box_look": {} if global_check is None else global_check.entry,
        "notes": list(notes_of(problem, verified.theta)),
        "iterates": outcome.iterates,
        **run_entry(terms, spent, global_check is not None and global_check.moved),
        "surrogate_quality": quality_dict(quality),
        **evidence,
        **budget_entry(problem, verified.theta, verified.controller),
        **move_entry(problem, verified.theta, verified.controller),
        **iso_entry(problem, verified.theta, {**figures, **evidence}),
    }
    return json_values(result)


def of_budget(
    solution: Solution, spent: TimeBudget, seconds: Mapping[str, Any] | None = None
) -> Solution:
    """A solution as its time budget leaves it.

    Where that ended a search nothing is known of the optimum: `optimal` and its checks are unknown,
    and a design is verified without them; `optimal` warns of one that is known to be not optimal.

    Parameters
    ----------
    solution : Solution
    spent : TimeBudget
    seconds : mapping
        Of the wall and of processors, by purpose.

    Returns
    -------
    Solution
        With `time_budget` and `phase_seconds` in its result.
    """
    own = {"time_budget": spent.entry, "phase_seconds": dict(seconds or {})}
    result = {**solution.result, **own}
    # without a design, whether more time helps depends on the plant: `solve` adds it
    more = (Reason.LARGER_BUDGET(),) if "verdict" in result else ()
    ended = (Reason.BUDGET(**spent.entry), *more) if spent.ended else ()
    words = "; ".join(one.words() for one in ended)
    if words and "verdict" in result:
        line = Check.read("optimal", result["verdict"]["optimal"])
        state = State.WARNED if line.state is State.FAILED else State.UNKNOWN
        line = replace(line, state=state, findings=(*ended, *line.findings))
        verdict = result["verdict"] = {**result["verdict"], "optimal": line.entry}
        unknown = dict.fromkeys(("inner_optimum", "optimality"))
        checks = result["checks"] = {**result["checks"], **unknown}
        lost = any(one["state"] == State.FAILED.value for one in verdict.values())
        if not (lost or False in checks.values()):
            result |= {"status": "verified", "reason": ""}
    elif words:
        result["reason"] = f"none found so far: {words}; {result['reason']}"
    if words:
        result["notes"] = [*result.get("notes", ()), words]
    return replace(solution, result=result)


def predicted_value(outcome: FormulationResult, x: Array, value: float) -> float:
    """Predict the value of a design x by the last surrogate, SI.

    Without a surrogate it is `value`, that of the design.
    """
    if outcome.surrogates:
        process = outcome.surrogates[0]
        return float(process.predict(x[None, : process.lower.size])[0])
    return value


def infeasible_dict(terms: RunTerms, reason: str, spent: Mapping[str, int]) -> dict[str, Any]:
    """result.json where no certified design meets the constraints."""
    head = {"status": "infeasible", "reason": reason, "formulation": terms.formulation}
    return head | run_entry(terms, spent)


def run_entry(terms: RunTerms, spent: Mapping[str, int], moved: bool = False) -> dict[str, Any]:
    """Write what every result.json has of its run."""
    return {
        "format": FORMAT,
        **spent_entry(spent, moved),
        "seconds": perf_counter() - terms.began,
        "seed": terms.seed,
        "versions": versions(),
    }


def at_solve(result: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """A line of the verdict as the solve wrote it.

    Parameters
    ----------
    result : mapping
        result.json.
    name : str
        Of the line.

    Returns
    -------
    mapping
        Its entry; empty where the file has no such line.
    """
    verdict = result.get("verdict")
    line = verdict.get(name) if isinstance(verdict, Mapping) else None
    if not isinstance(line, Mapping):
        return {}
    before = line.get("at_solve")
    return before if isinstance(before, Mapping) else line


def with_verdict_line(run: "FinishedRun", out: Path, line: Check) -> "FinishedRun":
    """Replace a line of a run's verdict, and write it if `out` is within the run's folder.

    Elsewhere nothing is written: a study that is kept apart leaves the run as it is. `status` stays
    that of the solve.

    Parameters
    ----------
    run : FinishedRun
        The run.
    out : Path
        Where the command writes.
    line : Check
        Of the verdict.

    Returns
    -------
    FinishedRun
        With the line in its result.
    """
    from ccd_casadi.cases.run_folder import read_json

    folder, before = run.folder.resolve(), at_solve(run.result, line.name)
    if not before or not out.resolve().is_relative_to(folder):
        return run
    result = dict(read_json(folder / "result.json"))
    result["verdict"] = {**result["verdict"], line.name: line.entry | {"at_solve": before}}
    write_json(folder / "result.json", result)
    return replace(run, result=result)


def resolve(case: Case, solution: Solution) -> Case:
    """Fix what a case left open at what was found best: design plant, listed values.

    Parameters
    ----------
    case : Case
        As it was solved.
    solution : Solution
        Its result.

    Returns
    -------
    Case
        With nothing left open.
    """
    problem = solution.problem
    if problem is None:
        return case
    held = problem.source.held
    chosen = tuple(p.fixed_at(held[p.name]) for p in case.theta if p.name in held)
    if chosen:
        free = tuple(p for p in case.theta if p.name not in held)
        case = replace(case, theta=free, fixed=(*case.fixed, *chosen))
    if problem.robust is None:
        return case
    return replace(case, robust=replace(case.robust, design_at=problem.robust.design_at))


def write_case(folder: Path, case: Case) -> None:
    """Write case.toml of a run folder, and the plant's own code beside it.

    Parameters
    ----------
    folder, case : Path, Case
    """
    write_whole(folder / "case.toml", case_to_toml(case))  # a kill must not leave half a case
    function = case.plant.function
    own = Path(function.rsplit(":", 1)[0] if isinstance(function, str) else "")
    if own.is_file() and own.parent != folder.resolve():
        write_whole(folder / own.name, own.read_bytes())  # for who gets the folder alone


def write_run(folder: Path, case: Case, solution: Solution) -> None:
    """Write what a run folder holds besides samples and report; clear an earlier run's.

    The case in it names what was found best of what was open: later commands use that.

    Parameters
    ----------
    folder : Path
        Exists.
    case : Case
        As it was solved.
    solution : Solution
        Its result.
    """
    for name in ("result.json", "controller.json", "surrogate.json", "report.html", "index.html"):
        (folder / name).unlink(missing_ok=True)
    write_case(folder, resolve(case, solution))
    formulation = solution.result["formulation"]
    write_json(folder / "truth.json", {"truth": "ccd_casadi", "formulation": formulation})
    if solution.verified is not None:
        write_json(folder / "controller.json", solution.verified.controller_entry())
    if solution.outcome.surrogates:
        save(
            solution.outcome.surrogates,
            folder / "surrogate.json",
            {
                "formulation": formulation,
                "outputs": list(solution.surrogates),
                "units": [unit for _, unit in solution.surrogates.values()],
                "loo": [vars(process.loo) for process in solution.outcome.surrogates],
            },
        )
    write_json(folder / "result.json", solution.result)
