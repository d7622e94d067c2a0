"""One self-contained HTML page: text, tables and inline figures; no script, nothing external.

By hand, not by templates: six shapes of plain text, each escaped in the one function that makes it.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape as _escape
from typing import Any

CSS = """
:root { color-scheme: light; --ink: #1a1a1a; --soft: #5a5a5a; --line: #dcdcdc; }
* { box-sizing: border-box; }
html { background: #fff; }
body { max-width: 1000px; margin: 0 auto; padding: 28px 24px 64px; color: var(--ink);
  font: 15px/1.5 "Segoe UI", "Helvetica Neue", Helvetica, Arial, "DejaVu Sans", sans-serif; }
h1 { font-size: 26px; line-height: 1.25; margin: 0 0 8px; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 40px 0 10px; padding-top: 12px; border-top: 1px solid var(--line); }
h3 { font-size: 15px; margin: 22px 0 6px; }
p { margin: 8px 0; }
.meta { color: var(--soft); font-size: 13px; margin: 0 0 12px; overflow-wrap: anywhere; }
.badge { display: inline-block; padding: 1px 10px; border-radius: 11px; font-size: 14px;
  font-weight: 600; border: 1px solid; }
.good { color: #00543d; background: #e3f4ee; border-color: #7cc5ad; }
.bad { color: #8a3300; background: #fdeee2; border-color: #e0a178; }
.lead { font-size: 17px; line-height: 1.5; margin: 12px 0 0; }
figure { margin: 14px 0 22px; }
svg { display: block; height: auto; }
svg * { stroke-linejoin: round; stroke-linecap: butt; }
svg text { font-family: "Segoe UI", "Helvetica Neue", Helvetica, Arial, "DejaVu Sans", sans-serif
  !important; fill: var(--ink); }
figcaption { margin-top: 8px; font-size: 14px; color: #333; max-width: 860px; }
table { border-collapse: collapse; font-size: 13.5px; margin: 6px 0; }
th, td { text-align: left; padding: 3px 18px 3px 0; border-bottom: 1px solid #ececec;
  vertical-align: top; overflow-wrap: anywhere; }
th { font-weight: 600; }
thead th { color: var(--soft); border-bottom: 1px solid #bbb; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.wide { width: 100%; }
.wide th:first-child { width: 23%; } .wide td:nth-child(2) { width: 22%; }
.scroll { overflow-x: auto; max-height: 460px; overflow-y: auto; }
details { margin: 6px 0 0; font-size: 13.5px; }
summary { cursor: pointer; color: #005a8c; }
pre { background: #f6f6f6; padding: 12px 14px; overflow-x: auto; font: 12.5px/1.45 ui-monospace,
  Menlo, Consolas, "DejaVu Sans Mono", monospace; white-space: pre-wrap; overflow-wrap: anywhere; }
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
  th, td { padding-top: 2px; padding-bottom: 2px; }
  ul { margin: 4pt 0; } pre { font-size: 7.5pt; columns: 2; }
  .scroll { max-height: none; overflow: visible; }
  details:not([open]) { display: none; }
  .badge { -webkit-print-color-adjust: exact; print-color-adjust: exact; }
}
"""


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
    kind = f' class="{css}"' if css else ""
    return f"<table{kind}><thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody></table>"


def facts_html(rows: Iterable[tuple[str, str, str]]) -> str:
    """Quantity, value and remark in three columns; plain texts in."""
    body = "\n".join(
        f'<tr><th scope="row">{escape(a)}</th><td>{escape(b)}</td><td>{escape(c)}</td></tr>'
        for a, b, c in rows
    )
    return f'<table class="wide"><tbody>{body}</tbody></table>'


def figure_html(svg: str, caption: str, table: Table, *more: Table) -> str:
    """A figure with its caption (plain text) and the numbers behind it, folded away."""
    tables = "\n".join(table_html(item) for item in (table, *more))
    return (
        f"<figure>\n{svg}\n<figcaption>{escape(caption)}</figcaption>\n"
        f'<details><summary>Data of this figure</summary><div class="scroll">\n{tables}\n'
        "</div></details>\n</figure>"
    )


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{escape(text)}</p>"


def preformatted(text: str) -> str:
    """Text as it is, in a box."""
    return f"<pre>{escape(text)}</pre>"


def header(title: str, good: bool, status: str, reason: str, meta: str, lead: str) -> str:
    """Title, status badge with its reason, a line of circumstances, and the conclusion."""
    kind, sign = ("good", "✓") if good else ("bad", "✕")
    badge = f'<span class="badge {kind}">{sign} {escape(status)}</span>'
    return (
        f"<h1>{escape(title)}</h1>\n<p>{badge} {escape(reason)}</p>\n"
        f'<p class="meta">{escape(meta)}</p>\n<p class="lead">{escape(lead)}</p>'
    )


def page(title: str, sections: Sequence[Section], head: str = "") -> str:
    """The whole document; `head` is HTML above the sections. The policy forbids any request."""
    body = "\n".join(
        ('<section class="own-page">' if section.own_page else "<section>")
        + f"\n<h2>{escape(section.heading)}</h2>\n{section.body}\n</section>"
        for section in sections
    )
    policy = "default-src 'none'; style-src 'unsafe-inline'"
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        f"<header>{head}</header>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )
