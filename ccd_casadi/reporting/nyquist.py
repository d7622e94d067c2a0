"""Bode and Nyquist plots of the loop with its margins drawn in."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ccd_casadi.analysis.loop_channels import LoopChannel
from ccd_casadi.analysis.loop_view import LoopView, phase_deg
from ccd_casadi.drawing.charts import BOTTOM, LEFT, RIGHT, TOP
from ccd_casadi.drawing.content import Area, Curve, Figure, Level, Lines, Mark, Panel
from ccd_casadi.drawing.svg import BLACK, CYCLE, GREEN, GREY, ORANGE, WIDTH
from ccd_casadi.reporting.facts import paragraph
from ccd_casadi.reporting.gain_figures import bandwidth_level, of_plants, over_hz
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, number, spoken

REAL_RANGE = (-3.2, 1.6)  # the part of the real axis that is shown
ARROW_SPACING = 1.2  # length of a locus between two arrows; this and the next two in units of |L|
ARROW_CLEARANCE = 0.3  # least distance of an arrow from the others and from the origin
ARROW_HEAD = 0.13  # length
LARGEST = 30.0  # |L| beyond which a locus is outside the drawing


def nyquist_panel(
    hz: Array, loci: Sequence[np.ndarray], S_max: float, height: float = 3.0,
    names: tuple[str, str] = ("", ""), others: str = GREEN,
) -> Panel:  # fmt: skip
    """Make a Nyquist plot; it is half a page wide.

    Parameters
    ----------
    hz : array (k,)
        Frequencies, Hz.
    loci : sequence of complex arrays (k,)
        L(jω), or eigenvalues of it. The first is the model's: arrows show its direction and
        frequencies.
    S_max : float
        |S| = 1/|1 + L| <= S_max outside the disc of radius 1/S_max about -1, which is shaded.
    height : float
        Inches.
    names : tuple of str
        Of the first locus, and of the others.
    others : str
        Colour of the others.

    Returns
    -------
    Panel
    """
    circle = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 200))
    curves = [
        Curve(L.real, L.imag, names[1] * (i == 1), others, width=1.0, hz=hz) if i
        else Curve(L.real, L.imag, names[0] * (len(loci) > 1), width=1.6, hz=hz)
        for i, L in reversed(list(enumerate(loci)))  # the model's is drawn last, on top
    ]  # fmt: skip
    disk = -1.0 + circle / S_max
    curves.append(Curve(disk.real, disk.imag, colour=ORANGE))
    curves.append(Curve(circle.real, circle.imag, colour=GREY, line=":", width=0.9))
    labels = (Mark(-1.0 - 1.0 / S_max, 0.0, f"S_max {S_max:g}", "", ORANGE, (-8.0, 3.0)),
              Mark(0.5**0.5, 0.5**0.5, "|L| = 1", "", GREY, (8.0, 3.0)))  # fmt: skip
    axes_width, axes_height = 0.5 * WIDTH - LEFT - RIGHT, height - BOTTOM - TOP  # inches
    half = 0.5 * (REAL_RANGE[1] - REAL_RANGE[0]) * axes_height / axes_width  # equal scales
    arrows, marks = _arrows(hz, loci[0], half)
    return Panel(
        "Re L (–)", "Im L (–)", (*curves, *arrows),
        marks=(Mark(-1.0, 0.0, marker="+"), *marks, *labels),
        x_range=REAL_RANGE, y_range=(-half, half),
        forbidden=(Area(disk.real, disk.imag),),
    )  # fmt: skip


def _arrows(hz: Array, locus: np.ndarray, half: float) -> tuple[list[Curve], list[Mark]]:
    """Arrow heads on a locus at equal arc lengths, and points with their frequencies.

    Only the part in the drawing counts, which has |Im L| < half.
    """
    arrows: list[Curve] = []
    marks: list[Mark] = []
    x, y = locus.real, locus.imag
    inside = (x > REAL_RANGE[0]) & (x < REAL_RANGE[1]) & (np.abs(y) < half)  # False for NaN
    steps = np.where(inside[1:] & inside[:-1], np.abs(np.diff(locus)), 0.0)
    arc_length = np.append(0.0, np.cumsum(steps))
    for length in np.arange(0.4 * ARROW_SPACING, arc_length[-1], ARROW_SPACING):
        i = int(np.searchsorted(arc_length, length))
        tip, direction = locus[i], (locus[i] - locus[i - 1]) / abs(locus[i] - locus[i - 1])
        others = (0.0, *(complex(mark.x, mark.y) for mark in marks))
        if all(abs(tip - other) > ARROW_CLEARANCE for other in others):
            back = tip - ARROW_HEAD * direction * np.exp(np.array([0.4j, -0.4j]))
            head = np.array([back[0], tip, back[1]])
            arrows.append(Curve(head.real, head.imag, width=1.6))
            marks.append(Mark(float(x[i]), float(y[i]), f"{number(hz[i], 3)} Hz", "."))
    return arrows, marks


def loci_of(L: np.ndarray, largest: float = LARGEST) -> np.ndarray:
    """Sort the eigenvalues λ of L into continuous curves: the generalised Nyquist plot.

    From each frequency to the next they are matched by the least sum of distances.

    Parameters
    ----------
    L : complex array (k, p, p)
    largest : float
        |λ| beyond which a locus is not drawn.

    Returns
    -------
    complex array (k, p)
        NaN where |λ| > largest.
    """
    values = np.linalg.eigvals(L)
    if values.shape[1] > 1:
        for i in range(1, len(values)):
            distance = np.abs(values[i - 1][:, None] - values[i][None, :])
            values[i] = values[i][scipy.optimize.linear_sum_assignment(distance)[1]]
    return drawable(values, largest)


def drawable(values: np.ndarray, largest: float = LARGEST) -> np.ndarray:
    """Replace values that no picture holds by NaN in both parts.

    Parameters
    ----------
    values : array of complex
    largest : float
        Modulus.

    Returns
    -------
    array of complex
    """
    return np.where(np.abs(values) <= largest, values, complex(np.nan, np.nan))


MOST_MARKS = 8  # resonances, and as many anti-resonances, marked in the plot
PHASES_OF_MINUS_ONE = np.arange(-1980.0, 1981.0, 360.0)  # deg
Parts = Mapping[str, tuple[np.ndarray, ...]]  # g, k and g k (k,) of each channel, by its name


def bode(loop: LoopView, channels: Sequence[LoopChannel] = ()) -> Figure:
    """The Bode plot of one design with its words and numbers.

    L, then plant and controller: of each channel where the loop decouples into scalar channels,
    else eigenvalues of L, and singular values of G and K.
    """
    parts = scalar_parts(loop, channels)
    rows: list[tuple[Panel, ...]] = [loop_panels(loop, parts), size_panels(loop, parts)]
    if parts:
        rows.append(tuple(
            over_hz(f"phase of {name} (deg)",
                    _curves(loop, {key: phase_deg(part[k]) for key, part in parts.items()}),
                    loop.ends, log_y=False, y_step=90.0, legend=None)
            for k, name in enumerate(("G", "K"))
        ))  # fmt: skip
    title = "Bode plots of the loop, the plant and the controller"
    lines = Lines(tuple(rows), title, (3.0, 2.9, 2.3)[: len(rows)])
    gain = np.linalg.norm(loop.controller, 2, axis=(1, 2))
    return Figure(lines, paragraph("report.bode", loop, channels, gain))


def loop_panels(
    loop: LoopView, parts: Parts | None = None, stable: bool = True
) -> tuple[Panel, Panel]:
    """Make the panels of |L| and its phase.

    A scalar loop is shown as the model in a band of all plants, with crossover and least margins;
    several channels each on the model, and a loop without channels by the eigenvalues of L.

    Parameters
    ----------
    loop : LoopView
    parts : mapping, optional
        As `scalar_parts` returns it.
    stable : bool
        If False, no margins are drawn.

    Returns
    -------
    Panel, Panel
    """
    channels = {name: part[2] for name, part in (parts or {}).items()} if not loop.scalar else {}
    L = loop.open[:, :, 0, 0] if loop.scalar else loci_of(loop.open[0], np.inf).T
    gains, phases = np.abs(L), phase_deg(L.T).T
    crossings = PHASES_OF_MINUS_ONE[
        (phases.min() - 60.0 <= PHASES_OF_MINUS_ONE) & (phases.max() + 60.0 >= PHASES_OF_MINUS_ONE)
    ]
    gain: dict[str, Any] = {"levels": (Level(1.0, "1", colour=GREY),)}  # options of its panel
    phase: dict[str, Any] = {
        "levels": tuple(Level(angle, "", colour=GREY) for angle in crossings),
        "log_y": False, "y_step": 90.0, "legend": None,
    }  # fmt: skip
    if channels:
        curves = [
            _curves(loop, {name: of(part) for name, part in channels.items()})
            for of in (np.abs, phase_deg)
        ]
    elif loop.scalar:
        plants = [of_plants(loop.hz, values) for values in (gains, phases)]
        curves = [[*model] for model, _ in plants]
        gain["bands"], phase["bands"] = (bands for _, bands in plants)
        if stable:
            added = _margins(loop, phases[0], gain, phase)
            curves = [[*model, *lines] for model, lines in zip(curves, added, strict=True)]
    else:
        curves = [[Curve(loop.hz, row) for row in values] for values in (gains, phases)]
    symbol = "L" if loop.scalar or channels else "λ(L)"
    return (
        over_hz(f"|{symbol}| (–)", curves[0], loop.ends, **gain),
        over_hz(f"phase of {symbol} (deg)", curves[1], loop.ends, **phase),
    )


def _margins(
    loop: LoopView, phases: Array, gain: dict[str, Any], phase: dict[str, Any]
) -> tuple[list[Curve], list[Curve]]:
    """Lines from the curves of gain and of phase to those of -1: margins.

    Their texts and the crossover are added to the panels' options, `gain` and `phase`.
    """
    m, (at_down, at_up, at_phase) = loop.margins, loop.margins.places  # rad/s
    if not np.isfinite(m.crossover):
        return [], []
    crossover = Level(m.crossover / HZ, f"crossover {number(m.crossover / HZ, 4)} Hz", True, GREY)
    gain["levels"] += (crossover,)
    phase["levels"] += (Level(crossover.value, "", True, GREY),)
    lines, marks = [], []
    for factor, omega in ((m.gain_down, at_down), (m.gain_up, at_up)):
        hz = omega / HZ
        if np.isfinite(hz) and loop.ends[0] < hz < loop.ends[1]:
            lines.append(_vertical(hz, 1.0 / factor, 1.0))  # |L| = 1/factor there
            offset = (6.0, 3.0 if factor < 1.0 else -5.0)
            marks.append(Mark(hz, 1.0 / factor, f"× {number(factor, 3)}", ".", GREEN, offset))
    gain["marks"] = tuple(marks)
    hz = at_phase / HZ
    angle = float(np.interp(np.log(hz), np.log(loop.hz), phases))
    minus_one = float(PHASES_OF_MINUS_ONE[np.abs(PHASES_OF_MINUS_ONE - angle).argmin()])
    phase["marks"] = (Mark(hz, angle, f"{number(m.phase_deg, 3)}°", ".", GREEN, (6.0, 3.0)),)
    return lines, [_vertical(hz, angle, minus_one)]


def _vertical(hz: float, start: float, end: float) -> Curve:
    return Curve(np.array([hz, hz]), np.array([start, end]), "", GREEN, width=2.2)


def size_panels(loop: LoopView, parts: Parts | None = None) -> tuple[Panel, Panel]:
    """Make the panels of |G| with its resonances marked, and of |K|.

    Parameters
    ----------
    loop : LoopView
    parts : mapping, optional
        Channels as `scalar_parts` returns them; without, all singular values are drawn.

    Returns
    -------
    Panel, Panel
    """
    parts = parts or {}
    G, K = _singular_values(loop.plant), _singular_values(loop.controller)
    bandwidth = (bandwidth_level(loop.bandwidth_hz),)
    if len(parts) > 1:  # resonances of several channels are not marked: their texts would overlap
        gains = [{name: np.abs(part[k]) for name, part in parts.items()} for k in range(2)]
        marked: dict[str, Any] = {}
    else:
        gains = [{f"σ{i + 1}": s[:, i] for i in range(s.shape[1])} for s in (G, K)]
        y_range = (float(G.min()) / 30.0, float(G.max()) * 30.0)  # with space for the marks' texts
        marked = {"marks": tuple(_marks(loop, G)), "y_range": y_range}
    names = ("|G|", "|K|") if parts or loop.scalar else ("plant σ(G)", "controller σ(K)")
    return (
        over_hz(spoken(f"{names[0]} (m/N)"), _curves(loop, gains[0]), loop.ends, **marked),
        over_hz(
            spoken(f"{names[1]} (N/m)"), _curves(loop, gains[1]), loop.ends, levels=bandwidth,
            legend=None,
        ),
    )  # fmt: skip


def _curves(loop: LoopView, values: Mapping[str, Array]) -> list[Curve]:
    """A curve over frequency of each value, each in its own colour, named if there are several."""
    return [
        Curve(loop.hz, v, name if len(values) > 1 else "", CYCLE[i % len(CYCLE)])
        for i, (name, v) in enumerate(values.items())
    ]


def scalar_parts(loop: LoopView, channels: Sequence[LoopChannel]) -> Parts:
    """g, k and g k (k,) of each scalar channel, by a name with the signs of its outputs.

    With its output direction u and input direction v, g = uᵀ G v and k = vᵀ K u. Empty for a loop
    of several inputs and outputs that does not decouple into channels.
    """
    if loop.plant.shape[1:] == (1, 1):
        g, k = loop.plant[:, 0, 0], loop.controller[:, 0, 0]
        return {"": (g, k, g * k)}
    if len(channels) < 2:
        return {}
    parts: dict[str, tuple[np.ndarray, ...]] = {}
    for channel in channels:
        u, v = channel.outputs[:, 0], channel.inputs[:, 0]
        g, k = u @ loop.plant @ v, v @ loop.controller @ u
        u = u * np.sign(u[np.abs(u).argmax()])
        signs = "".join("0" if abs(x) < 1e-6 else "+" if x > 0.0 else "−" for x in u)
        parts[f"channel {channel.name}, outputs {signs}"] = (g, k, g * k)
    return parts


def _marks(loop: LoopView, gains: Array) -> list[Mark]:
    """Marks of resonances above the largest and of anti-resonances below the least singular value.

    `gains` (k, min(p, m)): singular values of G, descending.
    """
    marks = []
    groups = (
        (loop.resonances_hz, gains[:, 0], "^", 8.0),
        (loop.antiresonances_hz, gains[:, -1], "v", -8.0),
    )
    for frequencies, gain, marker, dy in groups:
        inside = [hz for hz in frequencies if loop.hz[0] <= hz <= loop.hz[-1]]
        for hz in inside[:MOST_MARKS]:
            y = float(gain[np.abs(loop.hz - hz).argmin()])
            text = f"{number(hz, 4)} Hz" if len(inside) <= 3 else ""
            marks.append(Mark(hz, y, text, marker, BLACK, (0.0, dy)))
    return marks


def _singular_values(response: NDArray[np.complex128]) -> Array:
    return np.asarray(np.linalg.svd(response, compute_uv=False), dtype=float)
