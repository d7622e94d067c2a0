"""The numbers behind curves: some of their points, in a table that a person still reads."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.drawing.content import Table
from ccd_casadi.support.arrays import Array

ROWS = 40


def over_time(head: Sequence[str], *columns: Array) -> Table:
    """Points of equal distance along the columns, the first and the last among them."""
    rows = np.unique(np.linspace(0, len(columns[0]) - 1, ROWS).astype(int))
    return Table.of(head, *(column[rows] for column in columns))


def over_frequency(head: Sequence[str], *columns: Array, special: Sequence[float] = ()) -> Table:
    """Points evenly spread over the first column's decades, with those nearest to `special`."""
    rows = spread(columns[0], special)
    return Table.of(head, *(column[rows] for column in columns))


def spread(hz: Array, special: Sequence[float] = ()) -> list[int]:
    """The places of frequencies that are evenly spread over the decades, and of special ones."""
    wanted = [*np.geomspace(hz[0], hz[-1], ROWS), *special]
    return sorted({int(np.abs(hz - value).argmin()) for value in wanted})
