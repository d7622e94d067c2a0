"""The designs that were pinned: a table of them, and their curves beside the present one's."""

from collections.abc import Sequence
from typing import Any

from bokeh.models import ColumnDataSource
from bokeh.models.widgets.tables import DataTable, NumberFormatter, TableColumn

from ccd_casadi.cases.sections import Parameter
from ccd_casadi.explorer.figures import Drawn, Figures
from ccd_casadi.explorer.words import pin_columns
from ccd_casadi.support.units import shown_unit

HEIGHT = 150


class Pins:
    """Pinned designs by name, in the order in which they were pinned."""

    def __init__(self, parameters: Sequence[Parameter], figures: Figures) -> None:
        self.names, self.figures = [p.name for p in parameters], figures
        units = [shown_unit(p.unit, p.upper) for p in parameters]
        self._scales = [scale for _, scale in units]
        self.pinned: list[tuple[str, Drawn]] = []
        self.count = 0
        self.source = ColumnDataSource(pin_columns(self.names, self._scales, []))
        thetas = [
            (f"theta_{name}", f"{name} ({unit})" if unit else name, "0.0000")
            for name, (unit, _) in zip(self.names, units, strict=True)
        ]
        heads = [("design", "design", ""), *thetas,
                 ("S_max", "S_max", "0.000"), ("bandwidth", "ω_b (Hz)", "0.0000"),
                 ("peak", "‖S‖∞", "0.0000"), ("cost", "hardware cost", "0.0000"),
                 ("objective", "J", "0.0000"), ("standing", "standing", "")]  # fmt: skip
        self.table = DataTable(
            name="pins", source=self.source, height=HEIGHT, index_position=None,
            sizing_mode="stretch_width", reorderable=False,
            columns=[_column(field, title, form) for field, title, form in heads],
        )  # fmt: skip

    def add(self, drawn: Drawn) -> None:
        """Pin one."""
        self.count += 1
        self.pinned.append((f"pin {self.count}", drawn))
        self._show()

    def drop(self) -> None:
        """Take the selected ones away, the last one where none is selected."""
        chosen = set(self._chosen()) or {len(self.pinned) - 1}
        self.pinned = [pin for i, pin in enumerate(self.pinned) if i not in chosen]
        self._show()

    def selected(self) -> Drawn | None:
        """The first of those selected."""
        chosen = self._chosen()
        return self.pinned[chosen[0]][1] if chosen else None

    def _chosen(self) -> list[int]:
        return [i for i in self.source.selected.indices if i < len(self.pinned)]

    def _show(self) -> None:
        self.source.selected.indices = []
        looks = [(name, drawn.look) for name, drawn in self.pinned]
        self.source.data = pin_columns(self.names, self._scales, looks)
        self.figures.pin(self.pinned)


def _column(field: str, title: str, form: str) -> Any:
    if not form:
        return TableColumn(field=field, title=title)
    return TableColumn(field=field, title=title, formatter=NumberFormatter(format=form))
