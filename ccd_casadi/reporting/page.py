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

from ccd_casadi.reporting.cursor import SCRIPT
from ccd_casadi.reporting.svg import THEME

POLICY = "default-src 'none'; style-src 'unsafe-inline'"  # no request, no script but ours
INDEX = "index.html"  # of a run's folder
MANY = 8  # columns of a table that is set smaller in print


def theme(which: int) -> str:
    """The colours of figures as variables of CSS: 0 light, 1 dark."""
    return "; ".join(f"--{name}: {colours[which]}" for name, colours in THEME.items())


CSS = """
:root { color-scheme: light dark; --soft: #5a5a5a; --line: #dcdcdc; --link: #005a8c; --box: #f6f6f6;
  --good: #00543d; --good-ground: #e3f4ee; --bad: #8a3300; --bad-ground: #fdeee2;
  --warn: #6b5200; --warn-ground: #fdf6d8; LIGHT }
@media screen and (prefers-color-scheme: dark) {
  :root { --soft: #a9b0b5; --line: #39424a; --link: #6fb8ea; --box: #1f252a;
  --good: #8fe0c2; --good-ground: #10372c; --bad: #ffb58a; --bad-ground: #45210c;
  --warn: #f0d67a; --warn-ground: #3b320f; DARK }
}
* { box-sizing: border-box; }
html { background: var(--paper); }
body { max-width: 1000px; margin: 0 auto; padding: 28px 24px 64px; color: var(--ink);
  font: 15px/1.5 "Segoe UI", "Helvetica Neue", Helvetica, Arial, "DejaVu Sans", sans-serif; }
h1 { font-size: 26px; line-height: 1.25; margin: 0 0 8px; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 40px 0 10px; padding-top: 12px; border-top: 1px solid var(--line); }
h3 { font-size: 15px; margin: 22px 0 6px; }
p { margin: 8px 0; overflow-wrap: break-word; }
a, summary { color: var(--link); }
nav { font-size: 13px; margin: 0 0 14px; color: var(--soft); }
nav a { white-space: nowrap; }
nav.contents { margin: 14px 0 0; }
.meta { color: var(--soft); font-size: 13px; margin: 0 0 12px; overflow-wrap: anywhere; }
.badge { display: inline-block; padding: 1px 10px; border-radius: 11px; font-size: 14px;
  font-weight: 600; border: 1px solid; }
.good { color: var(--good); background: var(--good-ground); }
.bad { color: var(--bad); background: var(--bad-ground); }
.warn { color: var(--warn); background: var(--warn-ground); }
.open { color: var(--soft); background: var(--shade); }
.verdict { margin-top: 14px; } .verdict .badge { font-size: 12.5px; white-space: nowrap; }
.wide.verdict th:first-child { width: 11%; } .wide.verdict td:nth-child(2) { width: 12%; }
.lead { font-size: 17px; line-height: 1.5; margin: 12px 0 0; }
figure { margin: 14px 0 22px; }
svg { display: block; height: auto; max-width: 100%; }
svg * { stroke-linejoin: round; stroke-linecap: butt; }
svg text { font-family: "Segoe UI", "Helvetica Neue", Helvetica, Arial, "DejaVu Sans", sans-serif
  !important; fill: var(--ink); }
svg .readout { font-size: 9px; paint-order: stroke; stroke: var(--paper); stroke-width: 3px; }
svg .cursor { stroke: var(--grey); stroke-width: .8; stroke-dasharray: 2 2; pointer-events: none; }
.panels { display: grid; gap: 0 6px; }
.n2 { grid-template-columns: repeat(2, minmax(0, 1fr)); }
.n3 { grid-template-columns: repeat(3, minmax(0, 1fr)); }
.n4 { grid-template-columns: repeat(4, minmax(0, 1fr)); }
.drawing { overflow-x: auto; }
figcaption { margin-top: 8px; font-size: 14px; max-width: 860px; }
table { border-collapse: collapse; font-size: 13.5px; margin: 6px 0; }
th, td { text-align: left; padding: 3px 18px 3px 0; border-bottom: 1px solid var(--line);
  vertical-align: top; overflow-wrap: break-word; }
th { font-weight: 600; }
thead th { color: var(--soft); border-bottom: 1px solid var(--grey); }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
td.n { white-space: nowrap; }
.wide { width: 100%; }
.wide th:first-child { width: 23%; } .wide td:nth-child(2) { width: 22%; }
.table, .scroll { overflow-x: auto; }
.scroll { max-height: 460px; overflow-y: auto; }
details { margin: 6px 0 0; font-size: 13.5px; }
summary { cursor: pointer; }
pre { background: var(--box); padding: 12px 14px; overflow-x: auto; white-space: pre-wrap;
  font: 12.5px/1.45 ui-monospace, Menlo, Consolas, "DejaVu Sans Mono", monospace;
  overflow-wrap: anywhere; }
@media screen and (max-width: 640px) {
  body { padding: 18px 14px 48px; }
  .panels { grid-template-columns: minmax(0, 1fr); }
  .drawing > svg, .drawing > .n1 > svg { min-width: 640px; }
  .wide, .wide tbody, .wide tr, .wide th, .wide td { display: block; }
  .wide tr { padding: 5px 0; border-bottom: 1px solid var(--line); }
  .wide th, .wide td { display: inline; border: 0; padding: 0 10px 0 0; }
  .wide td:nth-child(3) { display: block; color: var(--soft); }
  .table td, .table th { padding-right: 12px; min-width: 3em; }
}
@page { size: A4; margin: 15mm; }
@media print {
  body { max-width: none; padding: 0; font-size: 10.5pt; }
  h1 { font-size: 17pt; }
  h2 { font-size: 13pt; margin-top: 12pt; padding-top: 8pt; }
  .lead { font-size: 11.5pt; }
  h2, h3 { break-after: avoid; }
  figure, tr, li { break-inside: avoid; }
  section.own-page { break-before: page; }
  figcaption { font-size: 9pt; } table { font-size: 8.5pt; }
  th, td { padding: 2px 10px 2px 0; }
  ul { margin: 4pt 0; } pre { font-size: 7.5pt; columns: 2; }
  .scroll, .table, .drawing { max-height: none; overflow: visible; }
  .many { font-size: 7pt; } .many th, .many td { padding-right: 6px; }
  nav, details:not([open]) { display: none; }
  .badge { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
}
""".replace("LIGHT", theme(0)).replace("DARK", theme(1))


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
    """The whole document; `head` is HTML above the sections. The policy forbids any request.

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
    made = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        f'{up}<header>{head}\n<nav class="contents">{contents}</nav></header>\n'
        f"<main>\n{body}\n</main>\n</body>\n</html>\n"
    )
    return with_script(made, SCRIPT) if " data-axes=" in body else made


def with_script(document: str, script: str, css: str = "") -> str:
    """A finished page with a script and its style, the script allowed by its hash alone."""
    if POLICY not in document:
        raise ValueError("the page's policy is not the one that the script is added to")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    if f"{POLICY}; script-src" not in document:
        document = document.replace(POLICY, f"{POLICY}; script-src", 1)
    document = document.replace("; script-src", f"; script-src 'sha256-{digest}'", 1)
    if css:
        document = document.replace("</head>", f"<style>{css}</style>\n</head>", 1)
    end = document.rindex("</body>")
    return f"{document[:end]}<script>{script}</script>\n{document[end:]}"
