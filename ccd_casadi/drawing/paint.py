"""A page's content as HTML with the numbers behind its figures, and kept as report.json."""

import base64
import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Template
from markupsafe import Markup
from markupsafe import escape as escaped

from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.charts import figure_landscape, panel_html
from ccd_casadi.drawing.content import Drawing, Landscape, Lines, Page, Panel, Table
from ccd_casadi.drawing.surface import data, legend, still
from ccd_casadi.drawing.svg import SUPERSCRIPT, THEME, axis_label
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import plain, restore
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.text import number, package_text, printable, template
from surrogates.files import write_whole

ROWS = 40  # of a table, besides marked places
STEP = 4  # of a landscape's grid
FREQUENCY = "frequency (Hz)"
Column = tuple[str, str, Array, Array, bool]  # its axis, its name, x, y, whether a line joins them


def tables_of(drawing: Drawing) -> tuple[Table, ...]:
    """Tabulate the numbers of a drawing.

    Panels that share an axis have one table, with a column for each curve. Of a landscape there are
    its grid, thinned, and the true samples; a picture has none.

    Parameters
    ----------
    drawing : Drawing

    Returns
    -------
    tuple of Table
    """
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
    """List the columns that a panel shows, both parts of loci over frequency."""
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


POLICY = "default-src 'none'; style-src 'unsafe-inline'"  # no request, no script but ours
# Our scripts, in assets/, and what in a body needs them; some bring their style.
SCRIPTS = {"cursor": " data-axes=", "zoom": " data-axes=", "steps": '<div class="steps">',
           "save": '<div class="save">', "turntable": 'class="turntable"'}  # fmt: skip
STYLED = ("steps", "turntable")


def theme(which: int) -> str:
    """Write the colours of figures as variables of CSS.

    Parameters
    ----------
    which : int
        0 light, 1 dark.

    Returns
    -------
    str
    """
    return "; ".join(f"--{name}: {colours[which]}" for name, colours in THEME.items())


CSS = (
    f":root {{ {theme(0)} }}\n@media screen and (prefers-color-scheme: dark) {{"
    f" :root {{ {theme(1)} }} }}\n{package_text('drawing/assets/page.css')}"
)


def escape(text: object) -> str:
    """Escape text for HTML, quotes included; control characters become a replacement sign.

    Parameters
    ----------
    text : object

    Returns
    -------
    str
    """
    return str(escaped(printable(str(text))))


def typeset(text: str) -> str:
    """Set words that a terminal shows in ASCII with the signs that are meant.

    Parameters
    ----------
    text : str

    Returns
    -------
    str
        Units keep their number on one line.

    >>> typeset("less than +-2 %, norm <= 3, 41 um").replace(" ", "~")
    'less than ±2~%, norm ≤ 3, 41~µm'
    >>> typeset("KKT residual 1.5e-16, at confidence 1 - 1e-6")
    'KKT residual 1.5·10⁻¹⁶, at confidence 1 - 10⁻⁶'
    >>> typeset("KKT residual 0.0e+00")
    'KKT residual 0.0'
    """
    for word, sign in (("+-", "±"), ("<=", "≤"), (">=", "≥")):
        text = text.replace(word, sign)
    text = re.sub(r"(?<=\d) u(?=[ms]\b)", " µ", text)
    text = re.sub(r"\b(\d(?:\.\d+)?)e([+-]?\d+)\b", _power, text)  # and no line ends in it
    return re.sub(r"(?<=\d) (?=(?:%|°|[GMkmµn]?(?:Hz|kg|N|m|s)\b))", "\xa0", text)


def _power(found: re.Match[str]) -> str:
    power = f"10{str(int(found[2])).translate(SUPERSCRIPT)}"
    if not int(found[2]):  # a residual of 0.0e+00
        return found[1]
    return power if found[1] == "1" else f"{found[1]}·{power}"


