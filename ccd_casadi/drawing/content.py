"""What a page shows, as plain data: texts, tables, and figures with every point of their curves.

`reporting` makes it; `paint` stores it in `report.json`, reads it back and draws it as
HTML and SVG. Names of classes and fields are keys of that file.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ccd_casadi.drawing.svg import BLACK, BLUE, GREY, ORANGE, ModeShapes, require_shapes
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.json_files import json_values

Fact = tuple[str, str, str]  # quantity, value, remark
INDEX = "index.html"  # of a run's folder
LEAST_POINTS = 8  # a curve with fewer is a drawn shape, off which no values are read


@dataclass(frozen=True)
class Curve:
    """A polyline or points (x_k, y_k).

    Attributes
    ----------
    x, y : arrays (k,)
        In the units of the panel's labels.
    label, colour : str
    line, marker : str
        Styles of matplotlib, either may be empty.
    width : float
        Of the line, pt.
    hz : array (k,), optional
        Frequency of each point in Hz: the curve is a locus with ω as its parameter (Nyquist).
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
        """Whether it is a function y(x), of which the page shows values under the cursor and in a
        table: a line of enough points with x not decreasing."""
        function = len(self.x) >= LEAST_POINTS and bool((np.diff(self.x) >= 0.0).all())
        return bool(self.line) and function


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
    """A point with a marker and a text.

    Attributes
    ----------
    x, y : float
    text, marker, colour : str
        Text and marker (a style of matplotlib) may be empty.
    offset : tuple of float
        From the point to the text, pt to the right and up.
    """

    x: float
    y: float
    text: str = ""
    marker: str = "o"
    colour: str = BLACK
    offset: tuple[float, float] = (0.0, 7.0)


@dataclass(frozen=True)
class Level:
    """A dashed line across the panel, with a text at its end.

    Attributes
    ----------
    value : float
        y of a horizontal line, x of a vertical one.
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
    """A shaded polygon, which no curve may enter.

    Attributes
    ----------
    x, y : arrays (k,)
        Its vertices.
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
    curves, bands, marks, levels : tuples of Curve, Band, Mark, Level
    forbidden : tuple of Area
    log_x, log_y : bool
    x_range, y_range : tuple of float, optional
        By default those of the data.
    y_step : float, optional
        Between ticks of y.
    legend : "best" or None
        "best": in the corner that covers least. None: no legend.
    title : str
    equal : bool
        A unit is of the same length on both axes.
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
    """Column heads and rows of texts and numbers; a page rounds numbers and aligns them right.

    A number that is not finite is stored as None (JSON has no NaN) and shown as a dash.

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
        """Whether each column has numbers alone."""
        columns = range(len(self.head))
        return [all(not isinstance(row[i], str) for row in self.rows) for i in columns]

    @staticmethod
    def of(head: Sequence[str], *columns: Iterable[Any]) -> "Table":
        """Make a table from its columns, of equal length."""
        return Table(tuple(head), tuple(zip(*columns, strict=True)))


@dataclass(frozen=True)
class Picture:
    """An <svg> element that a plant's own function has drawn.

    Attributes
    ----------
    svg : str

    Raises
    ------
    ValueError
        It has elements other than shapes and text. The page includes it unchanged, and a
        report.json may come from somebody else, so scripts and links are refused.
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
        Whether the page lets the reader turn the picture and shows a scale; else it is small and
        fixed.
    """

    shapes: ModeShapes
    turning: bool = False


Place = Panel | Picture | Modes | Table | None  # a cell of a figure's grid; None leaves it empty


@dataclass(frozen=True)
class Lines:
    """A figure of panels in rows.

    Attributes
    ----------
    rows : tuple of tuples of Place
    title : str
        What a screen reader reads instead of the figure.
    heights : tuple of float
        Of the rows, inches; 2.9 where there is none.
    """

    rows: tuple[tuple[Place, ...], ...]
    title: str
    heights: tuple[float, ...] = ()


@dataclass(frozen=True)
class ThetaPath:
    """The iterates of a method over two parameters, `theta` (k, 2), SI; the next colour of the
    cycle where `colour` is empty."""

    label: str
    theta: Array
    colour: str = ""


@dataclass(frozen=True)
class Landscape:
    """The surrogate of ω_b*(θ) on a grid (n₁, n₂) of two parameters, with true samples on it.

    Attributes
    ----------
    names, units : tuples of str
        Of the two parameters.
    first, second : arrays (n₁,), (n₂,)
        Grids of θ₁ and θ₂, SI.
    bandwidth_hz : array (n₁, n₂)
        Predicted ω_b*/2π, Hz. NaN: infeasible; empty where there is no surrogate.
    truths : array (k, 3)
        Rows (θ₁, θ₂, ω_b*/2π in Hz) of solved inner problems.
    designs : array (d, 2)
        Rows (θ₁, θ₂) of single designs at a θ whose ω_b* is not known.
    truth_label : str
    forbidden : bool array (n₁, n₂), optional
        Where a constraint is violated, λ(θ) > 0.
    region : tuple of float, optional
        Trust region (low₁, high₁, low₂, high₂).
    paths : tuple of ThetaPath
    optimum : tuple of float, optional
        (θ₁, θ₂) of the verified design.
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
        """(n₁, n₂) bool: points outside the trust region, where the surrogate was not fitted."""
        if self.region is None or not self.bandwidth_hz.size:
            return np.zeros(self.bandwidth_hz.shape, dtype=bool)
        low_1, high_1, low_2, high_2 = self.region
        inside_1 = (self.first >= low_1) & (self.first <= high_1)
        inside_2 = (self.second >= low_2) & (self.second <= high_2)
        return ~(inside_1[:, None] & inside_2[None, :])


