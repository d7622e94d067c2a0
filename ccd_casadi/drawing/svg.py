"""What all figures share: style, colours, SVG text, and what a plant may show of itself."""

import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from html import escape
from io import StringIO
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import number, package_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class ModeShape:
    """A mode on a surface.

    Attributes
    ----------
    displacement : array (n, 3)
        Of the surface's points, 1/√kg.
    frequency : float
        Hz.
    numbers : tuple of int
        Its places among the flexible modes, from 1; two for a pair of equal frequency.
    words : str
        Its name, if it has one.
    more : mapping
        Further figures by their names.
    """

    displacement: Array
    frequency: float
    numbers: tuple[int, ...]
    words: str = ""
    more: Mapping[str, float] = field(default_factory=dict)

    @property
    def places(self) -> str:
        """The numbers in words: `4 and 5`."""
        return " and ".join(map(str, self.numbers))

    @property
    def title(self) -> str:
        """`4 and 5: bent tilt, a pair, 950.6 Hz`."""
        pair = ", a pair" if len(self.numbers) > 1 else ""
        words = f": {self.words}" if self.words else ""
        return f"{self.places}{words}{pair}, {number(self.frequency, 4)} Hz"


@dataclass(frozen=True, eq=False)
class ModeShapes:
    """Modes of a surface, lowest first.

    Attributes
    ----------
    points : array (n, 3)
        m.
    faces : int array (q, 4)
        Numbers of points, counter-clockwise from outside; a triangle names its last corner twice.
    modes : tuple of ModeShape
    view : str
        From where pictures see it.
    """

    points: Array
    faces: np.ndarray
    modes: tuple[ModeShape, ...]
    view: str = ""


def outer_faces(faces: np.ndarray) -> np.ndarray:
    """Find the surface of a mesh: faces that only one element has.

    Parameters
    ----------
    faces : int array (f, k)
        Of all elements.

    Returns
    -------
    int array (q, k)
    """
    _, first, times = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    return faces[first[times == 1]]


# After Okabe and Ito, distinct to the colour-blind and by a grey printer; each has a contrast of
# at least 3.4 : 1 to white paper, which their pink, yellow and sky have not.
BLUE, ORANGE, GREEN = "#0072b2", "#d55e00", "#009e73"
PURPLE, AMBER, BROWN = "#b8548c", "#a87000", "#8c564b"
BLACK, GREY = "#1a1a1a", "#767676"
CYCLE = (BLUE, ORANGE, GREEN, PURPLE, AMBER, BROWN, BLACK)
# Colours of a figure -> the page's variable (`paint.CSS`) that it becomes: (light, dark).
THEME = {
    "blue": (BLUE, "#5ab4ee"), "orange": (ORANGE, "#ff8f45"), "green": (GREEN, "#2fc79a"),
    "purple": (PURPLE, "#e59cc6"), "amber": (AMBER, "#e6b23c"), "brown": (BROWN, "#c9a093"),
    "ink": (BLACK, "#e4e6e8"), "grey": (GREY, "#9aa0a5"), "paper": ("#ffffff", "#15191c"),
    "grid": ("#e6e6e6", "#2c3338"), "axis": ("#444444", "#aab0b5"), "shade": ("#eeeeee", "#22282c"),
}  # fmt: skip
VARIABLES = {light: f"var(--{name})" for name, (light, _) in THEME.items()}
VARIABLES["#000000"] = "var(--ink)"
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
COLOUR_MAP = "viridis"
WIDTH = 10.0  # inches; a page column of about 950 px shows 10 pt text as 13 px
NARROW = 4.6  # inches of the same figure on a screen of a telephone
LONGEST_LABEL = 40
SHAPES = {"svg", "g", "path", "rect", "circle", "line", "polyline", "polygon", "text", "tspan"}


@contextmanager
def style() -> Iterator[None]:
    """Draw in our style within the block, and in the caller's again after it.

    Yields
    ------
    None

    Returns
    -------
    context manager
    """
    import matplotlib

    with matplotlib.rc_context(_sheet()), warnings.catch_warnings():
        # A letter that DejaVu lacks is only measured with it; the browser draws it.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        yield


@cache
def _sheet() -> Any:
    """Our style, read once."""
    import matplotlib

    sheet = package_path("drawing/assets/figures.mplstyle")
    return matplotlib.rc_params_from_file(sheet, use_default_template=False)


def new_figure(height: float, width: float = WIDTH) -> "Figure":
    """Make an empty figure.

    Parameters
    ----------
    height, width : float
        Inches.

    Returns
    -------
    Figure
    """
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def at_both_widths(draw: Callable[[str, float], str], key: str, width: float) -> str:
    """A figure of a whole column as drawn at this width, and beside it for a narrow screen.

    `draw(key, inches)`; the page's rules show one of both.
    """
    wide, narrow = draw(key, width), draw(f"{key}-n", NARROW)
    return f'<div class="whole">{wide}</div><div class="narrow">{narrow}</div>'


def place(figure: "Figure", left: float, bottom: float, width: float, height: float) -> "Axes":
    """Add axes with fixed margins, which cost a tenth of arranging them to the text.

    Parameters
    ----------
    figure : Figure
    left, bottom, width, height : float
        Inches.

    Returns
    -------
    Axes
    """
    w, h = figure.get_size_inches()
    return figure.add_axes((left / w, bottom / h, width / w, height / h))


