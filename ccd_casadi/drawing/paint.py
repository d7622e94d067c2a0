"""A page's content as HTML: for each of its kinds a macro of `assets/blocks.html`.

A page is one HTML file, and nothing is external. Figures take the colours of the page, which follow
the reader's theme and are light in print.
"""

import base64
import hashlib
import re
from functools import cache
from typing import Any

from jinja2 import Template
from markupsafe import Markup
from markupsafe import escape as escaped

from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.lines import panel_html
from ccd_casadi.drawing.maps import figure_landscape
from ccd_casadi.drawing.numbers import tables_of
from ccd_casadi.drawing.svg import SUPERSCRIPT, THEME
from ccd_casadi.drawing.turntable import data, legend, still
from ccd_casadi.support.package_text import package_text, printable, template
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.units import number

POLICY = "default-src 'none'; style-src 'unsafe-inline'"  # no request, no script but ours
# Our scripts, in assets/, and what in a body needs them; some bring their style.
SCRIPTS = {"cursor": " data-axes=", "zoom": " data-axes=", "steps": '<div class="steps">',
           "turntable": 'class="turntable"'}  # fmt: skip
STYLED = ("steps", "turntable")


def theme(which: int) -> str:
    """The colours of figures as variables of CSS: 0 light, 1 dark."""
    return "; ".join(f"--{name}: {colours[which]}" for name, colours in THEME.items())


CSS = (
    f":root {{ {theme(0)} }}\n@media screen and (prefers-color-scheme: dark) {{"
    f" :root {{ {theme(1)} }} }}\n{package_text('drawing/assets/page.css')}"
)


def escape(text: object) -> str:
    """Text for HTML, quotes included; control characters show as a replacement sign."""
    return str(escaped(printable(str(text))))


def typeset(text: str) -> str:
    """Words that a terminal shows in ASCII, with the signs that are meant; units keep their number.

    >>> typeset("less than +-2 %, norm <= 3, 41 um").replace("\xa0", "~")
    'less than ±2~%, norm ≤ 3, 41~µm'
    >>> typeset("KKT residual 1.5e-16, at confidence 1 - 1e-6")
    'KKT residual 1.5·10⁻¹⁶, at confidence 1 - 10⁻⁶'
    >>> typeset("KKT residual 0.0e+00")
    'KKT residual 0.0'
    """
    for plain, sign in (("+-", "±"), ("<=", "≤"), (">=", "≥")):
        text = text.replace(plain, sign)
    text = re.sub(r"(?<=\d) u(?=[ms]\b)", " µ", text)
    text = re.sub(r"\b(\d(?:\.\d+)?)e([+-]?\d+)\b", _power, text)  # and no line ends in it
    return re.sub(r"(?<=\d) (?=(?:%|°|[GMkmµn]?(?:Hz|kg|N|m|s)\b))", "\xa0", text)


def _power(found: re.Match[str]) -> str:
    power = f"10{str(int(found[2])).translate(SUPERSCRIPT)}"
    if not int(found[2]):  # a residual of 0.0e+00
        return found[1]
    return power if found[1] == "1" else f"{found[1]}·{power}"


def page_html(page: c.Page, workers: Pool | None = None) -> str:
    """The whole document; `workers` draw a chapter each.

    Its policy forbids any request; a script that the body needs is allowed by its hash alone.
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
    """One part of a page; `key` is unique in it."""
    made: Any = getattr(_blocks().module, type(block).__name__)
    return Markup(made(block, key))


@cache
def _blocks() -> Template:
    return template(
        "drawing/assets/blocks.html", painted=block_html, panel=panel_html, number=number,
        landscape=figure_landscape, typeset=typeset, tables_of=tables_of, still=still, data=data,
        scale=legend,
    )  # fmt: skip
