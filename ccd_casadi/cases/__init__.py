"""Case files, what is wrong with them, and finished run folders.

The names here are read by commands before anything that computes is imported.
"""

import tomllib
from pathlib import Path

# What worker processes need, most of a second to import.
SEARCH = "ccd_casadi.inner_problem.structured_search", "ccd_casadi.kernels.loaded"
SAMPLING = *SEARCH, "ccd_casadi.sampling.unit_kinds", "scipy.optimize"
DRAWING = "ccd_casadi.drawing.paint", "matplotlib.backends.backend_svg"


def is_searched(case: Path) -> bool:
    """Report whether the controller of a case is searched for on worker processes.

    Parameters
    ----------
    case : Path
        A file that is not a case gives False: its error is reported later.

    Returns
    -------
    bool
    """
    try:
        tables = tomllib.loads(case.read_text(encoding="utf-8"))
        sections = tables["controller"]["structure"] == "sections"
        return bool(sections and tables["plant"].get("model") != "measured")
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return False
