"""What a case file says of itself before anything that computes is imported."""

import tomllib
from pathlib import Path

# What worker processes need, a second to import: least squares need SciPy's optimisation.
SEARCH = "ccd_casadi.inner_problem.structured_search", "scipy.optimize", "ccd_casadi.kernels.loaded"
SAMPLING = "ccd_casadi.sampling.units", *SEARCH
DRAWING = "ccd_casadi.drawing.paint", "matplotlib.backends.backend_svg"


def is_searched(case: Path) -> bool:
    """Whether its controller is searched for on worker processes.

    A file that is no case is none: whoever reads it whole says what is wrong with it.
    """
    try:
        tables = tomllib.loads(case.read_text(encoding="utf-8"))
        sections = tables["controller"]["structure"] == "sections"
        return bool(sections and tables["plant"].get("model") != "measured")
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return False
