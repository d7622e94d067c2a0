"""What `surrogates.retrain` opens (entry point "ccd_casadi"): a run that draws its report."""

from functools import partial
from pathlib import Path

from ccd_casadi.cases.sections import Case
from ccd_casadi.codesign import retraining
from ccd_casadi.codesign.solution import Solution
from ccd_casadi.inner_problem.problem import CoDesignProblem


def _write_page(folder: Path, case: Case, problem: CoDesignProblem, solution: Solution) -> None:
    from ccd_casadi.reporting.solve_page import write_report  # matplotlib is slow to import

    write_report(folder, case, problem, solution)


open_run = partial(retraining.open_run, write_page=_write_page)
