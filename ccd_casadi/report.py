"""`python -m ccd_casadi.report RUN_DIR [RUN_B] [--brief]`: the pages of a folder drawn again, one
page for a decision, or what changed from one run to another.

Nothing is designed: what the pages show is in report.json. A run that kept none gets a report of
its design, as far as case.toml, controller.json and result.json hold it.
"""

import argparse
from pathlib import Path

from ccd_casadi.support.command_line import RUN, ExitCode, command, option
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.terminal import inform


@command(
    "ccd_casadi.report", "Draw the pages of a finished folder again; nothing is designed.",
    option("other", metavar="RUN_B", nargs="?", type=Path,
           help="another finished run: writes changes.html into it, what changed from RUN_DIR"),
    option("--brief", action="store_true",
           help="write brief.html alone, one A4 page for a decision; a PDF too where a Chromium or "
                "Chrome is on the PATH"),
    needs=["ccd_casadi.drawing.paint"], place=RUN,
    without_effect=["--out", "--workers", "--seed"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Draw every page of the folder, and of those of deployments and the like below it."""
    from ccd_casadi.cases.run_folder import read_run
    from ccd_casadi.drawing.paint import NAME, draw, read_pages
    from ccd_casadi.reporting.run_verdict import publish, write_index
    from ccd_casadi.reporting.solve_page import page_of_run

    folder = options.run
    if not folder.is_dir():
        raise UserError(f"{folder}: is not a folder; name the run folder of a finished solve")
    if options.other is not None:
        from ccd_casadi.reporting.run_changes import figure_rows, write_changes

        if options.brief:
            raise UserError("--brief: is of one run; give RUN_DIR alone")
        runs = read_run(folder), read_run(options.other)
        for name, *values in figure_rows(*runs):
            inform(f"{name:26s}{values[0]:>18s}{values[1]:>18s}{values[2]:>12s}".rstrip())
        path = write_changes(*runs)
        write_index(options.other)
        inform(f"written       {path}")
        return ExitCode.DONE
    if options.brief:
        from ccd_casadi.reporting.brief import write_brief

        written = write_brief(read_run(folder))
        write_index(folder)
        inform("\n".join(f"written       {path}" for path in written))
        if len(written) == 1:
            inform("no PDF        no Chromium or Chrome is on the PATH; print brief.html")
        return ExitCode.DONE
    below = (path.parent for path in sorted(folder.glob(f"*/{NAME}")))
    drawn = []
    for place in (folder, *(own for own in below if not (own / "result.json").exists())):
        for name, page in read_pages(place).items():
            draw(place / name, page)
            drawn.append(place / name)
    report = folder / "report.html"
    if not (report.exists() or (folder / "compare.json").exists()):
        publish(folder, report, page_of_run(read_run(folder)))
        drawn.append(report)
    write_index(folder)
    inform("\n".join(f"drawn         {path}" for path in drawn))
    return ExitCode.DONE


if __name__ == "__main__":
    raise SystemExit(main())
