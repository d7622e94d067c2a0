"""What a page shows, as plain data: words, tables, and figures down to every point of a curve.

Made where the figures are known, kept in `report.json` (`stored`) and painted by `paint`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ccd_casadi.drawing.svg import BLACK, BLUE, GREY, ORANGE, ModeShapes, require_shapes
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.json_files import json_values

Fact = tuple[str, str, str]  # quantity, value, remark
INDEX = "index.html"  # of a run's folder
LEAST_POINTS = 8  # of a curve that values are read off


@dataclass(frozen=True)
class Curve:
    """y over x.

    Attributes
    ----------
    x, y : arrays (k,)
        In the units of the panel's labels.
    label, colour : str
    line, marker : str
        As in matplotlib, either may be empty.
    width : float
        pt.
    hz : array (k,), optional
        Frequencies in Hz of the points, where the curve is a locus and not y of x.
    """

    x: Array
    y: Array
    label: str = ""
    colour: str = BLUE
    line: str = "-"
    marker: str = ""
    width: float = 1.3
    hz: Array | None = None

    @property
    def readable(self) -> bool:
        """Whether values are read off it: a line of several points, from left to right."""
        rising = len(self.x) >= LEAST_POINTS and bool((np.diff(self.x) >= 0.0).all())
        return bool(self.line) and rising


@dataclass(frozen=True)
class Band:
    """The area between low and high over x.

    Attributes
    ----------
    x, low, high : arrays (k,)
    label, colour : str
    """

    x: Array
    low: Array
    high: Array
    label: str = ""
    colour: str = BLUE


@dataclass(frozen=True)
class Mark:
    """A marked point and its words.

    Attributes
    ----------
    x, y : float
    text, marker, colour : str
    offset : tuple of float
        Of the words, pt.
    """

    x: float
    y: float
    text: str = ""
    marker: str = "o"
    colour: str = BLACK
    offset: tuple[float, float] = (0.0, 7.0)


@dataclass(frozen=True)
class Level:
    """A thin line across the panel, with its words at the end.

    Attributes
    ----------
    value : float
    text : str
    vertical : bool
    colour : str
    """

    value: float
    text: str
    vertical: bool = False
    colour: str = GREY


@dataclass(frozen=True)
class Area:
    """A shaded area, where a curve may not be.

    Attributes
    ----------
    x, y : arrays (k,)
        Its corners.
    colour : str
    """

    x: Array
    y: Array
    colour: str = ORANGE


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Attributes
    ----------
    x_label, y_label : str
        With units.
    curves, bands, marks, levels, forbidden : tuples
        Of Curve, Band, Mark, Level, Area.
    log_x, log_y : bool
    x_range, y_range : tuple of float, optional
        By default those of the data.
    y_step : float, optional
        Between ticks.
    legend : "best" or None
    title : str
    equal : bool
        Both axes have one scale.
    """

    x_label: str
    y_label: str
    curves: tuple[Curve, ...] = ()
    bands: tuple[Band, ...] = ()
    marks: tuple[Mark, ...] = ()
    levels: tuple[Level, ...] = ()
    log_x: bool = False
    log_y: bool = False
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    y_step: float | None = None
    legend: Literal["best"] | None = "best"
    title: str = ""
    forbidden: tuple[Area, ...] = ()
    equal: bool = False


@dataclass(frozen=True)
class Table:
    """Column heads and rows of texts or numbers; numbers are rounded and set to the right.

    A number that is not finite is None, and shows as a dash.

    Attributes
    ----------
    head : tuple of str
    rows : tuple of tuples
    """

    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]

    def __post_init__(self) -> None:
        rows = tuple(tuple(json_values(row)) for row in self.rows)
        object.__setattr__(self, "rows", rows)

    @property
    def numeric(self) -> list[bool]:
        """Which columns hold no text."""
        columns = range(len(self.head))
        return [all(not isinstance(row[i], str) for row in self.rows) for i in columns]

    @staticmethod
    def of(head: Sequence[str], *columns: Iterable[Any]) -> "Table":
        """From columns of equal length."""
        return Table(tuple(head), tuple(zip(*columns, strict=True)))


@dataclass(frozen=True)
class Picture:
    """An <svg> element that a plant or a machine has drawn.

    Attributes
    ----------
    svg : str

    Raises
    ------
    ValueError
        It holds more than shapes and words: it goes into a page unchanged, and a report.json may
        come from a stranger.
    """

    svg: str

    def __post_init__(self) -> None:
        require_shapes(self.svg)


@dataclass(frozen=True, eq=False)
class Modes:
    """Mode shapes on a plant's surface.

    Attributes
    ----------
    shapes : ModeShapes
    turning : bool
        To be turned, with a scale; else small and fixed.
    """

    shapes: ModeShapes
    turning: bool = False


Place = Panel | Picture | Modes | Table | None  # None: an empty one