Drawing = Lines | Landscape | Modes | Picture


@dataclass(frozen=True)
class Figure:
    """A figure with its caption.

    Attributes
    ----------
    drawing : Lines, Landscape, Modes or Picture
    caption : str
    tables : tuple of Table
        Its numbers, in a part of the page that is closed at first; by default those of its curves.
    """

    drawing: Drawing
    caption: str
    tables: tuple[Table, ...] = ()


@dataclass(frozen=True)
class Words:
    """A paragraph of a page.

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
    """Links to pages in the same folder.

    Attributes
    ----------
    items : tuple of (address, title, description)
    """

    items: tuple[tuple[str, str, str], ...]


@dataclass(frozen=True)
class Source:
    """Preformatted text, such as code, in a box."""

    text: str


@dataclass(frozen=True)
class Facts:
    """A list in three columns: quantity, value and remark.

    Attributes
    ----------
    rows : tuple of Fact
    """

    rows: tuple[Fact, ...]


@dataclass(frozen=True)
class Steps:
    """Figures of which a slider shows one at a time."""

    steps: tuple[tuple[str, Lines], ...]
    first: int  # index of the one that is shown at first
    label: str  # of the slider


@dataclass(frozen=True)
class VerdictRow:
    """A line of a run's verdict.

    Attributes
    ----------
    name : str
        What was checked, as in docs/verdict.md: certified, optimal, ...
    state : str
        `passed`, `warned`, `failed` or `unknown`.
    words : str
        The result in a sentence.
    details : tuple of str
        What else is known, folded on a page.
    """

    name: str
    state: str
    words: str
    details: tuple[str, ...] = ()


@dataclass(frozen=True)
class Bars:
    """A table whose rows end in a bar, the longest first."""

    head: tuple[str, ...]  # names of the columns; the bar's is the last
    rows: tuple[tuple[Any, ...], ...]  # values, without the bar
    lengths: tuple[float, ...]  # of the bars; negative ones have another colour

    @property
    def table(self) -> Table:
        """The same table without the bars."""
        return Table(self.head[:-1], self.rows)

    @property
    def shares(self) -> tuple[float, ...]:
        """The lengths in percent of the longest bar."""
        most = max(map(abs, self.lengths), default=0.0) or 1.0
        return tuple(100.0 * length / most for length in self.lengths)


@dataclass(frozen=True)
class FoldedBlocks:
    """Blocks behind a line that opens them; printed pages show them."""

    summary: str
    body: tuple[Words | Bullets | Facts | Table | Source, ...]  # of facts, tables and words


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
        "good", "warn" or "bad": colour of the status.
    status, reason : str
        Status of the run, and why it is not verified.
    meta : str
        How it was computed: case, formulation, time.
    lead : str
        The conclusion.
    verdict : tuple of VerdictRow
    decision : str
        What to do next, in a sentence or two.
    also : tuple of str
        What the decision leaves out, a sentence each.
    own_decision : bool
        Whether it answers another question than whether to build the run's design.
    folded : bool
        The page is about something else than the verdict: a count of its lines opens them.
    """

    title: str
    badge: str
    status: str
    reason: str
    meta: str
    lead: str
    verdict: tuple[VerdictRow, ...] = ()
    decision: str = ""
    also: tuple[str, ...] = ()
    own_decision: bool = False
    folded: bool = False

    @property
    def counted(self) -> str:
        """The lines of the verdict by their states."""
        states = Counter(line.state for line in self.verdict)
        return ", ".join(f"{count} {state}" for state, count in states.items())


Text = Words | Heading | Bullets | Links | Source | Facts | Verdict
Block = Text | Table | Bars | Figure | Picture | Steps | FoldedBlocks


@dataclass(frozen=True)
class Chapter:
    """A heading and the blocks below it.

    Attributes
    ----------
    heading : str
    body : tuple of Block
    own_page : bool
        It starts a page in print.
    folded : bool
        Its heading opens it; printed pages show it.
    """

    heading: str
    body: tuple[Block, ...]
    own_page: bool = False
    folded: bool = False


@dataclass(frozen=True)
class Page:
    """A whole page: its head and chapters.

    Attributes
    ----------
    head : Head
    chapters : tuple of Chapter
    index : str
        Address of the page that links to all pages of the run; empty where there is none.
    """

    head: Head
    chapters: tuple[Chapter, ...]
    index: str = INDEX
