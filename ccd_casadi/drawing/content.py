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
    """y over x; `line` and `marker` as in matplotlib, either may be empty.

    hz: of each point, where the curve is a locus over frequency and not y of x.
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
    """The area between low and high over x."""

    x: Array
    low: Array
    high: Array
    label: str = ""
    colour: str = BLUE


@dataclass(frozen=True)
class Mark:
    """A marked point and its words, beside it in points (dx, dy)."""

    x: float
    y: float
    text: str = ""
    marker: str = "o"
    colour: str = BLACK
    offset: tuple[float, float] = (0.0, 7.0)


@dataclass(frozen=True)
class Level:
    """A thin line across the panel at `value`, with its words at the end."""

    value: float
    text: str
    vertical: bool = False
    colour: str = GREY


@dataclass(frozen=True)
class Area:
    """A shaded area with its corners at (x, y): where a curve may not be."""

    x: Array
    y: Array
    colour: str = ORANGE


@dataclass(frozen=True)
class Panel:
    """One pair of axes; `equal`: of one scale. Labels have units; ranges default to the data."""

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
    """An <svg> element that a plant or a machine has drawn of itself.

    Raises ValueError where it holds more than shapes and words: it goes into a page as it is, and a
    report.json may come from a stranger.
    """

    svg: str

    def __post_init__(self) -> None:
        require_shapes(self.svg)


@dataclass(frozen=True, eq=False)
class Modes:
    """Mode shapes on a plant's surface: to be turned, with a scale, or small ones that stand."""

    shapes: ModeShapes
    turning: bool = False


Place = Panel | Picture | Modes | Table | None  # None: an empty one


@dataclass(frozen=True)
class Lines:
    """Rows of panels, read out as `title`; heights in inches, 2.9 by default."""

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
    """ω_b*(θ) in Hz on a grid of two parameters (NaN: infeasible), and what is known of it.

    `bandwidth_hz` (len(first), len(second)), empty where there is no surrogate. `truths` are
    rows (θ₁, θ₂, Hz), `designs` rows (θ₁, θ₂). `forbidden` is where some λ(θ) > 0. `region` is
    a trust region (low₁, high₁, low₂, high₂), `optimum` the verified one.
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
    """A figure with its caption, and the numbers behind it, which a page folds away: by default
    those of its curves (`numbers`)."""

    drawing: Drawing
    caption: str
    tables: tuple[Table, ...] = ()


@dataclass(frozen=True)
class Words:
    """A paragraph."""

    text: str


@dataclass(frozen=True)
class Heading:
    """Of a part of a chapter."""

    text: str


@dataclass(frozen=True)
class Bullets:
    """A list of sentences."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Links:
    """Pages beside this one: address, title, and what is on it."""

    items: tuple[tuple[str, str, str], ...]


@dataclass(frozen=True)
class Source:
    """Text as it is, in a box."""

    text: str


@dataclass(frozen=True)
class Facts:
    """Quantity, value and remark in three columns."""

    rows: tuple[Fact, ...]


@dataclass(frozen=True)
class Steps:
    """One of several pictures at a time, with its words, chosen by a slider; `first` is shown."""

    steps: tuple[tuple[str, Lines], ...]
    first: int
    label: str


@dataclass(frozen=True)
class VerdictLine:
    """A line of a run's verdict: its name, `passed`, `warned`, `failed` or `unknown`, and why."""

    name: str
    state: str
    words: str


@dataclass(frozen=True)
class Verdict:
    """The lines of a verdict."""

    lines: tuple[VerdictLine, ...]


@dataclass(frozen=True)
class Head:
    """Title, status with its reason, a line of circumstances, the conclusion, the verdict.

    `badge`: "good", "warn" or "bad". `decision`: what to do, or the answer, in a sentence or two.
    """

    title: str
    badge: str
    status: str
    reason: str
    meta: str
    lead: str
    verdict: tuple[VerdictLine, ...] = ()
    decision: str = ""


Text = Words | Heading | Bullets | Links | Source | Facts | Verdict
Block = Text | Table | Figure | Picture | Steps


@dataclass(frozen=True)
class Chapter:
    """A heading and what stands under it; `own_page` starts a page in print."""

    heading: str
    body: tuple[Block, ...]
    own_page: bool = False


@dataclass(frozen=True)
class Page:
    """A whole page; `index`: the one that links all of the run, empty where there is none."""

    head: Head
    chapters: tuple[Chapter, ...]
    index: str = INDEX
