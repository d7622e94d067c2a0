"""What a case file says of itself before anything that computes is imported."""

import tomllib
from collections.abc import Sequence
from pathlib import Path

# A second to import: with SciPy's optimisation, which least squares need, and the kernels.
SEARCH = "ccd_casadi.inner_problem.structured_search", "scipy.optimize", "ccd_casadi.kernels.loaded"


def modules_of_workers(case: Path) -> Sequence[str]:
    """What worker processes will need; empty where nothing is known to need them.

    A file that is no case is none: whoever reads it whole says what is wrong with it.
    """
    try:
        tables = tomllib.loads(case.read_text(encoding="utf-8"))
        searched = tables["controller"]["structure"] == "sections"
        return SEARCH if searched and tables["plant"].get("model") != "measured" else ()
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return ()
