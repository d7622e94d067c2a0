"""What shows itself in a notebook."""

import sys
from importlib import import_module


class Shown:
    """Base of what a notebook shows as more than its `repr`.

    The drawing is `ccd_casadi.reporting.notebook`'s, far above most of these classes: it is loaded
    when something is shown, and not before.
    """

    def _repr_html_(self) -> str:
        text: str = import_module("ccd_casadi.reporting.notebook").html_of(self)
        return text


def in_notebook(stream: object) -> bool:
    """Whether a stream is a notebook's cell: no terminal, but a line in it can be rewritten."""
    return "ipykernel" in sys.modules and type(stream).__module__.startswith("ipykernel.")
