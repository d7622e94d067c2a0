"""insight.html: the trade-off around a design, what it answers to, what limits it."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.insight import bandwidth_of, natural_hz
from ccd_casadi.codesign.outer_problem import lifted_bounds
from ccd_casadi.codesign.pareto import Front
from ccd_casadi.codesign.post_optimal import PostOptimal
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import CYCLE, GREY, axis_label
from ccd_casadi.inner_problem.figure import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.reporting.facts import cost_axis, cost_words, run_name, theta_axes, theta_words
from ccd_casadi.reporting.front_walk import front_walk
from ccd_casadi.reporting.limits import limit_blocks
from ccd_casadi.reporting.loops import run_view
from ccd_casadi.reporting.structured_page import binding_words
from ccd_casadi.reporting.verdict import head_of
from ccd_casadi.support.units import HZ, display_unit, number

ROUNDING = 1e-9  # of the box: a doubled parameter that moves θ by less does not move it
RULE = (3.0, 5.0)  # first resonance over bandwidth, as the rule of thumb of the field asks for


def insight_page(run: FinishedRun, front: Front, responses: PostOptimal, index: str = "") -> c.Page:
    """insight.html; `index`: the page that it links as that of the whole run."""
    problem = run.problem
    bandwidth_hz = bandwidth_of(run) / HZ
    cost = float(run.result["hardware_cost"])
    rule = rule_sentence(bandwidth_hz, natural_hz(run))
    verified = sum(point.verified for point in front.points)
    whole = verified == len(front.points)
    head = head_of(
        f"Insight: {run_name(run.folder)}",
        whole,
        "verified" if whole else "not all verified",
        f"{verified} of {len(front.points)} points of the front",
        f"around the design of {run.folder.name}/result.json",
        f"The design, {theta_words(run.result)}, has {number(bandwidth_hz)} Hz at a hardware cost "
        f"of {cost_words(run.result)}. {rule}",
        run.result, front_answer(problem, front),
    )  # fmt: skip
    v = problem.figure
    own = v.factor * float(run.result.get(f"{v.entry}_of_set", bandwidth_of(run)))
    if len(front.points) == 1:
        walk: tuple[c.Block, ...] = (c.Words(_caption(front)), _table(problem, front))
    else:
        drawn = front_figure(problem, front, (cost, own, "this run's design"))
        walk = (drawn, *front_walk(run, front))
    changes: list[c.Block] = [c.Words(text) for text in response_sentences(responses)]
    changes.append(table_responses(problem, responses))
    chapters = (
        c.Chapter(f"Weight against {v.words}", walk),
        c.Chapter("What each parameter of the case would change", tuple(changes)),
        c.Chapter("What limits the bandwidth", _limits(run, rule)),
    )
    return c.Page(head, chapters, index)


def _limits(run: FinishedRun, rule: str) -> tuple[c.Block, ...]:
    """The shares of γ; of a fixed structure, which has no γ, the bounds that hold it."""
    if run.result.get("gamma") is None:
        held = binding_words(run.problem, run.result)
        without = (
            "A fixed structure has no γ, and no weights' frequencies to move: what holds ω_b are "
            "the bounds above."
        )
        return c.Bullets(tuple(held)), c.Words(without), c.Words(rule)
    return limit_blocks(run_view(run), rule)


def front_figure(
    problem: CoDesignProblem, front: Front, design: tuple[float, float, str]
) -> c.Figure:
    """What J counts over hardware cost, and where each θ lies in its bounds along the curve.

    `design` is (f, v in its shown unit, words) of the run's own optimum.
    """
    v = problem.figure
    cost = np.array([point.hardware_cost for point in front.points])
    values = v.factor * np.array([point.value for point in front.points])
    good = np.array([point.verified for point in front.points])
    curves = [
        c.Curve(cost, values, "", GREY, marker="."),
        c.Curve(cost[good], values[good], "the best design for some weights", line="", marker="o"),
    ]
    if not good.all():
        curves.append(c.Curve(cost[~good], values[~good], "not stationary", CYCLE[1], "", "x"))
    mark = c.Mark(design[0], design[1], design[2], "+", offset=(8.0, 3.0))
    top = c.Panel("", f"{v.words} {v.symbol} ({v.unit})", tuple(curves), marks=(mark,))
    low, width = np.array(problem.lower), np.subtract(problem.upper, problem.lower)
    theta = (np.array([point.theta for point in front.points]) - low) / width
    parts = tuple(
        c.Curve(cost, theta[:, i], name, CYCLE[i % len(CYCLE)], marker=".")
        for i, name in enumerate(problem.names)
    )
    bottom = c.Panel(
        cost_axis(problem), "place of θ in its bounds (–)", parts, y_range=(-0.05, 1.05)
    )
    title = f"Hardware cost against {v.words} as the weights of J change, and the hardware there"
    lines = c.Lines(((top,), (bottom,)), title, (3.3, 2.8))
    return c.Figure(lines, _caption(front), (_table(problem, front),))


def _caption(front: Front) -> str:
    """How many points, how well they are known, and what lies between them."""
    verified = sum(point.verified for point in front.points)
    if len(front.points) == 1:
        return f"One point, {front.syntheses} true syntheses: the lightest design and the best."
    between = (
        "Local solves found no weights that lead to a design between two of them."
        if front.whole
        else "More points are possible between them (--points)."
    )
    return (
        f"{verified} of {len(front.points)} points verified by the true inner problem, "
        f"{front.syntheses} true syntheses. Each is the optimum of J for some weights: none found "
        f"is lighter and better. {between}"
    )


def front_answer(problem: CoDesignProblem, front: Front) -> str:
    """What the front says of weight against what J counts, in one sentence."""
    efficient = [point for point in front.points if point.verified]
    unit, v = problem.cost_unit, problem.figure
    costs = [f"{number(p.hardware_cost)} {unit}".strip() for p in efficient]
    values = [v.shown(p.value) for p in efficient]
    if not efficient:
        return "No point of the front is verified."
    if len(efficient) == 1:
        words = "There is nothing to trade: the design of least hardware cost"
        best = "is also the fastest" if v is BANDWIDTH else f"has the least {v.words} too"
        return f"{words}, {costs[0]}, {best}, {values[0]}."
    light, fast = efficient[0], efficient[-1]
    rate = v.factor * (fast.value - light.value) / (fast.hardware_cost - light.hardware_cost)
    name = f"{v.words[0].upper()}{v.words[1:]}" if v is BANDWIDTH else f"Less {v.words}"
    return (
        f"{name} costs hardware: from {costs[0]} with {values[0]} to {costs[-1]} with "
        f"{values[-1]}, on average {number(rate, 3)} {v.unit} for every {unit or 'unit of f'}."
    )


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
    head = ("f", f"{v.symbol} ({v.unit})", *heads, "what binds", "status")
    return c.Table(head, rows)


def table_responses(problem: CoDesignProblem, found: PostOptimal) -> c.Table:
    """The parameters that the optimum answers to, per unit, in the units of the case file."""
    rows = []
    swept = any(item.ln_omega for item in found.responses)
    lower, upper = lifted_bounds(problem) if swept else box(problem)
    shown = [factor for *_, factor in theta_axes(problem)]
    labels = [axis_label(name, unit) for name, unit, _ in theta_axes(problem)]
    labels += ["ln ω_S", "ln ω_T"] if swept else []
    sizes = (upper - lower) * np.array([*shown, 1.0, 1.0] if swept else shown)
    for item in found.responses:
        name, value, factor, unit = _unit(problem, item.parameter, item.value)
        moved = [abs(item.objective), *np.abs(item.theta), *np.abs(item.ln_omega)]
        if not max((v for v in moved if np.isfinite(v)), default=0.0) > 0.0:
            continue
        moves = (*(f * v for f, v in zip(shown, item.theta, strict=True)), *item.ln_omega)
        theta = ", ".join(
            f"{label} {number(v / factor, 3)}"
            for label, v, size in zip(labels, moves, sizes, strict=True)
            if abs(v) * (abs(item.value) or 1.0) > ROUNDING * size
        )
        still = "does not move" if found.determined or swept else "–"
        slopes = (item.objective, item.bandwidth / HZ, item.hardware_cost)
        shown_value = f"{number(value)} {unit}".strip()
        rows.append((name, shown_value, *(slope / factor for slope in slopes), theta or still))
    moving = "how θ, ln ω_S and ln ω_T move per unit" if swept else "how θ moves per unit"
    head = ("parameter", "value", "dJ*/dp", "dω_b/dp (Hz)", "df/dp", moving)
    return c.Table(head, tuple(rows))


def _unit(problem: CoDesignProblem, name: str, value: float) -> tuple[str, float, float, str]:
    """Name, value, units of the file per SI unit, and the unit: Hz for ω_S and ω_T."""
    variable = name.rpartition(" ")[0]
    if variable in ("omega_S", "omega_T"):
        return name.replace("omega", "ω"), value / HZ, 1.0 / HZ, "Hz"
    if variable in problem.names:
        unit, factor = display_unit(problem.units[problem.names.index(variable)], value)
        return name, factor * value, factor, unit
    return name, value, 1.0, ""


def response_sentences(found: PostOptimal) -> list[str]:
    """What the table means, and where it ends."""
    words = [
        "Per unit of the parameter in the case file's unit, for the whole re-optimised design: "
        "dJ*/dp and how ω_b, f and θ move with it. Parameters that are not listed change nothing."
    ]
    if not found.determined:
        words.append(
            "The second-order conditions do not determine how the design moves (dependent "
            "constraints, no strict minimum, or second derivatives that are not known), so only "
            "dJ*/dp is given."
        )
    if found.weak:
        words.append(
            f"{', '.join(found.weak)} is only touched: beyond it the responses are one-sided."
        )
    return words


def rule_sentence(bandwidth_hz: float, natural_hz: Sequence[float]) -> str:
    """The rule of thumb, first resonance 3 to 5 times the bandwidth, against what was achieved."""
    if not natural_hz:
        return "The plant has no flexible mode: the rule of thumb says nothing about it."
    first = min(natural_hz)
    ratio = first / bandwidth_hz
    low, high = RULE
    place, what_then = "within", ""
    if ratio < low:
        place, what_then = "below", ": check the robustness to that resonance"
    elif ratio > high:
        place, what_then = "above", ": by that rule it could be faster"
    return (
        f"The first resonance, {number(first, 4)} Hz, is {number(ratio, 3)} times the bandwidth, "
        f"{place} the {low:g} to {high:g} of the rule of thumb{what_then}. By the rule this stage "
        f"would get {number(first / high, 3)} to {number(first / low, 3)} Hz."
    )
