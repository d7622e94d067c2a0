"""One self-contained HTML page: text, tables and inline figures; nothing external.

Figures take the colours of the page, which follow the reader's theme and are light in print.
"""

import base64
import hashlib
import re
from html import escape as _escape
from typing import Any

from ccd_casadi.drawing.content import Table
from ccd_casadi.drawing.svg import SUPERSCRIPT, THEME
from ccd_casadi.support.package_text import filled, package_text
from ccd_casadi.support.units import number

POLICY = "default-src 'none'; style-src 'unsafe-inline'"  # no request, no script but ours
# Our scripts, in assets/, and what in a body needs them; some bring their style.
SCRIPTS = {"cursor": " data-axes=", "zoom": " data-axes=", "steps": '<div class="steps">',
           "turntable": 'class="turntable"'}  # fmt: skip
STYLED = ("steps", "turntable")
MANY = 8  # columns of a table that is set smaller in print


def theme(which: int) -> str:
    """The colours of figures as variables of CSS: 0 light, 1 dark."""
    return "; ".join(f"--{name}: {colours[which]}" for name, colours in THEME.items())


CSS = (
    f":root {{ {theme(0)} }}\n@media screen and (prefers-color-scheme: dark) {{"
    f" :root {{ {theme(1)} }} }}\n{package_text('drawing/assets/page.css')}"
)


def escape(text: object) -> str:
    """Text for HTML, quotes included; control characters show as a replacement sign."""
    kept = "".join(c if c.isprintable() or c in "\n\t\xa0" else "\ufffd" for c in str(text))
    return _escape(kept)


def typeset(text: str) -> str:
    """Words that a terminal shows in ASCII, with the signs that are meant; units keep their number.

    >>> typeset("less than +-2 %, norm <= 3, 41 um").replace("\xa0", "~")
    'less than ±2~%, norm ≤ 3, 41~µm'
    >>> typeset("KKT residual 1.5e-16, at confidence 1 - 1e-6")
    'KKT residual 1.5·10⁻¹⁶, at confidence 1 - 10⁻⁶'
    """
    for plain, sign in (("+-", "±"), ("<=", "≤"), (">=", "≥")):
        text = text.replace(plain, sign)
    text = re.sub(r"(?<=\d) u(?=[ms]\b)", " µ", text)
    text = re.sub(r"\b(\d(?:\.\d+)?)e([+-]?\d+)\b", _power, text)  # and no line ends in it
    return re.sub(r"(?<=\d) (?=(?:%|°|[GMkmµn]?(?:Hz|kg|N|m|s)\b))", "\xa0", text)


def _power(found: re.Match[str]) -> str:
    power = f"10{str(int(found[2])).translate(SUPERSCRIPT)}"
    return power if found[1] == "1" else f"{found[1]}·{power}"


def table_html(table: Table) -> str:
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
    kind = ' class="many"' if len(table.head) > MANY else ""
    made = f"<table{kind}><thead><tr>{head}</tr></thead>\n<tbody>{rows}</tbody></table>"
    return f'<div class="table">{made}</div>'


def document(title: str, head: str, body: str) -> str:
    """The whole document of HTML's `head` (no element of that name) and `body`.

    The policy forbids any request; a script that the body needs is allowed by its hash alone.
    """
    own = [name for name, mark in SCRIPTS.items() if mark in body]
    scripts = [package_text(f"drawing/assets/{name}.js") for name in own]
    css = CSS + "".join(package_text(f"drawing/assets/{n}.css") for n in own if n in STYLED)
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts)
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes)
    policy = f"{POLICY}; script-src {allowed}" if own else POLICY
    scripted = "".join(f"<script>{text}</script>\n" for text in scripts)
    return filled("drawing/assets/page.html", policy=policy, title=escape(title), css=css,
                  head=head, body=body, scripts=scripted)  # fmt: skip
