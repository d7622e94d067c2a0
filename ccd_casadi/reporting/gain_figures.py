"""Closed loops over frequency: σ_max of S, KS and T against what is forbidden to them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.analysis.loop_view import NAMES, LoopView
from ccd_casadi.drawing.content import Area, Band, Curve, Figure, Level, Lines, Mark, Panel
from ccd_casadi.drawing.svg import BLACK, CYCLE, GREEN, GREY, ORANGE
from ccd_casadi.inner_problem.kinds import design_view
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.reporting.facts import paragraph
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, display_unit, number, spoken, with_unit
from ccd_casadi.synthesis.synthesis import Design, synthesise

if TYPE_CHECKING:
    from ccd_casadi.cases.run_folder import FinishedRun
    from ccd_casadi.codesign.verified import Verified

UNITS = {"S": "–", "KS": "N/m", "T": "–"}


def synthesised_loop(
    problem: CoDesignProblem, theta: Sequence[float], omega_S: float, omega_T: float, label: str
) -> LoopView:
    """The loop of the design at (θ, ω_S, ω_T), rad/s, synthesised anew."""
    plant, inner = scaled_plant(problem, theta), problem.inner
    weights = problem.weights.at(omega_S, omega_T)
    made = synthesise(plant, weights, omega_low=inner.omega_low, gamma_backoff=inner.gamma_backoff)
    return design_view(
        problem, theta, made.controller, bandwidth_hz=made.figures.bandwidth / HZ, weights=weights,
        gamma=float(np.nan_to_num(made.figures.certificate.norm_bound)), label=label,
    )  # fmt: skip


def view_of(verified: "Verified") -> LoopView:
    """The loop over frequency; of a mixed-sensitivity design against its γ."""
    bounds: dict[str, Any] = {}
    made = getattr(verified, "design", None)
    if isinstance(made, Design):
        bounds = {"weights": made.weights, "gamma": made.figures.gamma}
    return design_view(
        verified.problem, verified.theta, verified.controller,
        bandwidth_hz=verified.bandwidth / HZ, **bounds,
    )  # fmt: skip


def run_view(run: "FinishedRun") -> LoopView:
    """The loop of a finished run over frequency."""
    return design_view(
        run.problem, run.theta, run.controller, weights=run.weights, gamma=run.figures.gamma,
        bandwidth_hz=float(run.result["bandwidth_hz"]),
    )  # fmt: skip


def over_hz(label: str, curves: Sequence[Curve], ends: tuple[float, float], **more: Any) -> Panel:
    """Make a panel of gains over frequency, both axes logarithmic.

    Parameters
    ----------
    label : str
        Of the gains, with unit.
    curves : sequence of Curve
    ends : (float, float)
        Hz.
    more : any
        Further fields of the panel.

    Returns
    -------
    Panel
    """
    kept = {"log_y": True, **more}
    return Panel("frequency (Hz)", label, tuple(curves), log_x=True, x_range=ends, **kept)


def of_plants(x: Array, values: Array) -> tuple[tuple[Curve], tuple[Band, ...]]:
    """The model's curve, the first row, and the band of all plants where there are several."""
    if len(values) == 1:
        return (Curve(x, values[0]),), ()
    band = Band(x, values.min(axis=0), values.max(axis=0), "all plants")
    return (Curve(x, values[0], "the model"),), (band,)


def bandwidth_level(hz: float, colour: str = GREY, text: str = "") -> Level:
    """Mark ω_b on the axis of frequency.

    Parameters
    ----------
    hz : float
    colour : str
    text : str
        After its number.

    Returns
    -------
    Level
    """
    return Level(hz, f"ω_b {number(hz, 4)} Hz{text}", True, colour)


def sensitivity_panel(
    curves: Sequence[Curve], ends: tuple[float, float], S_max: float, at: Sequence[Level] = (),
    label: str = "σ_max(S) (–)", **more: Any,
) -> Panel:  # fmt: skip
    """Make the panel of S of any loops, with S_max, -3 dB, and ω_b where S crosses that.

    Parameters
    ----------
    curves : sequence of Curve
    ends : (float, float)
        Hz.
    S_max : float
    at : sequence of Level
        ω_b, with words.
    label : str
    more : any
        Further fields of the panel.

    Returns
    -------
    Panel
    """
    levels = [Level(S_max, f"S_max {S_max:g}", colour=GREY), Level(2**-0.5, "-3 dB", colour=GREY)]
    levels += [replace(level, text="") for level in at]
    words = tuple(Mark(v.value, 2**-0.5, v.text, "", v.colour, (8.0, -8.0)) for v in at)
    kept = {**more, "marks": (*more.get("marks", ()), *words)}
    return over_hz(label, curves, ends, levels=tuple(levels), **kept)


