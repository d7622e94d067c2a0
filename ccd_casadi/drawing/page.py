"""One self-contained HTML page: text, tables and inline figures; nothing external.

Figures take the colours of the page, which follow the reader's theme and are light in print. By
hand, not by templates: six shapes of plain text, each escaped in the one function that makes it.
"""

import base64
import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape as _escape
from typing import Any

from ccd_casadi.drawing.svg import THEME
from ccd_casadi.support.package_text import package_text

POLICY = "default-src 'none'; style-src 'unsafe-inline'"  # no request, no script but ours
# Our scripts, in assets/, and what in a body needs them; some bring their style.
SCRIPTS = {"cursor": " data-axes=", "steps": '<div class="steps">',
           "turntable": 'class="turntable"'}  # fmt: skip
STYLED = ("steps", "turntable")
INDEX = "index.html"  # of a run's folder
MANY = 8  # columns of a table that is set smaller in print


def theme(which: int) -> str:
    """The colours of figures as variables of CSS: 0 light, 1 dark."""
    return "; ".join(f"--{name}: {colours[which]}" for name, colours in THEME.items())


CSS = (
    f":root {{ {theme(0)} }}\n@media screen and (prefers-color-scheme: dark) {{"
    f" :root {{ {theme(1)} }} }}\n{package_text('drawing/assets/page.css')}"
)


@dataclass(frozen=True)
class Table:
    """Column heads and rows of texts or numbers; numbers are rounded and set to the right."""

    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it, as HTML; `own_page` starts a page in print."""

    heading: str
    body: str
    own_page: bool = False


def escape(text: object) -> str:
    """Text for HTML, quotes included; control characters show as a replacement sign."""
    kept = "".join(c if c.isprintable() or c in "\n\t" else "\ufffd" for c in str(text))
    return _escape(kept)


def typeset(text: str) -> str:
    """Words that a terminal shows in ASCII, with the signs that are meant.

    >>> typeset("less than +-2 %, norm <= 3, 41 um")
    'less than ±2 %, norm ≤ 3, 41 µm'
    """
    for plain, sign in (("+-", "±"), ("<=", "≤"), (">=", "≥")):
        text = text.replace(plain, sign)
    return re.sub(r"(?<=\d) u(?=[ms]\b)", " µ", text)


def number(value: Any, digits: int = 5) -> str:
    """A number to `digits` significant digits; a dash where there is none.

    >>> number(72.0451741), number(1.5e-9, 3), number(None), number(1800.0)
    ('72.045', '1.5e-09', '–', '1800')
    """
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    size = abs(float(value))
    if 1.0 <= size < 1e7:
        # never fewer digits than the whole part has: 110023 stays 110023
        digits = max(digits, len(str(int(size))))
    return f"{float(value):.{digits}g}"


def table_html(table: Table, css: str = "") -> str:
    """The table; texts are escaped, numbers rounded."""

    def cell(value: Any, tag: str, numeric: bool) -> str:
        text = value if isinstance(value, str) else number(value)
        kind = ' class="n"' if numeric else ""
        return f"<{tag}{kind}>{escape(text)}</{tag}>"

    columns = range(len(table.head))
    numeric = [all(not isinstance(row[i], str) for row in table.rows) for i in columns]
    head = "".join(cell(name, "th", numeric[i]) for i, name in enumerate(table.head))
    rows = "\n".join(
        "<tr>" + "".join(cell(v, "td", numeric[i]) for i, v in enumerate(row)) + "</tr>"
        for row in table.rows
    )
    css = f"{css} many".strip() if len(table.head) > MANY else css
    kind = f' class="{css}"' if css else ""
    made = f"<table{kind}><thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody></table>"
    return f'<div class="table">{made}</div>'


def facts_html(rows: Iterable[tuple[str, str, str]]) -> str:
    """Quantity, value and remark in three columns; plain texts in."""
    body = "\n".join(
        f'<tr><th scope="row">{escape(a)}</th><td>{escape(typeset(b))}</td>'
        f"<td>{escape(typeset(c))}</td></tr>"
        for a, b, c in rows
    )
    return f'<table class="wide"><tbody>{body}</tbody></table>'


def figure_html(svg: str, caption: str, table: Table, *more: Table) -> str:
    """A figure with its caption (plain text) and the numbers behind it, folded away."""
    tables = "\n".join(table_html(item) for item in (table, *more))
    return (
        f'<figure>\n<div class="drawing">{svg}</div>\n'
        f"<figcaption>{escape(typeset(caption))}</figcaption>\n"
        f'<details><summary>Data of this figure</summary><div class="scroll">\n{tables}\n'
        "</div></details>\n</figure>"
    )


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{escape(typeset(text))}</p>"


def preformatted(text: str) -> str:
    """Text as it is, in a box."""
    return f"<pre>{escape(text)}</pre>"


def header(
    title: str,
    good: bool,
    status: str,
    reason: str,
    meta: str,
    lead: str,
    *,
    warned: bool = False,
    verdict: str = "",
) -> str:
    """Title, status badge with its reason, a line of circumstances, and the conclusion.

    The badge is not green where the verdict has a warning; `verdict` is HTML of its lines.
    """
    kind, sign = ("good", "✓") if good else ("bad", "✕")
    if good and warned:
        kind, sign = "warn", "!"
    badge = f'<span class="badge {kind}">{sign} {escape(status)}</span>'
    return (
        f"<h1>{escape(title)}</h1>\n<p class='standing'>{badge} {escape(typeset(reason))}</p>\n"
        f'<p class="meta">{escape(meta)}</p>\n<p class="lead">{escape(typeset(lead))}</p>\n'
        f"{verdict}"
    )


def page(title: str, sections: Sequence[Section], head: str = "", index: str = INDEX) -> str:
    """The whole document; `head` is HTML above the sections.

    The policy forbids any request; a script that the body needs is allowed by its hash alone.

    `index`: the page that links all of the run; empty on that one itself.
    """
    body = "\n".join(
        f'<section id="section-{i}"{" class=own-page" if section.own_page else ""}>'
        f"\n<h2>{escape(section.heading)}</h2>\n{section.body}\n</section>"
        for i, section in enumerate(sections, 1)
    )
    contents = " · ".join(
        f'<a href="#section-{i}">{escape(section.heading)}</a>'
        for i, section in enumerate(sections, 1)
    )
    up = f'<nav><a href="{escape(index)}">All pages of this run</a></nav>\n' if index else ""
    own = [name for name, mark in SCRIPTS.items() if mark in body]
    scripts = [package_text(f"drawing/assets/{name}.js") for name in own]
    css = CSS + "".join(package_text(f"drawing/assets/{n}.css") for n in own if n in STYLED)
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes)
    policy = f"{POLICY}; script-src {allowed}" if own else POLICY
    scripted = "".join(f"<script>{text}</script>\n" for text in scripts)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{css}</style>\n</head>\n<body>\n"
        f'{up}<header>{head}\n<nav class="contents">{contents}</nav></header>\n'
        f"<main>\n{body}\n</main>\n{scripted}</body>\n</html>\n"
    )
