"""One browser page: sliders, figures and buttons over a session; an answer to every drag."""

import re
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady
from bokeh.layouts import column, row
from bokeh.models import ColumnDataSource, CustomJS, Range1d
from bokeh.models.widgets.markups import Div

from ccd_casadi.cases.run_folder import read_run
from ccd_casadi.drawing.paint import escape
from ccd_casadi.extensions.explorer import ASSETS
from ccd_casadi.extensions.explorer.controls import (
    Controls,
    NotchFigure,
    PlacesFigure,
    button,
    moves,
)
from ccd_casadi.extensions.explorer.curves import (
    EMPTY,
    FIGURES,
    OVER_HZ,
    STYLES,
    Drawn,
    curves_of,
    draw_design,
    machine_html,
    move_words,
    sampled_of,
    standing_html,
    with_sampled,
)
from ccd_casadi.extensions.explorer.designs import (
    Designed,
    ExploredDesign,
    How,
    design_controller,
    with_warm_starts_of,
)
from ccd_casadi.extensions.explorer.knobs import Knobs
from ccd_casadi.extensions.explorer.painter import (
    ON_DARK,
    Message,
    PanelFigure,
    cursor,
    legend_html,
)
from ccd_casadi.extensions.explorer.pins import (
    Kept,
    MapFigure,
    Pins,
    landscape_of,
    run_surrogate,
    steepest_axes,
)
from ccd_casadi.extensions.explorer.session import Background, Session, Solve, search_exactly
from ccd_casadi.reporting.landscape import known_bandwidths, read_truths
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.options import ExitCode
from ccd_casadi.support.text import package_text

TOGETHER = 4  # ms without a move of a slider, then the moves before are answered at once
WIDE = ".bk-clearfix { display: block; width: 100%; }"  # a picture takes the width that there is
LINES = 40  # of a solve's output
BAR = re.compile(r"\d+/\d+ \[[#-]+\]")  # of a line that reports progress
NO_NOTCH = "none: drag the diamond down from the curve of |L|, or move its gain below 1"
SOLVED = "runs"  # where the pages of such a solve are found, below the address of this one