def gain_panels(views: Sequence[LoopView], *, bounds: bool = True) -> list[Panel]:
    """Make the panels of S, KS and T over frequency.

    Parameters
    ----------
    views : sequence of LoopView
        Of one design: its model in a band of all plants, with what is forbidden. Of several
        designs: the largest gain on the plants of each.
    bounds : bool
        Whether the bounds of several designs are drawn.

    Returns
    -------
    list of Panel
    """
    return [_gain_panel(views, i, bounds) for i in range(len(NAMES))]


def S_panel(view: LoopView) -> Panel:
    """S of one design with what is asked of it, its highest peak alone marked; of several plants
    that of the model and that of all."""
    several = len(view.loops) > 1
    marks = tuple(_peak_marks(_high_peaks(view)[:1], BLACK, ", the model" * several))
    if several:
        _, i = np.unravel_index(view.sizes[0].argmax(), view.sizes[0].shape)
        top = float(view.hz[i]), float(view.sizes[0].max())
        worst = _peak_marks([top], GREEN, ", worst plant")
        marks = (*(replace(mark, offset=(0.0, -14.0)) for mark in marks), *worst)
    return _gain_panel([view], 0, view.bounded.required, marks=marks)


def _gain_panel(views: Sequence[LoopView], i: int, bounds: bool, **more: Any) -> Panel:
    name, alone = NAMES[i], len(views) == 1
    curves: list[Curve] = []
    marks: list[Mark] = []
    found: dict[str, Any] = {}
    for view, colour in zip(views, CYCLE * len(views), strict=False):
        size, bound = view.sizes[i], view.bounds[i]
        if alone and len(size) > 1:
            own, found["bands"] = of_plants(view.hz, size)
            curves.append(replace(own[0], label=view.label or own[0].label))
        else:
            label = view.label or view.name_gain(name)
            curves.append(Curve(view.hz, size.max(axis=0), label, colour))
        if bounds and np.isfinite(bound).any():
            words = view.bounded.words[i] if alone else ""
            colour_of_bound = ORANGE if view.bounded.required and alone else colour
            curves.append(Curve(view.hz, bound, words, colour_of_bound, "--", width=0.9))
        if i == 0:
            marks += _peak_marks(_high_peaks(view), colour)
    at = [bandwidth_level(view.bandwidth_hz, GREY if alone else colour)
          for view, colour in zip(views, CYCLE * len(views), strict=False)]  # fmt: skip
    low, high = (f(np.concatenate([v.sizes[i].ravel() for v in views])) for f in (np.min, np.max))
    found |= {"marks": tuple(marks), "y_range": (max(low / 1.5, 1e-6 * high), 4.0 * high)}
    if len(curves) == 1 and not found.get("bands"):
        found["legend"] = None
    first, ends = views[0], views[0].ends
    label = f"{first.name_gain(name)} ({spoken(UNITS[name])})"
    if i == 0:
        b = first.bounded
        if alone:
            top = 3.5 * max(b.S_max, float(high))  # room for the words at its peak
            found["y_range"] = (0.5 * float(first.sizes[0, 0].min()), top)
            shape = (first.hz, first.bounds[0]) if b.required else None
            found["forbidden"] = forbidden_gains(b.S_max, b.S_low, b.low_hz, *ends, top, shape)
        return sensitivity_panel(curves, ends, b.S_max, at, label, **{**found, **more})
    if alone and first.bounded.required:
        found["forbidden"] = above(first.hz, first.bounds[i], found["y_range"][1])
    bare = [Level(level.value, "", True, level.colour) for level in at]
    return over_hz(label, curves, ends, levels=tuple(bare), **{**found, **more})