def page_html(page: c.Page, workers: Pool | None = None) -> str:
    """Write a whole document.

    Its policy forbids any request; a script that the body needs is allowed by its hash alone.

    Parameters
    ----------
    page : Page
    workers : Pool, optional
        They draw a chapter each.

    Returns
    -------
    str
    """
    chapters = {i: (chapter, str(i)) for i, chapter in enumerate(page.chapters, 1)}
    drawn = dict(results(workers, block_html, chapters))
    body = Markup("\n").join(drawn[i] for i in chapters)
    own = [name for name, mark in SCRIPTS.items() if mark in body]
    scripts = [package_text(f"drawing/assets/{name}.js") for name in own]
    css = CSS + "".join(package_text(f"drawing/assets/{n}.css") for n in own if n in STYLED)
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes)
    policy = f"{POLICY}; script-src {allowed}" if own else POLICY
    whole = template("drawing/assets/page.html", painted=block_html)
    return whole.render(page=page, policy=policy, css=css, body=body, scripts=scripts)


def block_html(block: c.Block | c.Drawing | c.Chapter | c.Head, key: str = "") -> Markup:
    """Write one part of a page.

    Parameters
    ----------
    block : Block, Drawing, Chapter or Head
    key : str
        Unique in the page.

    Returns
    -------
    Markup
    """
    made: Any = getattr(_blocks().module, type(block).__name__)
    return Markup(made(block, key))


@cache
def _blocks() -> Template:
    return template(
        "drawing/assets/blocks.html", painted=block_html, panel=panel_html, number=number,
        landscape=figure_landscape, typeset=typeset, tables_of=tables_of, still=still, data=data,
        scale=legend,
    )  # fmt: skip


NAME = "report.json"
FORMAT = 1


def write_page(path: Path, page: Page, workers: Pool | None = None) -> None:
    """Draw a page and keep what it shows in report.json beside it, each atomically.

    Parameters
    ----------
    path : Path
    page : Page
    workers : Pool, optional
        They draw a chapter each.
    """
    try:
        pages = read_pages(path.parent)
    except UserError:  # what cannot be read is written anew
        pages = {}
    pages[path.name] = plain(page, listed=True)
    _write_content(path.with_name(NAME), pages)
    draw(path, pages[path.name], workers)


def draw(path: Path, stored: Any, workers: Pool | None = None) -> None:
    """Draw a page from an entry of report.json, whose chapters may be called sections. Raises
    UserError where it is none."""
    write_whole(path, page_html(_restore(path, stored), workers))


def update_pages(folder: Path, change: Callable[[str, Page], Page]) -> dict[Path, str]:
    """Draw those pages of a folder again whose head a change alters.

    Parameters
    ----------
    folder : Path
        With a report.json; without one, or with a damaged one, nothing is drawn.
    change : callable
        (name, Page) -> Page.

    Returns
    -------
    dict of Path to str
        Title of each page.
    """
    try:
        stored = read_pages(folder)
        pages = {name: _restore(folder / name, entry) for name, entry in stored.items()}
    except UserError:
        return {}
    changed = {name: change(name, page) for name, page in pages.items()}
    anew = [name for name, page in changed.items() if page.head != pages[name].head]
    if anew:
        stored |= {name: plain(changed[name], listed=True) for name in anew}
        _write_content(folder / NAME, stored)
    for name in anew:
        write_whole(folder / name, page_html(changed[name]))
    return {folder / name: page.head.title for name, page in changed.items()}


def _restore(path: Path, stored: Any) -> Page:
    try:
        return restore(Page, {"chapters": stored.get("sections"), **stored})
    except (AttributeError, KeyError, TypeError, ValueError, IndexError):
        words = f"pages.{path.name}: is not what a page shows; repeat the command that wrote it"
        raise UserError(f"{path.with_name(NAME)}: {words}") from None


def _write_content(path: Path, pages: Mapping[str, Any]) -> None:
    content = {"format": FORMAT, "pages": pages}
    write_whole(path, json.dumps(content, ensure_ascii=False, allow_nan=False))


def read_pages(folder: Path) -> dict[str, Any]:
    """Read the entries of a folder's report.json.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    dict of str to dict
        Name of the page -> what it shows; empty where there is no such file.

    Raises
    ------
    UserError
        The file is damaged, or of a later version.
    """
    path = folder / NAME
    if not path.exists():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        pages = dict(found["pages"]) if found["format"] == FORMAT else None
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{path}: is not a report.json; repeat the command") from None
    if pages is not None and any(name != Path(name).name or "." not in name for name in pages):
        raise UserError(f"{path}: pages: names a file that is not a page of this folder")
    if pages is None:
        raise UserError(f"{path}: format: is not {FORMAT}; draw it with the version that wrote it")
    return pages
