"""The numbers behind a drawing: its curves at some of their points, in tables for a person."""

from collections.abc import Iterator

import numpy as np

from ccd_casadi.drawing.content import Drawing, Landscape, Lines, Panel, Table
from ccd_casadi.drawing.svg import axis_label
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import number

ROWS = 40  # of a table, besides marked places
STEP = 4  # of a landscape's grid
FREQUENCY = "frequency (Hz)"
Column = tuple[str, str, Array, Array, bool]  # its axis, its name, x, y, whether a line joins them


def tables_of(drawing: Drawing) -> tuple[Table, ...]:
    """One for each axis, whose panels share it, with a column for each curve; of dots by themselves
    all. Of a landscape its grid, thinned, and the true samples; nothing of a picture."""
    if isinstance(drawing, Landscape):
        return _of_landscape(drawing)
    rows = drawing.rows if isinstance(drawing, Lines) else ()
    panels = [panel for row in rows for panel in row if isinstance(panel, Panel)]
    groups: dict[tuple[str, bytes], dict[str, tuple[Array, Array]]] = {}
    for axis, name, x, y, joined in (column for panel in panels for column in _columns(panel)):
        group = groups.setdefault((axis, b"" if joined else x.tobytes()), {})
        group.setdefault(name, (x, y))  # one of each name
    return tuple(
        Table.of((axis, *found), *_rows(axis, found, panels, bool(dots)))
        for (axis, dots), found in groups.items()
    )


def _columns(panel: Panel) -> Iterator[Column]:
    """What a panel shows, of loci over frequency both parts."""
    named = any(curve.label for curve in panel.curves if curve.hz is not None)
    for curve in panel.curves:
        same = panel.y_label.startswith(curve.label)
        name = panel.y_label if same else f"{panel.y_label}, {curve.label}"
        if curve.hz is not None and not curve.label and named:
            continue  # no reader knows which of the others it is
        if curve.hz is not None:
            real = name.replace(panel.y_label, panel.x_label)
            yield from ((FREQUENCY, real, curve.hz, curve.x, True),
                        (FREQUENCY, name, curve.hz, curve.y, True))  # fmt: skip
        elif curve.readable or not curve.line:
            yield panel.x_label, name, curve.x, curve.y, bool(curve.line)
    for band in panel.bands:
        if band.label:
            for word, y in (("least", band.low), ("largest", band.high)):
                yield panel.x_label, f"{panel.y_label}, {band.label}: {word}", band.x, y, True


def _rows(
    axis: str, found: dict[str, tuple[Array, Array]], panels: list[Panel], every: bool
) -> Iterator[Array]:
    """Points spread along the axis, those next to marked places, and where a curve is largest; of
    curves over another grid what lies between their points. `every`: all."""
    x = max((over for over, _ in found.values()), key=len)
    own = [panel for panel in panels if panel.x_label == axis]
    rows = list(range(len(x)))
    if not every:
        marked = [m.x for p in own for m in p.marks]
        marked += [level.value for p in own for level in p.levels if level.vertical]
        marked += [float(at[np.nan_to_num(y, nan=-np.inf).argmax()]) for at, y in found.values()]
        even = x[np.linspace(0, len(x) - 1, ROWS).astype(int)]
        even = np.geomspace(x[0], x[-1], ROWS) if any(p.log_x for p in own) else even
        rows = sorted({int(np.abs(x - value).argmin()) for value in (*marked, *even)})
    yield x[rows]
    for over, y in found.values():
        same = len(over) == len(x) and np.allclose(over, x, rtol=1e-9)
        yield y[rows] if same else np.interp(x[rows], over, y, left=np.nan, right=np.nan)


def _of_landscape(land: Landscape) -> tuple[Table, ...]:
    tables = []
    first, second = land.names
    if land.bandwidth_hz.size:
        thinned = slice(0, None, STEP)
        heads = (number(float(value)) for value in land.second[thinned])
        values = land.bandwidth_hz[thinned, thinned].T
        head = (f"ω_b* in Hz; {first} ↓ {second} →", *heads)
        tables.append(Table.of(head, land.first[thinned], *values))
    head = (axis_label(first, land.units[0]), axis_label(second, land.units[1]), "true ω_b* (Hz)")
    return (*tables, Table.of(head, *land.truths.T))
