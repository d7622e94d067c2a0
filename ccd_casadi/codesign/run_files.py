"""What a solve writes into its run folder."""

from dataclasses import replace
from pathlib import Path

from ccd_casadi.cases.tables import Case
from ccd_casadi.cases.toml_writer import case_to_toml
from ccd_casadi.codesign.lifted import OUTPUTS
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.support.json_files import write_json
from surrogates import save
from surrogates.files import write_whole


def resolved(case: Case, solution: Solution) -> Case:
    """The case with what was found best of what it left open: design plant, listed values."""
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


def write_run(folder: Path, case: Case, solution: Solution) -> None:
    """Write what a run folder holds besides samples and report; clear an earlier run's.

    The case in it names what was found best of what was open, so that what works on the run does.
    """
    for name in ("result.json", "controller.json", "surrogate.json", "report.html", "index.html"):
        (folder / name).unlink(missing_ok=True)
    text = case_to_toml(resolved(case, solution))
    write_whole(folder / "case.toml", text)  # a kill must not leave half a case to resume from
    own = Path((case.plant.function or "").rsplit(":", 1)[0])
    if own.is_file() and own.parent != folder.resolve():
        write_whole(folder / own.name, own.read_bytes())  # for who gets the folder alone
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
                "outputs": list(OUTPUTS[: len(solution.outcome.surrogates)]),
                "loo": [vars(process.loo) for process in solution.outcome.surrogates],
            },
        )
    write_json(folder / "result.json", solution.result)