class ExplorerPage:
    """The widgets of one document, and what happens when one is moved."""

    def __init__(
        self, document: Document, session: Session, background: Background,
        of_solves: Sequence[str], dark: bool, kept: Kept,
    ) -> None:  # fmt: skip
        self.document, self.session, self.background = document, session, background
        self._of_solves, self._dark, self._kept = of_solves, dark, kept  # options of solves
        parameters = session.case.theta
        hz, line = Range1d(start=0.1, end=1e4), cursor()
        self.figures = [
            PanelFigure(name, heading, dark, log_x=log_x, log_y=log_y,
                        x_range=hz if name in OVER_HZ else None,
                        cursor=line if name in OVER_HZ else None, whole_circles=name == "nyquist")
            for name, (heading, log_x, log_y) in FIGURES.items()
        ]  # fmt: skip
        self.controls = Controls(session.case, session.start, self.on_moved, dark)
        if kept.knobs is not None:
            self.controls.put(kept.knobs)
        self.map = MapFigure(parameters, self.draw_map, dark)
        unit = session.case.objective.cost_unit
        self.pins = Pins(parameters, self.figures, self.map, kept, dark, unit)
        loop = next(made for made in self.figures if made.name == "L")
        self.notch = NotchFigure(loop, dark, self._notch_moved)
        run, problem = session.run, session.problems.at(session.start)
        self.places = [PlacesFigure(problem, self._on_placed)] if moves(problem) else []
        self._surrogate = None if run is None else run_surrogate(run.folder)
        self._open, self._moves = True, 0  # moves of sliders up to now
        self._answer_due = False  # to all moves since the last answer,
        self._let_go = self._of_search = False  # one of which let go, or a search alone answers
        self._notch_due = False
        self._first: tuple[str, float] | None = None  # the design at the start, and its ω_b in Hz
        self._unsaved: list[ExploredDesign] = []  # to be written into the store
        self._to_search: Knobs | None = None  # the newest place, while a search is under way
        self.now: Drawn | None = None
        known = known_bandwidths(problem, self._surrogate, read_truths(session.store.path, problem))
        self.map.choose(steepest_axes(known, problem.lower, problem.upper))
        self.solve: Solve | None = None
        self._output: list[str] = []
        self._solved = session.folder
        # what was answered last: a watch in the browser stops when this has been drawn
        nothing: dict[str, list[Any]] = {"serial": [0], "theta": [[]], "how": [""]}
        self.answer = ColumnDataSource(nothing, name="answer")
        self._message, self._serial = Message(), 0
        self._message.apply_in(document)
        self.pins.table.tags = [self.answer, self._message]  # so that they are sent
        self.note, self.output = Div(name="note"), Div(name="output")
        self.modes = Div(stylesheets=[WIDE])
        self.design = button("Design sections here", "design", self.design_structured, dark)
        self._is_designing, self._design_began = False, session.kappa is not None
        self.solve_button = button("Solve from here", "solve", self.start_solve, dark)
        self.stop = button("Stop the solve", "stop", self.stop_solve, dark)
        self.stop.disabled = True
        self._place()
        self.on_moved(True)

    def _place(self) -> None:
        made = [button(*words, self._dark) for words in (
            ("Pin this design", "pin", self.pin), ("Go to selected", "go", self.go),
            ("Unpin selected", "unpin", self.pins.drop), ("Save as case", "save", self.write_case),
        )]  # fmt: skip
        buttons = [*made[:3], self.design, self.solve_button, self.stop, made[3]]
        fill: Any = "stretch_width"
        wrapped = row(*buttons, sizing_mode=fill, styles={"flex-wrap": "wrap"})
        roots: dict[str, list[Any]] = {
            "controls": self.controls.all(),
            "note_place": [self.note, self.output],
            "modes": [self.modes],
            "buttons_place": [wrapped],
            "pins_place": [self.pins.table],
            "map_place": [self.map.root()],
            "notch_place": [self.notch.root()],
        } | {f"{made.name}_place": [made.figure] for made in self.figures}
        roots |= {f"{places.name}_place": [places.figure] for places in self.places}
        with self.document.models.freeze():  # its models are collected once, not for every root
            for name, parts in roots.items():
                for part in parts:
                    if part.sizing_mode is None:
                        part.sizing_mode = fill
                self.document.add_root(column(*parts, name=name, sizing_mode=fill))
        names = {made.name: made.heading for made in self.figures} | {"landscape": "Landscape"}
        label = CustomJS(args={"names": names}, code=package_text(f"{ASSETS}/label.js"))
        self.document.js_on_event(DocumentReady, label)

    # drags

    def _on_placed(self, theta: Array) -> None:
        """A place was dragged: the sliders move to its θ, within the box."""
        low, high = zip(*((p.lower, p.upper) for p in self.session.case.theta), strict=True)
        inside = tuple(np.clip(theta, low, high).tolist())
        self.controls.put(replace(self.controls.knobs(), theta=inside))
        self.on_moved(True)

    def on_moved(self, let_go: bool, of_search: bool = False) -> None:
        """A slider moved: answer soon, once for all that moved meanwhile.

        `of_search`: it is one that a search alone answers.
        """
        self._let_go, self._of_search = self._let_go or let_go, self._of_search or of_search
        self._moves += 1
        if not self._answer_due:
            self._answer_due = True
            self._answer_after(self._moves)

    def _answer_after(self, moves: int) -> None:
        # While a slow design was made, moves queued up that come now one by one: to answer each
        # would leave the page further and further behind the slider.
        def still() -> None:
            if self._moves == moves:
                self._answer()
            else:
                self._answer_after(self._moves)

        self.document.add_timeout_callback(still, TOGETHER)

    def on_improved(self) -> None:
        """The model of a slow plant was made anew: draw what is not the plant's own on it."""
        if self.now is not None and not self.now.design.elements.exact:
            self.on_moved(False)

    def _answer(self) -> None:
        """The design at the sliders: of a full search where a slider was let go or only a search
        answers, else of the last break frequencies. On a slow plant the search comes later."""
        let_go, search = self._let_go, self._of_search and self.session.quick
        self._answer_due = self._let_go = self._of_search = False
        self._kept.knobs = knobs = self.controls.knobs()
        structured, slow = knobs.structured, self.session.known is not None
        self.design.disabled = self._is_designing or not structured
        full = (let_go or search or bool(self.controls.always.active)) and not structured
        try:
            design = self.session.full(knobs) if full and not slow else self.session.live(knobs)
        except UserError as error:
            self._complain(str(error))
            return
        self.note.text = ""
        self.show(design)
        if full and slow:
            self._search_behind(knobs)
        if let_go:
            self.settle()
        if structured and not self._design_began and not slow:
            self.design_structured()  # no page stays without a controller

    def _complain(self, words: str) -> None:
        self.note.text = f'<p class="refused">{escape(words)}</p>'

    def show(self, design: ExploredDesign) -> None:
        """Draw a design, and say that this is the answer."""
        sampled = sampled_of(design) if design.knobs.sampled else None
        design = with_sampled(design, sampled)
        self._shown = design, curves_of(design), sampled
        self._paint()
        self._unsaved.append(design)
        if self._first is None and design.how is not How.PRESENT:
            self._first = "the first one", design.bandwidth_hz

    def _paint(self) -> None:
        """The present design, with its notch."""
        design, curves, sampled = self._shown
        session, view = self.session, None if curves is None else curves.view
        notched = None if view is None else self.notch.of(view)
        self.now = now = draw_design(design, curves, sampled, notched)
        self._serial += 1
        answer = {
            "serial": [self._serial],
            "theta": [list(design.theta)],
            "how": [design.how.value],
        }
        pinned = self.pins.pinned
        beside = (pinned[-1][0], pinned[-1][1].design.bandwidth_hz) if pinned else self._first
        colour, dash = STYLES[design.standing]
        words = {
            "verdict": standing_html(design, curves, sampled, beside),
            "machine": machine_html(design, session.start.theta, session.reference),
            "say_notch": escape(NO_NOTCH if notched is None else notched.words(design.knobs.S_max)),
        } | {f"say_{made.name}": legend_html(now.panels.get(made.name, EMPTY), colour)
             for made in self.figures}  # fmt: skip
        words["say_move"] = move_words(curves, design.problem.source.motion is not None)
        colour = ON_DARK.get(colour, colour) if self._dark else colour
        frame = design.how is not How.PRESENT and curves is not None
        changes = [change for made in self.figures for change in
                   made.changes(now.panels.get(made.name, EMPTY), colour, dash, frame)]  # fmt: skip
        changes += [made.marks(design.theta) for made in self.places]
        changes += [self.notch.mark(view), self.map.mark(design.theta)]
        self._message.send(words, [*changes, (self.answer, {"data": answer})])

    def _notch_moved(self) -> None:
        """Once for all moves of the pointer that came meanwhile."""
        if self.now is not None and not self._notch_due:
            self._notch_due = True
            self.document.add_timeout_callback(self._notch_again, TOGETHER)

    def _notch_again(self) -> None:
        self._notch_due = False
        self._paint()

    def settle(self) -> None:
        """Write what was shown and draw the landscape, once the answer is on its way."""
        self.document.add_next_tick_callback(self._on_settled)

    def _on_settled(self) -> None:
        seen, self._unsaved = self._unsaved, []
        self.session.keep(seen)
        self.draw_map()

    def draw_map(self) -> None:
        """The landscape at the present settings."""
        if self.now is None:
            return
        run, store = self.session.run, self.session.store.path
        made_for = None if run is None else run.problem
        design = self.now.design
        self.map.show(
            *landscape_of(
                design.problem, design.theta, made_for, self._surrogate, store, self.map.axes
            )
        )
        here, new = self.map.mark(design.theta)
        here.update(**new)

    # the background

    def _in_turn(self, action: Callable[[Any], None]) -> Callable[[Any], None]:
        """The action in this document's own turn, whatever thread calls."""

        def later(found: Any) -> None:
            if self._open:
                self.document.add_next_tick_callback(lambda: action(found))

        return later

    def _search_behind(self, knobs: Knobs) -> None:
        """The exact elements and the full search of the newest place, one at a time."""
        is_busy, self._to_search = self._to_search is not None, knobs
        self.note.text = "<p>solving the model and searching at this θ …</p>"
        if not is_busy:
            task = (self.session.problems.at(knobs), knobs)
            search = self.background.ask(search_exactly, task)
            failed = self._in_turn(self._search_failed)
            self.background.answer(search, self._in_turn(self._on_searched), failed)

    def _on_searched(self, found: tuple[ExploredDesign, str]) -> None:
        design, modes = found
        newest, self._to_search = self._to_search, None
        known = self.session.known
        assert known is not None
        self.note.text = ""
        count = len(known.exact)
        off = self.session.took(design)
        if off is not None:
            words = f"the frequencies drawn while you dragged were off by {100.0 * off:.2g} % here"
            self.note.text = f"<p>{words}</p>"
        if len(known.exact) > count:
            self.background.renew(known, self._in_turn(lambda _: self.on_improved()))
        self.modes.text = modes
        if newest in (None, design.knobs) and self.controls.knobs() == design.knobs:
            self.show(design)
        else:
            self._unsaved.append(design)
        if newest is not None and newest != design.knobs:
            self._search_behind(newest)
        self.settle()

    def _search_failed(self, error: BaseException) -> None:
        self._to_search = None
        self._complain(str(error))

    def design_structured(self) -> None:
        """A controller of fixed structure at this θ."""
        knobs = self.controls.knobs()
        problem = with_warm_starts_of(self.session.problems.at(knobs), self.session.designed_for)
        self.waits_for(self.background.ask(design_controller, (problem, knobs), self.heard))

    def waits_for(self, design: Future) -> None:
        """A design is under way, which this page shows once it ends."""
        self.design.disabled = self._is_designing = self._design_began = True
        self._designing("it takes seconds")
        failed = self._in_turn(self._design_failed)
        self.background.answer(design, self._in_turn(self._on_designed), failed)

    def heard(self, words: str) -> None:
        """Show how far a design is, from any thread."""
        self._in_turn(self._designing)(words)

    def _designing(self, words: str) -> None:
        if self._is_designing:  # not of one that has ended
            self.note.text = f"<p>designing a controller at this θ: {escape(words)} …</p>"

    def _end_design(self) -> None:
        self._is_designing, self.note.text = False, ""
        self.design.disabled = not self.controls.knobs().structured

    def _design_failed(self, error: BaseException) -> None:
        self._end_design()
        self._complain(str(error))

    def _on_designed(self, found: Designed) -> None:
        self._end_design()
        design = self.session.took_designed(found)
        if design is None:
            self._complain(found.words)
        elif found.knobs == self.controls.knobs():
            self.show(design)
            self.settle()
        else:  # the sliders moved meanwhile: it is judged where they are
            self.on_moved(True)

    def pin(self) -> None:
        """Keep the present design beside those to come."""
        if self.now is not None:
            self.pins.add(self.now)

    def go(self) -> None:
        """Move the sliders to the selected pin."""
        if (pinned := self.pins.first_selected()) is not None:
            self.controls.put(pinned.design.knobs)
            self.on_moved(True)

    def write_case(self) -> None:
        """Save the design as a case."""
        place = self.session.save(self.controls.knobs())
        self.output.text = f"<p>saved {escape(str(place))}</p>"

    def start_solve(self) -> None:
        """Solve from here, in the background."""
        folder, case = self.session.folder_for_solve(self.controls.knobs())
        self._output, self._solved = [f"solving into {folder}"], folder
        self.solve_button.disabled, self.stop.disabled = True, False
        said, ended = self._in_turn(self._print_line), self._in_turn(self._solve_ended)
        self.solve = Solve(case, folder, self._of_solves, said, ended)
        self._print_line("")

    def stop_solve(self) -> None:
        """Stop the solve as Ctrl-C does."""
        if self.solve is not None:
            self.solve.stop()

    def _print_line(self, line: str) -> None:
        if BAR.search(line) and BAR.search(self._output[-1]):
            self._output[-1] = line
        elif line:
            self._output.append(line)
        shown = "\n".join(self._output[:1] + self._output[1:][-LINES:])
        self.output.text = f"<pre>{escape(shown)}</pre>"

    def _solve_ended(self, code: int) -> None:
        self.solve_button.disabled, self.stop.disabled = False, True
        known = {exit_code.value: exit_code.words for exit_code in ExitCode}
        self._print_line(f"the solve ended: {known.get(code, f'exit code {code}')}")
        if code in (ExitCode.DONE, ExitCode.NOT_VERIFIED):
            self._go_to_solved()
        if (self._solved / "report.html").exists():
            place = f"{SOLVED}/{self._solved.name}/report.html"
            self.output.text += f'<p><a href="{place}" target="_blank">the report of it</a></p>'

    def _go_to_solved(self) -> None:
        """Put the solved design on the sliders and its surrogate in the landscape."""
        try:
            run = read_run(self._solved)
        except UserError:
            return  # what it ended with is no certified design
        self.session.run, self._surrogate = run, run_surrogate(run.folder)
        self.controls.put(replace(self.controls.knobs(), theta=run.theta))
        self.on_moved(True)

    def close(self) -> None:
        """The page was closed: a solve goes on only while somebody sees it."""
        self._open = False
        self.stop_solve()
        self.session.keep(self._unsaved)
        self._unsaved = []
