"""Lines of a run's verdict that commands after the solve find: written back into result.json.

A line keeps what the solve itself said of it (`at_solve`), so that a command may be given again.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ccd_casadi.cases.run_folder import FinishedRun, read_json
from ccd_casadi.codesign.verdict import Line
from ccd_casadi.support.json_files import write_json


def at_solve(result: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """A line as the solve wrote it; empty where a run is older than verdicts."""
    verdict = result.get("verdict")
    line = verdict.get(name) if isinstance(verdict, Mapping) else None
    if not isinstance(line, Mapping):
        return {}
    before = line.get("at_solve")
    return before if isinstance(before, Mapping) else line


def told(run: FinishedRun, out: Path, name: str, line: Line) -> FinishedRun:
    """The run with a line of its verdict, written into its folder if `out` lies in that.

    Elsewhere nothing is written: a study that is kept apart leaves the run as it is. `status` stays
    that of the solve.
    """
    folder, before = run.folder.resolve(), at_solve(run.result, name)
    if not before or not out.resolve().is_relative_to(folder):
        return run
    result = dict(read_json(folder / "result.json"))
    found = {"state": line.state.value, "words": line.words, **line.figures, "at_solve": before}
    result["verdict"] = {**result["verdict"], name: found}
    write_json(folder / "result.json", result)
    return replace(run, result=result)
