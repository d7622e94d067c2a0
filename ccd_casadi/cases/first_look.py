"""What a case file says of itself before anything that computes is imported."""

import tomllib
from pathlib import Path

SEARCH = "ccd_casadi.inner_problem.structured_search"  # half a second of a worker to import


def module_of_workers(case: Path) -> str | None:
    """What worker processes will need of this package; None where nothing is known to need them.

    A file that is no case is none: whoever reads it whole says what is wrong with it.
    """
    try:
        tables = tomllib.loads(case.read_text(encoding="utf-8"))
        searched = tables["controller"]["structure"] == "sections"
        return SEARCH if searched and tables["plant"].get("model") != "measured" else None
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None