@dataclass(frozen=True)
class Lines:
    """Rows of panels.

    Attributes
    ----------
    rows : tuple of tuples of Place
    title : str
        Read out in place of the figure.
    heights : tuple of float
        Of the rows in inches, 2.9 by default.
    """

    rows: tuple[tuple[Place, ...], ...]
    title: str
    heights: tuple[float, ...] = ()


@dataclass(frozen=True)
class ThetaPath:
    """A method's way over θ, rows (θ₁, θ₂), in a colour of its own or the next one."""

    label: str
    theta: Array
    colour: str = ""


@dataclass(frozen=True)
class Landscape:
    """ω_b*(θ) on a grid of two parameters, and what is known of it.

    Attributes
    ----------
    names, units : tuples of str
        Of the parameters.
    first, second : arrays
        Their grids, SI.
    bandwidth_hz : array (len(first), len(second))
        NaN: infeasible; empty where there is no surrogate.
    truths : array (k, 3)
        Rows (θ₁, θ₂, Hz).
    designs : array (k, 2)
        Rows (θ₁, θ₂).
    truth_label : str
    forbidden : bool array, optional
        Where some λ(θ) > 0.
    region : tuple of float, optional
        Trust region (low₁, high₁, low₂, high₂).
    paths : tuple of ThetaPath
    optimum : tuple of float, optional
        The verified θ.
    """

    names: tuple[str, str]
    units: tuple[str, str]
    first: Array
    second: Array
    bandwidth_hz: Array
    truths: Array
    designs: Array
    truth_label: str = "true ω_b*(θ), same colours"
    forbidden: Array | None = None
    region: tuple[float, float, float, float] | None = None
    paths: tuple[ThetaPath, ...] = ()
    optimum: tuple[float, float] | None = None

    @property
    def outside(self) -> np.ndarray:
        """The grid's points outside the trust region: no surrogate speaks of them."""
        if self.region is None or not self.bandwidth_hz.size:
            return np.zeros(self.bandwidth_hz.shape, dtype=bool)
        a, b, c, d = self.region
        first = (self.first >= a) & (self.first <= b)
        second = (self.second >= c) & (self.second <= d)
        return ~(first[:, None] & second[None, :])


Drawing = Lines | Landscape | Modes | Picture


@dataclass(frozen=True)
class Figure:
    """A figure with its caption.

    Attributes
    ----------
    drawing : Lines, Landscape, Modes or Picture
    caption : str
    tables : tuple of Table
        The numbers behind it, which a page folds away; by default those of its curves.
    """

    drawing: Drawing
    caption: str
    tables: tuple[Table, ...] = ()


@dataclass(frozen=True)
class Words:
    """A paragraph.

    Attributes
    ----------
    text : str
    """

    text: str


@dataclass(frozen=True)
class Heading:
    """The heading of a part of a chapter.

    Attributes
    ----------
    text : str
    """

    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of sentences."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Links:
    """Pages beside this one.

    Attributes
    ----------
    items : tuple of (address, title, words)
    """

    items: tuple[tuple[str, str, str], ...]


@dataclass(frozen=True)
class Source:
    """Text as it is, in a box."""

    text: str


@dataclass(frozen=True)
class Facts:
    """Quantity, value and remark in three columns.

    Attributes
    ----------
    rows : tuple of Fact
    """

    rows: tuple[Fact, ...]


@dataclass(frozen=True)
class Steps:
    """One of several pictures at a time, with its words, chosen by a slider; `first` is shown."""

    steps: tuple[tuple[str, Lines], ...]
    first: int
    label: str


@dataclass(frozen=True)
class VerdictRow:
    """A line of a run's verdict.

    Attributes
    ----------
    name : str
    state : str
        `passed`, `warned`, `failed` or `unknown`.
    words : str
    """

    name: str
    state: str
    words: str


@dataclass(frozen=True)
class Verdict:
    """The lines of a verdict."""

    lines: tuple[VerdictRow, ...]


@dataclass(frozen=True)
class Head:
    """The head of a page.

    Attributes
    ----------
    title : str
    badge : str
        "good", "warn" or "bad".
    status, reason : str
    meta : str
        Circumstances.
    lead : str
        The conclusion.
    verdict : tuple of VerdictRow
    decision : str
        What to do, or the answer, in a sentence or two.
    """

    title: str
    badge: str
    status: str
    reason: str
    meta: str
    lead: str
    verdict: tuple[VerdictRow, ...] = ()
    decision: str = ""


Text = Words | Heading | Bullets | Links | Source | Facts | Verdict
Block = Text | Table | Figure | Picture | Steps


@dataclass(frozen=True)
class Chapter:
    """A heading and the blocks below it.

    Attributes
    ----------
    heading : str
    body : tuple of Block
    own_page : bool
        It starts a page in print.
    """

    heading: str
    body: tuple[Block, ...]
    own_page: bool = False


@dataclass(frozen=True)
class Page:
    """A whole page.

    Attributes
    ----------
    head : Head
    chapters : tuple of Chapter
    index : str
        Address of the page that links all of the run; empty where there is none.
    """

    head: Head
    chapters: tuple[Chapter, ...]
    index: str = INDEX
