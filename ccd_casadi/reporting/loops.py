"""Closed loops over frequency: σ_max of S, KS and T against their bounds."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.fixed_structure import Bounds, ShapeEnd
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.inner_problem.sweep import InnerProblem
from ccd_casadi.reporting.lines import Curve, Level, Mark, Panel, figure_lines
from ccd_casadi.reporting.page import Table, number
from ccd_casadi.reporting.svg import CYCLE, GREY, ORANGE
from ccd_casadi.reporting.tables import over_frequency
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.loop_responses import Loop, loop_data
from ccd_casadi.synthesis.synthesis import synthesise

Areas = tuple[tuple[np.ndarray, str], ...]  # corners x + iy, colours


def synthesised_loop(
    problem: CoDesignProblem,
    theta: Sequence[float],
    omega_S: float,
    omega_T: float,
    label: str,
) -> Loop:
    """The loop of the design at (θ, ω_S, ω_T), rad/s, synthesised anew."""
    plant, inner = scaled_plant(problem, theta), problem.inner
    weights = problem.weights.at(omega_S, omega_T)
    made = synthesise(plant, weights, omega_low=inner.omega_low, gamma_backoff=inner.gamma_backoff)
    return loop_data(
        plant,
        made.controller,
        weights,
        gamma=float(np.nan_to_num(made.figures.certificate.norm_bound)),
        bandwidth_hz=made.figures.bandwidth / HZ,
        omega_low=inner.omega_low,
        label=label,
    )


def figure_gains(
    loops: Sequence[Loop], *, S_max: float, key: str = "gains", bounds: bool = True
) -> str:
    """|S| over the full width, |KS| and |T| below it, for one design or several."""
    names = ("S", "KS", "T")
    units = ("–", "N/m", "–")
    panels = []
    for i in range(3):
        curves, marks, levels = [], [], []
        for j, loop in enumerate(loops):
            colour = CYCLE[j]
            label = loop.label or f"|{names[i]}|"
            curves.append(Curve(loop.hz, loop.gains[i], label, colour))
            if bounds:
                words = "its bound γ/|W|" if len(loops) == 1 else ""
                curves.append(Curve(loop.hz, loop.bounds[i], words, colour, "--", width=0.9))
            text = f"ω_b {number(loop.bandwidth_hz, 4)} Hz"
            levels.append(Level(loop.bandwidth_hz, text if i == 0 else "", True, colour))
            if i == 0:
                tops = [p for p in loop.peaks if p[1] > 1.05]
                marks += _peak_marks(tops, colour)
        if i == 0:
            levels += [
                Level(S_max, f"S_max {S_max:g}", colour=GREY),
                Level(2**-0.5, "-3 dB", colour=GREY),
            ]
        panels.append(
            Panel(
                "frequency (Hz)",
                f"σ_max({names[i]}) ({units[i]})",
                tuple(curves),
                marks=tuple(marks),
                levels=tuple(levels),
                log_x=True,
                log_y=True,
                x_range=(float(loops[0].hz[0]), float(loops[0].hz[-1])),
                y_range=_gain_range(loops, i),
                legend="best" if i else "lower right",
            )
        )
    title = "Largest singular values of S, KS and T over frequency, with their bounds"
    return figure_lines([panels[:1], panels[1:]], key=key, title=title, heights=(3.3, 2.7))


def forbidden(inner: InnerProblem | Bounds, low: float, high: float, top: float) -> Areas:
    """Where |S| may not be, over Hz: above S_max, and above S_low up to ω_low."""
    ends = (inner.omega_low / HZ, inner.S_low)
    return (
        (_box(low, high, inner.S_max, top), ORANGE),
        (_box(low, ends[0], ends[1], min(inner.S_max, top)), ORANGE),
    )


def above(hz: Array, bound: Array, top: float) -> Areas:
    """Where a gain may not be, over Hz: above a bound that is NaN where nothing is asked."""
    asked = np.isfinite(bound) & (bound < top)
    if not asked.any():
        return ()
    x, y = hz[asked], bound[asked]
    ends = np.array([complex(x[-1], top), complex(x[0], top)])
    return ((np.concatenate([x + 1j * y, ends]), ORANGE),)


def section_bounds(problem: CoDesignProblem, hz: Array, bandwidth_hz: float) -> Array:
    """What S, KS (N/m) and T of a fixed structure may not exceed beside S_max and S_low (3, k).

    The shape, and weighted_level/|W|; NaN where nothing is asked.
    """
    sections = problem.sections
    assert sections is not None
    size = np.abs(problem.weights.responses(HZ * hz))
    level = np.nan if sections.weighted_level is None else sections.weighted_level
    shape = np.nan if sections.shape is None else sections.shape
    below = hz <= bandwidth_hz
    rising = shape * hz / bandwidth_hz * 2.0**-0.5
    most = np.where(below, np.fmin(rising, 2.0**-0.5), rising)
    bounded = (below | (sections.shape_ends is ShapeEnd.S_MAX)) & (most <= problem.inner.S_max)
    return np.array([np.where(bounded, most, np.nan), *(level / size[1:])])


def _box(left: float, right: float, bottom: float, top: float) -> np.ndarray:
    return np.array([complex(x, y) for x, y in (
        (left, bottom), (right, bottom), (right, top), (left, top))])  # fmt: skip


def _peak_marks(tops: Sequence[tuple[float, float]], colour: str) -> list[Mark]:
    """The highest peak labelled above it, up to three others to their far side of it."""
    ranked = sorted(tops, key=lambda p: -p[1])[:4]
    marks = []
    for hz, gain in ranked:
        text, offset = f"{number(hz, 4)} Hz", (7.0 if hz > ranked[0][0] else -7.0, 2.0)
        if hz == ranked[0][0]:
            text, offset = f"{gain:.3g} at {text}", (0.0, 7.0)
        marks.append(Mark(hz, gain, text, colour=colour, offset=offset))
    return marks


def _gain_range(loops: Sequence[Loop], i: int) -> tuple[float, float]:
    """From the gains, and no more of the bounds above them than a decade."""
    gains = np.concatenate([loop.gains[i] for loop in loops])
    low = float(gains.min())
    return max(low / 1.5, 1e-6 * float(gains.max())), float(gains.max()) * 4.0


def caption_gains(loop: Loop, *, S_max: float) -> str:
    """What to see in the gains of one design, in numbers."""
    share = loop.gains / loop.bounds
    closest = share.argmax(axis=1)
    parts = [
        f"|{name}| comes to {100.0 * share[i, closest[i]]:.1f} % of its bound at "
        f"{number(float(loop.hz[closest[i]]), 3)} Hz"
        for i, name in enumerate(("S", "KS", "T"))
    ]
    tops = sorted((p for p in loop.peaks if p[1] > 1.05), key=lambda p: -p[1])
    words = ""
    if tops:
        hz, gain = tops[0]
        words = (
            f" The highest peak of S is {number(gain, 5)} at {number(hz, 4)} Hz, "
            f"{100.0 * gain / S_max:.2f} % of S_max = {S_max:g}"
        )
        others = [f"{number(g, 3)} at {number(h, 4)} Hz" for h, g in tops[1:3]]
        words += f"; further local peaks {', '.join(others)}." if others else "."
    return (
        f"σ_max(S) first crosses -3 dB at ω_b = {number(loop.bandwidth_hz, 5)} Hz.{words} No gain "
        f"exceeds its bound γ/|W|, as certified: {', '.join(parts)}."
    )


def table_gains(loop: Loop) -> Table:
    """Gains and bounds at some frequencies, the marked ones among them."""
    pairs = zip(loop.gains, loop.bounds, strict=True)
    head = ("Hz", "|S|", "bound", "|KS| N/m", "bound N/m", "|T|", "bound")
    columns = [column for pair in pairs for column in pair]
    return over_frequency(head, loop.hz, *columns, special=marked(loop))


def marked(loop: Loop) -> list[float]:
    """Frequencies in Hz that a table of the loop does not leave out."""
    return [loop.bandwidth_hz, *(hz for hz, _ in loop.peaks)]
