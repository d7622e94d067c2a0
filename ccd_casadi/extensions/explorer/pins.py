"""The designs that were pinned: a table of them, and their curves beside the present one's."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from bokeh.models import ColumnDataSource
from bokeh.models.widgets.tables import (
    CellEditor,
    DataTable,
    HTMLTemplateFormatter,
    NumberFormatter,
    StringEditor,
    TableColumn,
)

from ccd_casadi.cases.tables import Parameter
from ccd_casadi.drawing.svg import AMBER, BROWN, GREEN, ORANGE, PURPLE
from ccd_casadi.extensions.explorer.curves import EMPTY, Drawn
from ccd_casadi.extensions.explorer.designs import ExploredDesign
from ccd_casadi.extensions.explorer.knobs import Knobs
from ccd_casadi.extensions.explorer.landscape_map import MapFigure
from ccd_casadi.extensions.explorer.painter import ON_DARK, PanelFigure
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.text import display_unit

HEIGHT = 150
COLOURS = (ORANGE, GREEN, PURPLE, AMBER, BROWN)
DARK = """.slick-cell, .slick-header-column { background: #20262b !important; color: #e0e0e0; }
.slick-cell.selected { background: #2f4a5e !important; }"""
# Of a pinned design: field, title, format, width in px, and what it reads.
FIGURES: tuple[tuple[str, str, str, int, Callable[[ExploredDesign], Any]], ...] = (
    ("S_max", "S_max", "0.000", 70, lambda design: design.knobs.S_max),
    ("bandwidth", "ω_b (Hz)", "0.0000", 90, lambda design: design.bandwidth_hz),
    ("peak", "‖S‖∞", "0.0000", 80, lambda design: design.figures.sensitivity_peak),
    ("cost", "hardware cost", "0.0000", 130, lambda design: design.cost),
    ("objective", "J", "0.0000", 110, lambda design: design.objective),
    ("standing", "standing", "", 260, lambda design: design.standing.value),
)
LINE = '<span style="color:<%= value %>">▬▬</span>'


@dataclass
class Kept:
    """What outlives a reload of a tab: where its sliders stand, and its pins by name."""

    knobs: Knobs | None = None
    pinned: list[tuple[str, Drawn]] = field(default_factory=list)
    count: int = 0


class Pins:
    """Pinned designs, in the order in which they were pinned; a name may be changed in its cell."""

    def __init__(
        self, parameters: Sequence[Parameter], figures: Sequence[PanelFigure], land: MapFigure,
        kept: Kept, dark: bool, cost_unit: str,
    ) -> None:  # fmt: skip
        self.names = [p.name for p in parameters]
        self.figures, self.land, self.kept, self._dark = figures, land, kept, dark
        units = [display_unit(p.unit, p.upper) for p in parameters]
        self._scales = [scale for _, scale in units]
        self.source = ColumnDataSource(self._columns([]))
        self.source.on_change("data", lambda attr, old, new: self._renamed(new["design"]))
        thetas = [
            (f"theta_{name}", f"{name} ({unit})" if unit else name, "0.0000", 90)
            for name, (unit, _) in zip(self.names, units, strict=True)
        ]
        cost = f" ({cost_unit})" if cost_unit else ""
        heads = [("colour", "", LINE, 40), ("design", "design", "", 90), *thetas]
        heads += [(name, title + cost * (name == "cost"), form, width)
                  for name, title, form, width, _ in FIGURES]  # fmt: skip
        self.table = DataTable(
            name="pins", source=self.source, height=HEIGHT, index_position=None, editable=True,
            sizing_mode="stretch_width", autosize_mode="none", reorderable=False,
            columns=[_column(*head) for head in heads], stylesheets=[DARK] if dark else [],
        )  # fmt: skip
        self._show()

    @property
    def pinned(self) -> list[tuple[str, Drawn]]:
        """Name and design of each."""
        return self.kept.pinned

    def add(self, drawn: Drawn) -> None:
        """Pin one."""
        self.kept.count += 1
        self.pinned.append((f"pin {self.kept.count}", drawn))
        self._show()

    def drop(self) -> None:
        """Take the selected ones away, the last one where none is selected."""
        chosen = set(self._chosen()) or {len(self.pinned) - 1}
        self.pinned[:] = [pin for i, pin in enumerate(self.pinned) if i not in chosen]
        self._show()

    def selected(self) -> Drawn | None:
        """The first of those selected, the last one where none is; None without a pin."""
        chosen = self._chosen() or ([len(self.pinned) - 1] if self.pinned else [])
        return self.pinned[chosen[0]][1] if chosen else None

    def _chosen(self) -> list[int]:
        return [i for i in self.source.selected.indices if i < len(self.pinned)]

    def _renamed(self, names: Sequence[str]) -> None:
        if len(names) == len(self.pinned):
            pairs = zip(names, self.pinned, strict=True)
            self.pinned[:] = [(str(name), drawn) for name, (_, drawn) in pairs]
            self._on_map()

    def _columns(self, colours: Sequence[str]) -> dict[str, list[Any]]:
        """The table, a list a column; θ in the units of the sliders."""
        drawn_designs = [drawn.design for _, drawn in self.pinned[: len(colours)]]
        found: dict[str, list[Any]] = {
            "colour": [*colours], "design": [name for name, _ in self.pinned[: len(colours)]]
        }  # fmt: skip
        for i, (name, scale) in enumerate(zip(self.names, self._scales, strict=True)):
            found[f"theta_{name}"] = [scale * design.theta[i] for design in drawn_designs]
        return found | {
            name: json_values([read(design) for design in drawn_designs])
            for name, *_, read in FIGURES
        }

    def _on_map(self) -> None:
        """Whoever looks at the table finds each there by colour and name."""
        rows = enumerate(self.pinned)
        self.land.pin([(COLOURS[i % len(COLOURS)], name, drawn.design.theta)
                       for i, (name, drawn) in rows])  # fmt: skip

    def _show(self) -> None:
        self._on_map()
        self.source.selected.indices = []
        colours = [COLOURS[i % len(COLOURS)] for i in range(len(self.pinned))]
        shown = [ON_DARK[colour] if self._dark else colour for colour in colours]
        self.source.data = self._columns(shown)
        pinned = list(zip(colours, (drawn.panels for _, drawn in self.pinned), strict=True))
        for made in self.figures:
            made.pin([(colour, panels.get(made.name, EMPTY)) for colour, panels in pinned])


def _column(name: str, title: str, form: str, width: int) -> TableColumn:
    design: dict[str, Any] = {"editor": StringEditor() if name == "design" else CellEditor()}
    if form:
        made = HTMLTemplateFormatter(template=form) if "<" in form else NumberFormatter(format=form)
        design["formatter"] = made
    return TableColumn(field=name, title=title, width=width, **design)
