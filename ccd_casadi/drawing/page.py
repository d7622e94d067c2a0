"""The style of a page and its words; a page is one HTML file, and nothing is external.

Figures take the colours of the page, which follow the reader's theme and are light in print.
"""

import re

import markupsafe

from ccd_casadi.drawing.svg import SUPERSCRIPT, THEME
from ccd_casadi.support.package_text import package_text, printable


def theme(which: int) -> str:
    """The colours of figures as variables of CSS: 0 light, 1 dark."""
    return "; ".join(f"--{name}: {colours[which]}" for name, colours in THEME.items())


CSS = (
    f":root {{ {theme(0)} }}\n@media screen and (prefers-color-scheme: dark) {{"
    f" :root {{ {theme(1)} }} }}\n{package_text('drawing/assets/page.css')}"
)


def escape(text: object) -> str:
    """Text for HTML, quotes included; control characters show as a replacement sign."""
    return str(markupsafe.escape(printable(str(text))))


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