def to_svg(figure: "Figure", key: str, title: str, data: str, share: float) -> str:
    """The figure as an <svg> element for inline use; `key` is unique in the page, `title` read out.

    Colours become the page's variables, so that they follow its theme. Namespaces, metadata and
    global style rules are dropped: HTML needs none of them. `data`: for the page's script; `share`
    of the column, in %, so that text has one size in all figures.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    FigureCanvasSVG(figure)
    buffer = StringIO()
    with matplotlib.rc_context({"svg.hashsalt": key}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    dropped = r"<metadata>.*?</metadata>\s*|<style[^>]*>.*?</style>|<!--.*?-->\s*"
    text = re.sub(dropped, "", text, flags=re.DOTALL)
    text = text.replace("xlink:href=", "href=")
    text = re.sub(r'\bid="', f'id="{key}-', text)
    text = re.sub(r'href="#', f'href="#{key}-', text)
    text = text.replace("url(#", f"url(#{key}-")
    # the font is the page's: only size, weight and anchor stay
    text = re.sub(r"font: ([^;\"]*?)'[^;\"]*", r"font: \1sans-serif", text)
    text = re.sub(r"(?<=: )#[0-9a-f]{6}\b", lambda c: VARIABLES.get(c[0], c[0]), text)
    box = re.search(r'viewBox="([^"]*)"', text)
    assert box is not None
    size = f'style="width: {share:.0f}%"'
    named = f'role="img" aria-label="{escape(title)}" data-axes="{escape(data)}"'
    head = f'<svg viewBox="{box[1]}" {size} {named}>'
    body = text[text.index(">") + 1 :]
    return re.sub(r"\n\s*", "\n", head + body).strip()


def require_shapes(svg: str) -> None:
    """Raise ValueError where an <svg> element is none, or holds more than shapes and words."""
    if "<!" in svg:
        raise ValueError("a picture declares what is no shape")
    try:
        parts = list(ElementTree.fromstring(svg).iter())
    except ElementTree.ParseError as error:
        raise ValueError(f"a picture is no SVG: {error}") from None
    for part in parts:
        wrong = [key for key in part.attrib if key.startswith("on") or "href" in key]
        if part.tag not in SHAPES or wrong or any("url(" in v for v in part.attrib.values()):
            raise ValueError(f"a picture holds <{part.tag} {' '.join(wrong)}>, which is no shape")


def axis_label(name: str, unit: str) -> str:
    """Write `name (unit)` on one line, not longer than an axis; no unit shows as a dash.

    Parameters
    ----------
    name, unit : str

    Returns
    -------
    str
    """
    return f"{short_label(name)} ({short_label(unit) or '–'})"


def short_label(text: str) -> str:
    """Shorten a name to one line that is not longer than an axis.

    Parameters
    ----------
    text : str

    Returns
    -------
    str
    """
    words = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return words if len(words) <= LONGEST_LABEL else words[: LONGEST_LABEL - 1] + "…"


def log_axis(axis: Any, low: float, high: float) -> None:
    """Make an axis logarithmic, its labels plain text.

    Parameters
    ----------
    axis : Axis
        `axes.xaxis` or `axes.yaxis`.
    low, high : float
        Its ends, above 0.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    name = axis.axis_name
    getattr(axis.axes, f"set_{name}scale")("log")
    getattr(axis.axes, f"set_{name}lim")(low, high)
    decades = np.log10(high / low)
    subs = (1.0,) if decades > 2.2 else (1.0, 2.0, 5.0)
    axis.set_major_locator(LogLocator(subs=subs, numticks=max(3, int(min(decades, 8.0)) + 2)))
    plain = low > 0.0009 and high < 20000.0  # one way of writing on one axis
    axis.set_major_formatter(FuncFormatter(lambda value, _: power_of_ten(value, plain)))
    axis.set_minor_locator(NullLocator())
    if decades <= 5.0:
        _minor_ticks(axis, low, high)


def _minor_ticks(axis: Any, low: float, high: float) -> None:
    """All as markers of one line: as matplotlib's own, five objects each, they cost most of all."""
    from matplotlib.lines import Line2D
    from matplotlib.markers import TICKDOWN, TICKLEFT
    from matplotlib.ticker import LogLocator

    values = np.asarray(LogLocator(subs="auto", numticks=12).tick_values(low, high))
    values = values[(values > low) & (values < high)]
    edge = np.zeros_like(values)
    horizontal = axis.axis_name == "x"
    axes = axis.axes
    marker: Any = TICKDOWN if horizontal else TICKLEFT
    line = Line2D(
        values if horizontal else edge, edge if horizontal else values, linestyle="none",
        marker=marker, markersize=2.0, markeredgewidth=0.4, gid=f"ticks-{axis.axis_name}",
        markeredgecolor="#000000", clip_on=False, zorder=2.01,
        transform=axes.get_xaxis_transform() if horizontal else axes.get_yaxis_transform(),
    )  # fmt: skip
    axes.add_artist(line)


def power_of_ten(value: float, plain: bool = False) -> str:
    """Tick label of a logarithmic axis: a power of ten, or the number as it is.

    >>> power_of_ten(100.0, plain=True), power_of_ten(1.0), power_of_ten(1e-7), power_of_ten(5e6)
    ('100', '1', '10⁻⁷', '5·10⁶')
    """
    if value <= 0.0:
        return ""
    if plain or abs(value - 1.0) < 1e-6:
        return f"{value:g}"
    exponent = int(np.floor(np.log10(value) + 1e-9))
    lead = value / 10.0**exponent
    digits = str(exponent).translate(SUPERSCRIPT)
    return f"10{digits}" if abs(lead - 1.0) < 1e-6 else f"{lead:g}·10{digits}"
