"""Control co-design of precision motion stages: a machine and its H∞ controller, certified.

>>> import ccd_casadi as ccd
>>> problem = ccd.problem_of(ccd.load_case(ccd.TWO_MASS))
>>> round(ccd.true_inner(problem, (60.0, 60.0)).bandwidth / ccd.HZ, 1)
58.1

Names are imported when they are first used: this module alone loads neither numba nor CasADi.
"""

import sys as _sys

from ccd_casadi.support import errors as _errors
from ccd_casadi.support.terminal import NotebookHtml
from surrogates.lazy_names import from_stub as _from_stub

if _sys.argv[:1] == ["-m"]:  # a command is starting, not a library
    _errors.exit_on_ctrl_c()

del _errors

__all__ = [*_from_stub(__name__), "__version__"]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib import metadata  # slow to import

        return metadata.version("ccd-casadi")
    raise AttributeError(name)  # then it may be one of the stub


def _html_of(item: object) -> str:
    from ccd_casadi.reporting.notebook import html_of

    return html_of(item)


NotebookHtml.drawn = _html_of  # loaded when something is shown, and not before
