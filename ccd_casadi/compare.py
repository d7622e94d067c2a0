"""`python -m ccd_casadi.compare CASE.toml`: every method side by side on one case."""

import argparse
from typing import TYPE_CHECKING

from ccd_casadi.support.command_line import SCHEDULER, ExitCode, command, run_folder
from ccd_casadi.support.process_pool import PoolOptions, pool
from ccd_casadi.support.terminal import inform, say

if TYPE_CHECKING:  # what computes is imported once the options are known to be right
    from ccd_casadi.studies.comparison import Comparison


def table(comparison: "Comparison") -> str:
    """The methods in columns that a terminal of 80 characters holds, then how they ended."""
    from ccd_casadi.reporting.run_verdict import head_words

    lines = [f"{'method':24}{'J':>11}{'Hz':>9}{'cost':>9}{'syntheses':>10}{'check':>7}{'s':>8}"]
    ends: dict[str, list[str]] = {}
    for method in comparison.methods:
        f = method.figures
        words = f"{f['status']} ({head_words(f)})" if f.get("verdict") else f["status"]
        if f.get("objective") is None:
            words = f"{words}: {f.get('reason', '')}"
        else:
            lines.append(
                f"{method.name:24}{f['objective']:11.4f}{f['bandwidth_hz']:9.3f}"
                f"{f['hardware_cost']:9.4g}{f['syntheses_to_optimum']:10d}"
                f"{f['syntheses'] - f['syntheses_to_optimum']:7d}{f['seconds']:8.1f}"
            )
        ends.setdefault(words, []).append(method.name)
    return "\n".join([*lines, *(f"{', '.join(names)}: {words}" for words, names in ends.items())])


@command(
    "ccd_casadi.compare", "Run every method on one case, side by side.", SCHEDULER,
    needs=["ccd_casadi.studies.comparison"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Run the command."""
    from ccd_casadi.cases.case import case_to_toml
    from ccd_casadi.studies.compare_page import comparison_dict
    from ccd_casadi.studies.comparison import compare
    from ccd_casadi.studies.steepest_descent import case_to_compare
    from ccd_casadi.support.json_files import write_json

    case, problem = case_to_compare(options.case, "compare")
    out = options.out or options.case.with_name(options.case.stem + "_compare")
    folder = run_folder(options.case, out)
    with pool(options.scheduler, options.workers, PoolOptions.patience) as workers:
        comparison = compare(case, problem, folder, workers, seed=options.seed, quiet=options.quiet)
    (folder / "case.toml").write_text(case_to_toml(case))
    answer = comparison_dict(comparison, options.seed)
    write_json(folder / "compare.json", answer)
    if not options.quiet:
        say(table(comparison))
        say("\n".join(answer["conclusions"]["sentences"]))
    from ccd_casadi.drawing.paint import write_page  # matplotlib is slow to import
    from ccd_casadi.studies.compare_page import comparison_page

    write_page(folder / "report.html", comparison_page(folder, comparison, answer))
    inform(f"page          {folder / 'report.html'}")
    statuses = {method.figures["status"] for method in comparison.methods if method.solution}
    if statuses == {"infeasible"}:
        return ExitCode.INFEASIBLE
    return ExitCode.DONE if statuses == {"verified"} else ExitCode.NOT_VERIFIED


if __name__ == "__main__":
    raise SystemExit(main())
