"""One browser page: sliders, figures and buttons over a session; an answer to every drag."""

from time import perf_counter
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.models import (
    Button,
    ColumnDataSource,
    DataTable,
    Div,
    LinearColorMapper,
    NumberFormatter,
    Select,
    TableColumn,
)
from bokeh.plotting import figure

from ccd_casadi.explorer.background import Background, Solve
from ccd_casadi.explorer.controls import Controls
from ccd_casadi.explorer.curves import as_sampled, curves_of
from ccd_casadi.explorer.designs import How, Look, Standing
from ccd_casadi.explorer.figures import Drawn, Figures
from ccd_casadi.explorer.knobs import Knobs
from ccd_casadi.explorer.landscape import Field, field_of, run_surrogate
from ccd_casadi.explorer.machine import machine_html
from ccd_casadi.explorer.modes import frequency_error, in_modal_form
from ccd_casadi.explorer.session import Session, searched_exactly
from ccd_casadi.explorer.words import pin_columns, standing_html
from ccd_casadi.reporting.page import escape
from ccd_casadi.support.errors import UserError

TOGETHER = 4  # ms: drags that come within it are answered at once
LINES = 12  # of a solve's output


class Page:
    """The widgets of one document, and what happens when one is moved."""

    def __init__(
        self, document: Document, session: Session, background: Background, workers: int, dark: bool
    ) -> None:
        self.document, self.session, self.background = document, session, background
        self.workers = workers
        self.figures = Figures(dark)
        self.controls = Controls(session.case, session.start, self.moved)
        self._scheduled = self._let_go = False
        self._seen: list[Look] = []  # to be written into the store
        self._pending: tuple[Knobs, str] | None = None  # an exact search under way
        self.now: Drawn | None = None
        self.pins: list[tuple[str, Drawn]] = []
        self.solve: Solve | None = None
        self._output: list[str] = []
        # what was answered last: the browser's clock stops when it has drawn this
        self.answer = ColumnDataSource({"serial": [0], "theta": [[]], "S_max": [0.0], "full": [False]},
                                       name="answer")  # fmt: skip
        self.verdict, self.machine, self.modes = Div(name="verdict"), Div(), Div()
        self.output = Div(text="", name="output")
        self.note = Div(text="", name="note")
        self._buttons()
        self._map()
        self._table()
        self._roots()
        self.moved(True)

    def _buttons(self) -> None:
        self.pin_button = Button(label="Pin this design", name="pin", button_type="primary")
        self.unpin = Button(label="Unpin selected", name="unpin")
        self.go = Button(label="Go to selected", name="go")
        self.save = Button(label="Save as case", name="save")
        self.solve_button = Button(label="Solve from here", name="solve")
        self.stop = Button(label="Stop the solve", name="stop", disabled=True)
        for button, action in (
            (self.pin_button, self.pin), (self.unpin, self.drop), (self.go, self.return_to),
            (self.save, self.write_case), (self.solve_button, self.start_solve),
            (self.stop, self.stop_solve),
        ):  # fmt: skip
            button.on_click(action)

    def _map(self) -> None:
        names = list(self.session.problems.at(self.session.start).names)
        self.axes = [
            Select(name=f"axis_{i}", title=("across", "up")[i], options=names, value=names[min(i, len(names) - 1)], width=120)
            for i in range(2)
        ]  # fmt: skip
        for axis in self.axes:
            axis.on_change("value", lambda attr, old, new: self.draw_map())
        colours = LinearColorMapper("Viridis256", nan_color="#80808050")
        self.colours = colours
        self.image = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        self.dots = ColumnDataSource({"x": [], "y": [], "hz": []})
        self.here = ColumnDataSource({"x": [], "y": []})
        self.map = figure(name="landscape", height=280, sizing_mode="stretch_width", tools="pan,wheel_zoom,reset,hover",
                          tooltips=[("ω_b (Hz)", "@hz{0.00}")], toolbar_location="above")  # fmt: skip
        self.map.toolbar.logo = None
        self.map.image("image", "x", "y", "dw", "dh", source=self.image, color_mapper=colours)
        self.map.scatter("x", "y", source=self.dots, size=6, fill_color={"field": "hz", "transform": colours}, line_color="#888888")  # fmt: skip
        self.map.scatter("x", "y", source=self.here, marker="star", size=18, fill_color="#D55E00", line_color="white")  # fmt: skip
        self.map_words = Div()
        self._field: Field | None = None
        run = self.session.run
        self.processes = () if run is None else run_surrogate(run.folder)

    def _table(self) -> None:
        names = self.session.problems.at(self.session.start).names
        self.pinned = ColumnDataSource(pin_columns(names, []))
        heads = [("design", "design", None), *((f"theta_{n}", n, "0.0000") for n in names),
                 ("S_max", "S_max", "0.000"), ("bandwidth", "ω_b (Hz)", "0.0000"),
                 ("peak", "‖S‖∞", "0.0000"), ("cost", "hardware cost", "0.0000"),
                 ("objective", "J", "0.0000"), ("standing", "standing", None)]  # fmt: skip
        columns = []
        for field, title, form in heads:
            extra = {} if form is None else {"formatter": NumberFormatter(format=form)}
            columns.append(TableColumn(field=field, title=title, **extra))
        self.table = DataTable(source=self.pinned, columns=columns, height=150, index_position=None,
                               sizing_mode="stretch_width", reorderable=False, name="pins")  # fmt: skip

    def _roots(self) -> None:
        from bokeh.layouts import column, row

        fill = {"sizing_mode": "stretch_width"}
        figures = self.figures.all()
        buttons = row(self.pin_button, self.go, self.unpin, self.save, self.solve_button, self.stop,
                      css_classes=["wrap"], **fill)  # fmt: skip
        roots = {
            "controls": column(*self.controls.all(), **fill),
            "verdict_place": column(self.verdict, self.note, **fill),
            "machine": column(self.machine, self.modes, **fill),
            "pins_place": column(buttons, self.table, self.output, **fill),
            "map_place": column(row(*self.axes), self.map, self.map_words, **fill),
        } | {f"{name}_place": column(made, **fill) for name, made in figures.items()}
        for name, root in roots.items():
            root.name = name
            for part in [root, *getattr(root, "children", [])]:
                if getattr(part, "sizing_mode", "") is None:
                    part.sizing_mode = "stretch_width"
            self.document.add_root(root)
        self.answer_holder = self.table  # reachable from a root, so that it is sent
        self.table.tags = [self.answer]

    # drags

    def moved(self, let_go: bool) -> None:
        """A slider moved: answer soon, once for all that moved meanwhile."""
        self._let_go = self._let_go or let_go
        if not self._scheduled:
            self._scheduled = True
            self.document.add_timeout_callback(self._answer, TOGETHER)

    def _answer(self) -> None:
        self._scheduled, let_go, self._let_go = False, self._let_go, False
        knobs = self.controls.knobs()
        full = let_go or bool(self.controls.always.active)
        try:
            if full and self.session.known is not None:
                self._search_behind(knobs)
                full = False
            look = self.session.full(knobs) if full else self.session.live(knobs)
        except UserError as error:
            self.note.text = f'<p class="refused">{escape(str(error))}</p>'
            return
        self.note.text = ""
        self.show(look, full)
        if full:
            self.settle()

    def show(self, look: Look, full: bool) -> None:
        """Draw a design, and say that this is the answer."""
        sampled = None
        if (
            look.knobs.sampled
            and look.controller is not None
            and look.standing is not Standing.REFUSED
        ):
            sampled = as_sampled(
                look.plant, look.controller, look.knobs.rate_hz, look.knobs.delay_us
            )
        self.now = Drawn(look, curves_of(look), sampled)
        self.figures.show(self.now)
        if full:
            self.figures.frame(self.now)
        session = self.session
        self.verdict.text = standing_html(look, sampled)
        self.machine.text = machine_html(
            look.problem,
            look.theta,
            session.start.theta,
            look.elements.system,
            look.modal,
            session.reference,
        )
        i, j = self._axes()
        self.here.data = {"x": [look.theta[i]], "y": [look.theta[j]]}
        self._seen.append(look)
        serial = self.answer.data["serial"][0] + 1
        self.answer.data = {"serial": [serial], "theta": [list(look.theta)],
                            "S_max": [look.knobs.S_max], "full": [look.how is How.SEARCHED]}  # fmt: skip

    def settle(self) -> None:
        """After a full search: write what was looked at, draw the landscape."""
        self.document.add_next_tick_callback(self._settled)

    def _settled(self) -> None:
        seen, self._seen = self._seen, []
        self.session.keep(seen)
        self.draw_map()

    def _search_behind(self, knobs: Knobs) -> None:
        """The exact elements and the full search in the background, of the newest place only."""
        waiting, self._pending = self._pending is not None, (knobs, "")
        if waiting:
            return
        self.note.text = "<p>solving the model and searching at this θ …</p>"
        task = (self.session.problems.at(knobs), knobs)
        self.background.ask(
            searched_exactly, task, self._then(self._searched), self._then(self._failed)
        )

    def _then(self, action: Any) -> Any:
        return lambda found: self.document.add_next_tick_callback(lambda: action(found))

    def _searched(self, found: tuple[Look, str]) -> None:
        look, modes = found
        assert self._pending is not None
        newest, self._pending = self._pending[0], None
        known = self.session.known
        assert known is not None
        words = ""
        if known.surrogate is not None and in_modal_form(look.elements.system):
            off = frequency_error(known.surrogate.at(look.theta), look.elements.system)
            words = (
                f"<p>the surrogate's frequencies are off by {100.0 * off:.2g} % at most here</p>"
            )
        self.session.took(look)
        self.note.text = words
        self.modes.text = modes
        if newest == look.knobs:
            self.show(look, True)
        else:
            self._seen.append(look)
            self._search_behind(newest)
        self.settle()

    def _failed(self, error: BaseException) -> None:
        self._pending = None
        self.note.text = f'<p class="refused">{escape(str(error))}</p>'

    # landscape

    def _axes(self) -> tuple[int, int]:
        i, j = (axis.options.index(axis.value) for axis in self.axes)
        return i, j

    def draw_map(self) -> None:
        """The landscape at the present settings."""
        if self.now is None:
            return
        run = self.session.run
        found = field_of(self.now.look.problem, None if run is None else run.problem, self.processes,
                         self.session.store.path, self._axes())  # fmt: skip
        whole = np.concatenate([found.field.ravel(), found.samples[:, 2]])
        whole = whole[np.isfinite(whole)]
        if whole.size:
            self.colours.low, self.colours.high = float(whole.min()), float(whole.max()) + 1e-9
        (x0, x1), (y0, y1) = found.x, found.y
        self.image.data = {"image": [found.field], "x": [x0], "y": [y0], "dw": [x1 - x0], "dh": [y1 - y0]} if found.field.size else {k: [] for k in self.image.data}  # fmt: skip
        self.dots.data = dict(zip(("x", "y", "hz"), found.samples.T, strict=True))
        for axis, (low, high), select in (
            (self.map.x_range, found.x, self.axes[0]),
            (self.map.y_range, found.y, self.axes[1]),
        ):
            axis.start, axis.end = low - 0.03 * (high - low), high + 0.03 * (high - low)
        self.map.xaxis.axis_label, self.map.yaxis.axis_label = (
            self.axes[0].value,
            self.axes[1].value,
        )
        i, j = self._axes()
        theta = self.now.look.theta
        self.here.data = {"x": [theta[i]], "y": [theta[j]]}
        self.map_words.text = f"<p>{escape(found.words)}</p>"

    # pins, files, solves

    def pin(self) -> None:
        """Keep the present design beside those to come."""
        if self.now is not None:
            self.pins.append((f"pin {len(self.pins) + 1}", self.now))
            self._show_pins()

    def drop(self) -> None:
        """Take the selected pins away, the last one where none is selected."""
        chosen = set(self.pinned.selected.indices) or {len(self.pins) - 1}
        self.pins = [pin for i, pin in enumerate(self.pins) if i not in chosen]
        self._show_pins()

    def return_to(self) -> None:
        """Move the sliders to the selected pin."""
        for i in self.pinned.selected.indices[:1]:
            self.controls.put(self.pins[i][1].look.knobs)
            self.moved(True)

    def _show_pins(self) -> None:
        names = self.session.problems.at(self.session.start).names
        self.pinned.selected.indices = []
        self.pinned.data = pin_columns(names, [(name, drawn.look) for name, drawn in self.pins])
        self.figures.pin(self.pins)

    def write_case(self) -> None:
        """Save as case."""
        place = self.session.save(self.controls.knobs())
        self.output.text = f"<p>saved {escape(str(place))}</p>"

    def start_solve(self) -> None:
        """Solve from here, in the background."""
        folder, case = self.session.folder_for_solve(self.controls.knobs())
        self._output = [f"solving into {folder}"]
        self.solve_button.disabled, self.stop.disabled = True, False
        self.solve = Solve(
            case, folder, self.workers, self._then(self._said), self._then(self._ended)
        )
        self._said("")

    def stop_solve(self) -> None:
        """As Ctrl-C."""
        if self.solve is not None:
            self.solve.stop()

    def _said(self, line: str) -> None:
        if line:
            self._output.append(line)
        shown = "\n".join(self._output[:1] + self._output[1:][-LINES:])
        self.output.text = f"<pre>{escape(shown)}</pre>"

    def _ended(self, code: int) -> None:
        self.solve_button.disabled, self.stop.disabled = False, True
        words = {0: "done and verified", 3: "no feasible design", 4: "finished, not verified", 130: "stopped; what is sampled is kept"}  # fmt: skip
        self._said(f"the solve ended: {words.get(code, f'exit code {code}')}")

    def close(self) -> None:
        """The page was closed: a solve goes on only while somebody sees it."""
        self.stop_solve()
        self.session.keep(self._seen)
        self._seen = []