def figure_gains(
    views: Sequence[LoopView], *, bounds: bool = True, compliance: bool = False
) -> Lines:
    """Make the figure of S over the full width, with KS and T below it.

    Parameters
    ----------
    views : sequence of LoopView
    bounds : bool
        As in `gain_panels`.
    compliance : bool
        Draw GS, which one design with a bound of it has in any case.

    Returns
    -------
    Lines
    """
    S, *others = gain_panels(views, bounds=bounds)
    bounded = len(views) == 1 and views[0].bounded.compliance_max is not None
    more = [(compliance_panel(views[0]),)] if bounded or compliance else []
    title = "Largest singular values of S, KS and T over frequency, with their bounds"
    return Lines(((S,), tuple(others), *more), title, (3.3, *[2.7] * (1 + len(more))))


def compliance_panel(view: LoopView) -> Panel:
    """|GS| of the model in a band of all plants, with its bound in m/N where there is one."""
    most = view.bounded.compliance_max
    unit, factor = display_unit(spoken("m"), float(view.sizes[3].max()) if most is None else most)
    curves, bands = of_plants(view.hz, factor * view.sizes[3])
    words = f"compliance_max {with_unit(most or 0.0, spoken('m'))}{spoken('/N')}"
    levels = () if most is None else (Level(factor * most, words, colour=GREY),)
    label = f"{view.name_gain('GS')} ({unit}{spoken('/N')})"
    return over_hz(label, curves, view.ends, levels=levels, bands=bands)


def forbidden_gains(
    S_max: float, S_low: float, low_hz: float, low: float, high: float, top: float,
    shape: tuple[Array, Array] | None = None,
) -> tuple[Area, ...]:  # fmt: skip
    """Find where |S| may not be: above S_max, above S_low up to `low_hz`, and above a shape.

    Parameters
    ----------
    S_max, S_low, low_hz : float
        The bounds.
    low, high : float
        Ends of the picture in Hz.
    top : float
        Its largest |S|.
    shape : (array (N,), array (N,)) or None
        Hz and gain, NaN where it bounds nothing.

    Returns
    -------
    tuple of Area
        One ground, whichever bound is the lowest.
    """
    hz = np.concatenate([[low, low_hz, low_hz, high], np.empty(0) if shape is None else shape[0]])
    past = np.zeros(len(hz))
    past[2] = 1.0  # the second of the two at `low_hz` is beyond it
    order = np.lexsort((past, hz))
    hz, past = hz[order], past[order]
    limit = np.where((hz < low_hz) | ((hz == low_hz) & (past == 0.0)), min(S_low, S_max), S_max)
    if shape is not None:
        own = np.interp(np.log(hz), np.log(shape[0]), shape[1])
        limit = np.fmin(limit, own)
    return above(hz, limit, top)


def above(hz: Array, bound: Array, top: float) -> tuple[Area, ...]:
    """Return the areas that a gain may not enter, over Hz: above a bound that is NaN where nothing
    is required."""
    required = np.isfinite(bound) & (bound < top)
    if not required.any():
        return ()
    x, y = hz[required], bound[required]
    return (Area(np.append(x, [x[-1], x[0]]), np.append(y, [top, top])),)


def _high_peaks(view: LoopView, *, least: float = 1.05) -> list[tuple[float, float]]:
    """Local maxima of |S| above `least`, the highest first."""
    return sorted((p for p in view.peaks if p[1] > least), key=lambda p: -p[1])


def _peak_marks(tops: Sequence[tuple[float, float]], colour: str, of: str = "") -> list[Mark]:
    """The highest peak labelled above it, up to three others to their far side of it."""
    marks = []
    for hz, gain in tops[:4]:
        text, offset = f"{number(hz, 4)} Hz", (7.0 if hz > tops[0][0] else -7.0, 2.0)
        if hz == tops[0][0]:
            text, offset = f"{gain:.3g} at {text}{of}", (0.0, 7.0)
        marks.append(Mark(hz, gain, text, colour=colour, offset=offset))
    return marks


def gains(view: LoopView) -> Figure:
    """S, KS and T of one design with their words."""
    near = [
        (view.name_gain(name), 100.0 * share[i], view.bounded.words[k], float(view.hz[i]))
        for k, (name, share) in enumerate(zip(NAMES, view.shares, strict=True))
        if np.isfinite(share).any()
        for i in [int(np.nanargmax(share))]
    ]
    return Figure(figure_gains([view]), paragraph("report.gains", view, _high_peaks(view), near))
