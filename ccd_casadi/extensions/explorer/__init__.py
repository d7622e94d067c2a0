"""The explorer: what its sliders say, the certified designs there, their curves, and the page.

Everything but `page` and `server` is free of any server library.

`python -m ccd_casadi.explore CASE.toml|RUN_DIR`: drag a design and see its certified loop.

Serves one page on the loopback address until Ctrl-C.
"""

import argparse
from pathlib import Path

from ccd_casadi.support.command_line import RUN, ExitCode, command, option, run_folder
from ccd_casadi.support.extensions import Extension

ASSETS = "extensions/explorer/assets"
EXTENSION = Extension(
    commands={
        "explore": (
            "ccd_casadi.extensions.explorer",
            "drag the hardware and see the certified loop move",
        )
    }
)


@command(
    "ccd_casadi.explore", "Drag a design and see its certified loop, in the browser.",
    option("--no-open", action="store_true", help="only print the address, open no browser"),
    needs=["ccd_casadi.codesign.result"],
    place={**RUN, "metavar": "CASE.toml|RUN_DIR",
           "help": "a case file, or the folder of a finished solve"},
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Run the command."""
    from ccd_casadi.support.errors import require

    require("bokeh", "explore")
    from ccd_casadi.cases.case import load_case
    from ccd_casadi.cases.run_folder import read_run
    from ccd_casadi.extensions.explorer.server import Explorer
    from ccd_casadi.extensions.explorer.session import Session

    place: Path = options.run
    finished = read_run(place) if place.is_dir() else None
    case = load_case(place) if finished is None else finished.case
    beside = place.with_name(f"{place.stem}_explored.toml")
    folder = run_folder(beside, place if finished is not None and not options.out else options.out)
    session = Session(case, folder, finished)
    explorer = Explorer(
        session, workers=options.workers, seed=options.seed, user_code=not options.no_user_code
    )
    if options.quiet:
        print(explorer.url, flush=True)
    else:
        print(f"explorer      {explorer.url}", flush=True)
        print(f"folder        {folder} (samples.sqlite, saved cases); Ctrl-C ends it", flush=True)
    try:
        explorer.run(show=not options.no_open)
    except KeyboardInterrupt:
        print()
    finally:
        explorer.close()
    return ExitCode.DONE
