"""Bode and Nyquist plots of the loop with its margins drawn in."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ccd_casadi.analysis.loop_view import LoopView, phase_deg
from ccd_casadi.deployment.realisation import LoopChannel
from ccd_casadi.drawing.content import Area, Curve, Figure, Level, Lines, Mark, Panel
from ccd_casadi.drawing.lines import BOTTOM, LEFT, RIGHT, TOP
from ccd_casadi.drawing.svg import BLACK, CYCLE, GREEN, GREY, ORANGE, WIDTH
from ccd_casadi.reporting.facts import paragraph
from ccd_casadi.reporting.gain_figures import bandwidth_level, of_plants, over_hz
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, number, spoken

SHOWN = (-3.2, 1.6)  # of the real axis
EVERY, APART = 1.2, 0.3  # of arrows along a locus, and from each other and from the origin
HEAD = 0.13  # length of an arrow head
FAR = 30.0  # |L| beyond which a locus leaves the drawing


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
        The first is the model's: its direction and frequencies are marked.
    S_max : float
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
        Curve(line.real, line.imag, names[1] * (i == 1), others, width=1.0, hz=hz) if i
        else Curve(line.real, line.imag, names[0] * (len(loci) > 1), width=1.6, hz=hz)
        for i, line in reversed(list(enumerate(loci)))
    ]  # fmt: skip
    disk = -1.0 + circle / S_max
    curves.append(Curve(disk.real, disk.imag, colour=ORANGE))
    curves.append(Curve(circle.real, circle.imag, colour=GREY, line=":", width=0.9))
    named = (Mark(-1.0 - 1.0 / S_max, 0.0, f"S_max {S_max:g}", "", ORANGE, (-8.0, 3.0)),
             Mark(0.5**0.5, 0.5**0.5, "|L| = 1", "", GREY, (8.0, 3.0)))  # fmt: skip
    wide, tall = 0.5 * WIDTH - LEFT - RIGHT, height - BOTTOM - TOP
    half = 0.5 * (SHOWN[1] - SHOWN[0]) * tall / wide  # a circle is round
    arrows, marks = _along(hz, loci[0], half)
    return Panel(
        "Re L (–)", "Im L (–)", (*curves, *arrows),
        marks=(Mark(-1.0, 0.0, marker="+"), *marks, *named),
        x_range=SHOWN, y_range=(-half, half),
        forbidden=(Area(disk.real, disk.imag),),
    )  # fmt: skip


def _along(hz: Array, locus: np.ndarray, half: float) -> tuple[list[Curve], list[Mark]]:
    """Arrow heads along a locus as far as it is shown, with their frequencies."""
    arrows: list[Curve] = []
    marks: list[Mark] = []
    x, y = locus.real, locus.imag
    inside = (x > SHOWN[0]) & (x < SHOWN[1]) & (np.abs(y) < half)  # and so known
    steps = np.where(inside[1:] & inside[:-1], np.abs(np.diff(locus)), 0.0)
    along = np.append(0.0, np.cumsum(steps))
    for length in np.arange(0.4 * EVERY, along[-1], EVERY):
        i = int(np.searchsorted(along, length))
        place, way = locus[i], (locus[i] - locus[i - 1]) / abs(locus[i] - locus[i - 1])
        if all(abs(place - other) > APART for other in (0.0, *(complex(m.x, m.y) for m in marks))):
            back = place - HEAD * way * np.exp(np.array([0.4j, -0.4j]))
            head = np.array([back[0], place, back[1]])
            arrows.append(Curve(head.real, head.imag, width=1.6))
            marks.append(Mark(float(x[i]), float(y[i]), f"{number(hz[i], 3)} Hz", "."))
    return arrows, marks


def loci_of(L: np.ndarray, far: float = FAR) -> np.ndarray:
    """Sort the eigenvalues of L into continuous curves.

    Parameters
    ----------
    L : complex array (k, p, p)
    far : float
        |λ| beyond which a locus is not drawn.

    Returns
    -------
    complex array (k, p)
        NaN where |λ| > far.
    """
    values = np.linalg.eigvals(L)
    if values.shape[1] > 1:
        for i in range(1, len(values)):
            away = np.abs(values[i - 1][:, None] - values[i][None, :])
            values[i] = values[i][scipy.optimize.linear_sum_assignment(away)[1]]
    return near(values, far)


def near(values: np.ndarray, far: float = FAR) -> np.ndarray:
    """What is drawn of a locus; beyond `far` neither part is known to a reader."""
    return np.where(np.abs(values) <= far, values, complex(np.nan, np.nan))


MOST_MARKS = 8  # resonances, and as many anti-resonances, marked in the plot
TURNS = np.arange(-1980.0, 1981.0, 360.0)  # phases of -1
Parts = Mapping[str, tuple[np.ndarray, ...]]  # g, k and their product of a channel, by its name


def bode(loop: LoopView, channels: Sequence[LoopChannel] = ()) -> Figure:
    """The Bode plot of one design with its words and numbers.

    L, then plant and controller, of every one of several scalar channels; of a loop that does not
    fall apart into such channels eigenvalues of L and singular values.
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

    Of one channel they have the model in a band of all plants, with crossover and least margins;
    of several every channel, or every eigenvalue.

    Parameters
    ----------
    loop : LoopView
    parts : mapping, optional
        As `scalar_parts` returns it.
    stable : bool
        Without, no margins are drawn.

    Returns
    -------
    Panel, Panel
    """
    several = {name: part[2] for name, part in (parts or {}).items()} if not loop.scalar else {}
    L = loop.open[:, :, 0, 0] if loop.scalar else loci_of(loop.open[0], np.inf).T
    sizes, phases = np.abs(L), phase_deg(L.T).T
    minus_one = TURNS[(phases.min() - 60.0 <= TURNS) & (phases.max() + 60.0 >= TURNS)]
    size: dict[str, Any] = {"levels": (Level(1.0, "1", colour=GREY),)}
    phase: dict[str, Any] = {
        "levels": tuple(Level(turn, "", colour=GREY) for turn in minus_one),
        "log_y": False, "y_step": 90.0, "legend": None,
    }  # fmt: skip
    if several:
        drawn = [
            _curves(loop, {name: of(part) for name, part in several.items()})
            for of in (np.abs, phase_deg)
        ]
    elif loop.scalar:
        found = [of_plants(loop.hz, values) for values in (sizes, phases)]
        drawn = [[*curves] for curves, _ in found]
        size["bands"], phase["bands"] = (bands for _, bands in found)
        if stable:
            drawn = [[*own, *more] for own, more in
                     zip(drawn, _margins(loop, phases[0], size, phase), strict=True)]  # fmt: skip
    else:
        drawn = [[Curve(loop.hz, row) for row in values] for values in (sizes, phases)]
    what = "L" if loop.scalar or several else "λ(L)"
    return (
        over_hz(f"|{what}| (–)", drawn[0], loop.ends, **size),
        over_hz(f"phase of {what} (deg)", drawn[1], loop.ends, **phase),
    )


def _margins(
    loop: LoopView, phases: Array, size: dict[str, Any], phase: dict[str, Any]
) -> tuple[list[Curve], list[Curve]]:
    """Crossover and margins as lines across the gap to -1; their words join the panels."""
    m, (down, up, at) = loop.margins, loop.margins.places
    if not np.isfinite(m.crossover):
        return [], []
    crossover = Level(m.crossover / HZ, f"crossover {number(m.crossover / HZ, 4)} Hz", True, GREY)
    size["levels"] += (crossover,)
    phase["levels"] += (Level(crossover.value, "", True, GREY),)
    gaps, marks = [], []
    for factor, place in ((m.gain_down, down), (m.gain_up, up)):
        hz = place / HZ
        if np.isfinite(hz) and loop.ends[0] < hz < loop.ends[1]:
            gaps.append(_gap(hz, 1.0 / factor, 1.0))
            offset = (6.0, 3.0 if factor < 1.0 else -5.0)
            marks.append(Mark(hz, 1.0 / factor, f"× {number(factor, 3)}", ".", GREEN, offset))
    size["marks"] = tuple(marks)
    hz = at / HZ
    angle = float(np.interp(np.log(hz), np.log(loop.hz), phases))
    turn = float(TURNS[np.abs(TURNS - angle).argmin()])
    words = f"{number(m.phase_deg, 3)}°"
    phase["marks"] = (Mark(hz, angle, words, ".", GREEN, (6.0, 3.0)),)
    return gaps, [_gap(hz, angle, turn)]


def _gap(hz: float, one: float, other: float) -> Curve:
    return Curve(np.array([hz, hz]), np.array([one, other]), "", GREEN, width=2.2)


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
    at = (bandwidth_level(loop.bandwidth_hz),)
    if len(parts) > 1:  # whose resonances are not marked: the words would meet
        size = [{name: np.abs(part[k]) for name, part in parts.items()} for k in range(2)]
        look: dict[str, Any] = {}
    else:
        size = [{f"σ{i + 1}": s[:, i] for i in range(s.shape[1])} for s in (G, K)]
        gap = (float(G.min()) / 30.0, float(G.max()) * 30.0)  # room for the marks' words
        look = {"marks": tuple(_marks(loop, G)), "y_range": gap}
    named = ("|G|", "|K|") if parts or loop.scalar else ("plant σ(G)", "controller σ(K)")
    return (
        over_hz(spoken(f"{named[0]} (m/N)"), _curves(loop, size[0]), loop.ends, **look),
        over_hz(
            spoken(f"{named[1]} (N/m)"), _curves(loop, size[1]), loop.ends, levels=at, legend=None
        ),
    )


def _curves(loop: LoopView, values: Mapping[str, Array]) -> list[Curve]:
    """Named and in a colour each, where there are several."""
    return [
        Curve(loop.hz, v, name if len(values) > 1 else "", CYCLE[i % len(CYCLE)])
        for i, (name, v) in enumerate(values.items())
    ]


def scalar_parts(loop: LoopView, channels: Sequence[LoopChannel]) -> Parts:
    """g, k and their product of every scalar channel, by a name that says which outputs it moves.

    Empty where the loop is no scalar one and does not fall apart into such channels.
    """
    if loop.plant.shape[1:] == (1, 1):
        g, k = loop.plant[:, 0, 0], loop.controller[:, 0, 0]
        return {"": (g, k, g * k)}
    if len(channels) < 2:
        return {}
    found: dict[str, tuple[np.ndarray, ...]] = {}
    for channel in channels:
        u, v = channel.outputs[:, 0], channel.inputs[:, 0]
        g, k = u @ loop.plant @ v, v @ loop.controller @ u
        u = u * np.sign(u[np.abs(u).argmax()])
        signs = "".join("0" if abs(x) < 1e-6 else "+" if x > 0.0 else "−" for x in u)
        found[f"channel {channel.name}, outputs {signs}"] = (g, k, g * k)
    return found


def _marks(loop: LoopView, gains: Array) -> list[Mark]:
    """Resonances above the largest gain, anti-resonances below the least one."""
    found = []
    groups = (
        (loop.resonances_hz, gains[:, 0], "^", 8.0),
        (loop.antiresonances_hz, gains[:, -1], "v", -8.0),
    )
    for places, gain, marker, dy in groups:
        inside = [hz for hz in places if loop.hz[0] <= hz <= loop.hz[-1]]
        for hz in inside[:MOST_MARKS]:
            y = float(gain[np.abs(loop.hz - hz).argmin()])
            text = f"{number(hz, 4)} Hz" if len(inside) <= 3 else ""
            found.append(Mark(hz, y, text, marker, BLACK, (0.0, dy)))
    return found


def _singular_values(response: NDArray[np.complex128]) -> Array:
    return np.asarray(np.linalg.svd(response, compute_uv=False), dtype=float)
