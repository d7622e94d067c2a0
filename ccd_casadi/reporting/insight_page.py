"""insight.html: the trade-off around a design, what it answers to, what limits it."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.codesign.pareto import Front, bandwidth_of, natural_hz
from ccd_casadi.codesign.post_optimal import PostOptimal
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import CYCLE, axis_label
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.reporting.decision import decide
from ccd_casadi.reporting.facts import (
    cost_label,
    cost_words,
    paragraph,
    paragraphs,
    run_name,
    theta_axes,
    theta_words,
)
from ccd_casadi.reporting.gain_figures import run_view
from ccd_casadi.reporting.limit_figures import binding_words, limit_blocks
from ccd_casadi.reporting.machine import machine
from ccd_casadi.reporting.run_verdict import head_of
from ccd_casadi.support.text import HZ, display_unit, number, spoken

PERCENT = 0.01
MOST = 12  # designs along the front that are drawn


def insight_page(run: FinishedRun, front: Front, responses: PostOptimal, index: str = "") -> c.Page:
    """Make the page insight.html.

    Parameters
    ----------
    run : FinishedRun
    front : Front
        Hardware cost against what J counts.
    responses : PostOptimal
        Derivatives of the optimum to the parameters of the case.
    index : str
        Address of the page that links all pages of the run.

    Returns
    -------
    Page
    """
    problem = run.problem
    bandwidth_hz = bandwidth_of(run) / HZ
    cost = float(run.result["hardware_cost"])
    (rule,) = paragraphs("insight.rule", bandwidth_hz, natural_hz(run))
    verified = sum(point.verified for point in front.points)
    whole = verified == len(front.points)
    decided, answer = decide(run.result), front_answer(problem, front, cost)
    if decided.refuses:  # what a design trades is no question before that
        answer = f"{decided.words} {answer}"
    head = head_of(
        f"Insight: {run_name(run.folder)}",
        whole,
        "verified" if whole else "not all verified",
        f"{verified} of {len(front.points)} points of the front",
        f"around the design of {run.folder.name}/result.json",
        f"The design, {theta_words(run.result)}, has {number(bandwidth_hz)} Hz at a hardware cost "
        f"of {cost_words(run.result)}. {rule}",
        run.result, answer,
    )  # fmt: skip
    v = problem.figure
    own = v.factor * float(run.result.get(f"{v.entry}_of_set", bandwidth_of(run)))
    if len(front.points) == 1:
        words = paragraphs("insight.front", front)
        walk: tuple[c.Block, ...] = (*map(c.Words, words), _table(problem, front))
    else:
        drawn = front_figure(problem, front, (cost, own, "this run's design"))
        walk = (drawn, _walk(run, front))
    changes: tuple[c.Block, ...] = (
        *map(c.Words, paragraphs("insight.responses", responses)),
        table_responses(problem, responses),
    )
    chapters = (
        c.Chapter(f"Weight against {v.words}", walk),
        c.Chapter("What each parameter of the case would change", changes),
        c.Chapter("What limits the bandwidth", _limits(run, rule)),
    )
    return c.Page(head, chapters, index)


def _limits(run: FinishedRun, rule: str) -> tuple[c.Block, ...]:
    """The shares of γ; of a fixed structure, which has no γ, the bounds that hold it."""
    if run.result.get("gamma") is None:
        held = c.Bullets(tuple(binding_words(run.problem, run.result)))
        return held, c.Words(rule)
    return limit_blocks(run_view(run), rule)


def front_figure(
    problem: CoDesignProblem, front: Front, design: tuple[float, float, str]
) -> c.Figure:
    """Draw what J counts over hardware cost, and where each θ lies in its bounds along the curve.

    `design` is (f, v in its shown unit, words) of the run's own optimum.
    """
    v = problem.figure
    cost = np.array([point.hardware_cost for point in front.points])
    values = v.factor * np.array([point.value for point in front.points])
    good = np.array([point.verified for point in front.points])
    curves = [  # no line between them: where a front is hollow, no weights lead to a design
        c.Curve(cost[good], values[good], "the best design for some weights", line="", marker="o")
    ]
    if not good.all():
        curves.append(c.Curve(cost[~good], values[~good], "not stationary", CYCLE[1], "", "x"))
    mark = c.Mark(design[0], design[1], design[2], "+", offset=(8.0, 3.0))
    top = c.Panel("", f"{v.words} {v.symbol} ({spoken(v.unit)})", tuple(curves), marks=(mark,))
    low, width = np.array(problem.lower), np.subtract(problem.upper, problem.lower)
    theta = (np.array([point.theta for point in front.points]) - low) / width
    parts = tuple(
        c.Curve(cost, theta[:, i], name, CYCLE[i % len(CYCLE)], marker=".")
        for i, name in enumerate(problem.names)
    )
    bottom = c.Panel(
        cost_label(problem), "place of θ in its bounds (–)", parts, y_range=(-0.05, 1.05)
    )
    title = f"Hardware cost against {v.words} as the weights of J change, and the hardware there"
    lines = c.Lines(((top,), (bottom,)), title, (3.3, 2.8))
    return c.Figure(lines, paragraph("insight.front", front), (_table(problem, front),))


def front_answer(problem: CoDesignProblem, front: Front, own: float | None = None) -> str:
    """Describe in one sentence what the front shows of weight against what J counts; with what the
    next piece of hardware is worth at its ends and at the design whose hardware cost is `own`."""
    good = [point for point in front.points if point.verified]
    cost, value = (np.array([getattr(point, name) for point in good], float)
                   for name in ("hardware_cost", "value"))  # fmt: skip
    rates = problem.figure.factor * np.diff(value) / np.diff(cost)
    here = None
    if own is not None and len(rates) > 1:
        here = rates[min(int(np.abs(cost - own).argmin()), len(rates) - 1)]
    return paragraphs("insight.answer", problem, front, rates, here)[0]


def _walk(run: FinishedRun, front: Front) -> c.Steps:
    """The designs along a front, the machine of each behind a slider: lightest to fastest."""
    problem, points = run.problem, front.points
    chosen = np.unique(np.linspace(0, len(points) - 1, min(MOST, len(points))).round().astype(int))
    shown = [points[i] for i in chosen]
    steps = []
    for point in shown:
        theta = dict(zip(problem.names, point.theta, strict=True))
        named = theta_words({"theta": theta, "units": problem.parameter_units})
        words = paragraph("insight.point", point, problem, named)
        drawn = c.Lines(((_machine(problem, point.theta), None),), "A design of the front")
        steps.append((words, drawn))
    own = float(run.result["hardware_cost"])
    first = int(np.argmin([abs(point.hardware_cost - own) for point in shown]))
    return c.Steps(tuple(steps), first, "lightest to heaviest")


def _machine(problem: CoDesignProblem, theta: Sequence[float]) -> c.Place:
    drawing = plant_of(problem).drawing
    if drawing is None:
        return machine(problem, theta)
    shown = drawing({"": theta}).drawing
    if isinstance(shown, c.Lines):
        return shown.rows[0][0]
    return None if isinstance(shown, c.Landscape) else shown


def _table(problem: CoDesignProblem, front: Front) -> c.Table:
    """One row a point."""
    axes, v = theta_axes(problem), problem.figure
    rows = tuple(
        (point.hardware_cost, v.factor * point.value,
         *(factor * v for (*_, factor), v in zip(axes, point.theta, strict=True)),
         ", ".join(point.active), "verified" if point.verified else "not verified")
        for point in front.points
    )  # fmt: skip
    heads = (axis_label(name, unit) for name, unit, _ in axes)
    head = (
        cost_label(problem, "f"),
        f"{v.symbol} ({spoken(v.unit)})",
        *heads,
        "what binds",
        "status",
    )
    return c.Table(head, rows)


def table_responses(
    problem: CoDesignProblem, found: PostOptimal, *, rounding: float = 1e-9
) -> c.Bars:
    """Tabulate what the optimum becomes if a parameter of the case grows by 1 %, the most for J
    first, in the units of the case file; of a parameter that is 0 per unit.

    A doubled parameter that moves θ by less than `rounding` of the box does not move it.
    """
    swept = any(item.ln_omega for item in found.responses)
    lower, upper = lifted_bounds(problem) if swept else box(problem)
    shown = [factor for *_, factor in theta_axes(problem)]
    labels = [axis_label(name, unit) for name, unit, _ in theta_axes(problem)]
    labels += ["ln ω_S", "ln ω_T"] if swept else []
    sizes = (upper - lower) * np.array([*shown, 1.0, 1.0] if swept else shown)
    rows = []
    for item in found.responses:
        name, value, factor, unit = _unit(problem, item.parameter, item.value)
        moved = [abs(item.objective), *np.abs(item.theta), *np.abs(item.ln_omega)]
        if not max((v for v in moved if np.isfinite(v)), default=0.0) > 0.0:
            continue
        step = PERCENT * abs(item.value) or 1.0 / factor
        moves = (*(f * v for f, v in zip(shown, item.theta, strict=True)), *item.ln_omega)
        theta = ", ".join(
            f"{label} {number(v * step, 3)}"
            for label, v, size in zip(labels, moves, sizes, strict=True)
            if abs(v) * (abs(item.value) or 1.0) > rounding * size
        )
        still = "does not move" if found.determined or swept else "–"
        slopes = (item.bandwidth / HZ, item.hardware_cost, item.objective)
        shown_value = f"{number(value)} {unit}".strip() + ("" if item.value else ", per unit")
        changes = (float(f"{slope * step:.3g}") for slope in slopes)
        rows.append((step * item.objective, (name, shown_value, theta or still, *changes)))
    rows.sort(key=lambda row: -abs(row[0]))
    moving = "θ, ln ω_S and ln ω_T move by" if swept else "θ moves by"
    cost = cost_label(problem, "f by")
    head = ("1 % more of", "its value", moving, "ω_b by (Hz)", cost, "J by", "change of J")
    return c.Bars(head, tuple(row for _, row in rows), tuple(length for length, _ in rows))


def _unit(problem: CoDesignProblem, name: str, value: float) -> tuple[str, float, float, str]:
    """Name, value, units of the file per SI unit, and the unit: Hz for ω_S and ω_T."""
    variable = name.rpartition(" ")[0]
    if variable in ("omega_S", "omega_T"):
        return name.replace("omega", "ω"), value / HZ, 1.0 / HZ, "Hz"
    if variable in problem.names:
        unit, factor = display_unit(problem.units[problem.names.index(variable)], value)
        return name, factor * value, factor, unit
    if name == "compliance_max":
        unit, factor = display_unit(spoken("m/N"), value)
        return name, factor * value, factor, unit
    return name, value, 1.0, ""
