"""The page on the loopback address: one port, a token in the path, nothing from outside."""

import asyncio
import secrets
import warnings
import webbrowser
from concurrent.futures import Future
from pathlib import Path

from bokeh.document import Document
from bokeh.events import ClientReconnected, ConnectionLost
from bokeh.models import CustomJS
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from jinja2 import Template
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop
from tornado.web import StaticFileHandler

from ccd_casadi.drawing.paint import theme
from ccd_casadi.extensions.explorer.curves import FIGURES
from ccd_casadi.extensions.explorer.designs import design_controller
from ccd_casadi.extensions.explorer.page import SOLVED, ExplorerPage
from ccd_casadi.extensions.explorer.pins import Kept
from ccd_casadi.extensions.explorer.session import Background, Session

HOST = "127.0.0.1"
TEMPLATE = Path(__file__).with_name("page.html")


def _require_event_loop() -> None:
    """Make a current one where there is none: Bokeh takes it, and Python makes it no longer."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # that it will not, from 3.12 on
        try:
            asyncio.get_event_loop()
        except RuntimeError:
            asyncio.set_event_loop(asyncio.new_event_loop())


class Explorer:
    """The server of a session, until `stop`.

    Parameters
    ----------
    session : Session
    workers, seed : int
        Of the solves that are started from the page.
    user_code : bool
        Whether plant functions of users may run.

    Attributes
    ----------
    url : str
        With a token, without which every path is refused.
    """

    def __init__(
        self, session: Session, *, workers: int, seed: int = 0, user_code: bool = True
    ) -> None:
        self.session = session
        self.background = Background(user_code)
        self._pages: list[ExplorerPage] = []
        self._kept: dict[str, Kept] = {}  # by the tab that the address names
        self._of_solves = ("--workers", str(workers), "--seed", str(seed))
        _require_event_loop()
        token = secrets.token_urlsafe(16)
        # a page from here may not link to a file of the disk
        solved = {"path": str(session.folder.resolve())}
        sockets, port = bind_sockets(HOST, 0)
        self.url = f"http://{HOST}:{port}/{token}/"
        application = BokehTornado(
            {"/": self._document},
            prefix=token,  # of every path, the socket's and the scripts' too
            extra_websocket_origins=[f"{HOST}:{port}"],  # Bokeh's own is localhost by name
            use_index=False,
            extra_patterns=[(rf"/{SOLVED}/(solved_\d+/.+)", StaticFileHandler, solved)],
        )
        served = HTTPServer(application)
        served.add_sockets(sockets)
        self._server = BaseServer(IOLoop.current(), application, served)
        self._first = self._design_first() if session.undesigned else None
        if session.known is not None:
            self.background.renew(session.known, self._on_renewed)

    def _design_first(self) -> Future:
        """The controller that pages begin with, designed while they open; they hear how far it
        is."""
        session = self.session

        def heard(words: str) -> None:
            for page in list(self._pages):
                page.heard(words)

        task = (session.problems.at(session.start), session.start)
        return self.background.ask(design_controller, task, heard)

    def _document(self, document: Document) -> None:
        context = document.session_context
        arguments = getattr(getattr(context, "request", None), "arguments", {})
        dark = arguments.get("dark", [b"0"])[0] == b"1"
        tab = arguments.get("tab", [b""])[0].decode("ascii", "replace")
        kept = self._kept.setdefault(tab, Kept()) if tab else Kept()
        document.config.notify_connection_status = False  # the page says it, and what to do
        document.title = f"Explorer: {self.session.case.path.name}"
        document.template = Template(TEMPLATE.read_text(encoding="utf-8"))
        document.template_variables.update(
            case=self.session.case.path, folder=self.session.folder, dark=dark, figures=FIGURES,
            css=f":root {{ {theme(int(dark))} }}", several=len(self.session.case.theta) > 1,
        )  # fmt: skip
        shown = 'document.getElementById("lost").hidden = '
        document.js_on_event(ConnectionLost, CustomJS(code=f"{shown}false"))
        document.js_on_event(ClientReconnected, CustomJS(code=f"{shown}true"))
        document.theme = "dark_minimal" if dark else "light_minimal"
        page = ExplorerPage(document, self.session, self.background, self._of_solves, dark, kept)
        if self._first is not None and self.session.undesigned:
            page.waits_for(self._first)
        self._pages.append(page)
        document.on_session_destroyed(lambda context: self._gone(page))

    def _gone(self, page: ExplorerPage) -> None:
        self._pages.remove(page)
        page.close()

    def _on_renewed(self, _: None) -> None:
        for page in list(self._pages):
            page.document.add_next_tick_callback(page.on_improved)

    def run(self, *, show: bool) -> None:
        """Serve until Ctrl-C."""
        self._server.start()
        if show:
            self._server.io_loop.add_callback(webbrowser.open, self.url)
        self._server.io_loop.start()

    def close(self) -> None:
        """End what is under way; what was looked at is written."""
        for page in self._pages:
            page.close()
        self.background.close()
        self._server.stop()
        self.session.store.close()
