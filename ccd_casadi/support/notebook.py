"""What shows itself in a notebook."""

import sys
from collections.abc import Callable
from typing import ClassVar


class NotebookHtml:
    """Base of what a notebook shows as more than its `repr`.

    How is far above most of these classes: the package sets `drawn` (an object to HTML).
    """

    drawn: ClassVar[Callable[[object], str] | None] = None

    def _repr_html_(self) -> str | None:
        return None if NotebookHtml.drawn is None else NotebookHtml.drawn(self)


def in_notebook(stream: object) -> bool:
    """Whether a stream is a notebook's cell: no terminal, but a line in it can be rewritten."""
    return "ipykernel" in sys.modules and type(stream).__module__.startswith("ipykernel.")
