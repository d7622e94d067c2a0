"""Figures that set methods side by side: cost against progress, histories, paths over θ."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.drawing.content import Curve, Figure, Level, Lines, Panel, Table, ThetaPath
from ccd_casadi.drawing.svg import CYCLE, axis_label
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.facts import cost_axis, theta_axes
from ccd_casadi.studies.baselines import baseline_of
from ccd_casadi.studies.comparison import Method
from ccd_casadi.studies.conclusions import LABELS
from ccd_casadi.studies.steepest_descent import Descent
from ccd_casadi.support.units import HZ


def best_so_far(method: Method) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Syntheses spent, least J and its bandwidth (Hz) after each feasible design of a run."""
    found, best = [], np.inf
    for entry in method.trace:
        if np.isfinite(entry.objective) and entry.objective < best:
            best = entry.objective
            found.append((entry.syntheses, best, entry.bandwidth / HZ))
    if found:
        spent_in_all = method.figures.get("syntheses", 0)  # what the last improvement took not
        found.append((max(method.trace[-1].syntheses, spent_in_all), *found[-1][1:]))
    spent, objective, bandwidth = np.array(found, float).reshape(-1, 3).T
    return spent, objective, bandwidth


def cost_figure(methods: Sequence[Method]) -> Figure:
    """Least J and its bandwidth against true syntheses, every method on the same axes."""
    curves_J, curves_b = [], []
    for i, method in enumerate(methods):
        spent, objective, bandwidth = best_so_far(method)
        if not spent.size:
            continue
        label, colour = LABELS[method.name], CYCLE[i % len(CYCLE)]
        marker = "o" if spent.size < 3 else ""
        curves_J.append(Curve(*_steps(spent, objective), label, colour, marker=marker))
        curves_b.append(Curve(*_steps(spent, bandwidth), "", colour, marker=marker))
    x = "true syntheses spent (–)"
    rows = (
        (Panel(x, "least J so far (–)", tuple(curves_J), log_x=True, legend="upper right"),),
        (Panel(x, "its bandwidth (Hz)", tuple(curves_b), log_x=True),),
    )
    lines = Lines(rows, "Objective and bandwidth against the number of true syntheses", (3.6, 2.6))
    return Figure(lines, "Further left is cheaper, lower is better.", (_cost_table(methods),))


def _steps(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A staircase: a value holds until the next one is found."""
    return np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]


def _cost_table(methods: Sequence[Method]) -> Table:
    """Every improvement of every method."""
    rows = []
    for method in methods:
        for spent, objective, bandwidth in zip(*best_so_far(method), strict=True):
            rows.append((LABELS[method.name], int(spent), float(objective), float(bandwidth)))
    return Table(("method", "syntheses", "least J", "bandwidth (Hz)"), tuple(rows))


def descent_figure(problem: CoDesignProblem, descent: Descent) -> Figure:
    """θ, J, hardware cost and bandwidth over the iterations of a descent (figures 9 and 10)."""
    items = descent.iterates
    steps = np.arange(len(items), dtype=float)
    axes = theta_axes(problem)
    theta = np.array([item.theta for item in items]) * [factor for *_, factor in axes]
    J = np.array([item.objective for item in items])
    bandwidth = np.array([item.bandwidth for item in items]) / HZ
    cost = (J - problem.w2 * HZ * bandwidth) / problem.w1 if problem.w1 > 0.0 else None
    parameters = tuple(
        Curve(steps, theta[:, k], axis_label(name, unit), CYCLE[k % len(CYCLE)], marker=".")
        for k, (name, unit, _) in enumerate(axes)
    )
    units = {unit for _, unit, _ in axes if unit}
    y = f"parameters ({units.pop()})" if len(units) == 1 else "parameters (own units)"
    x = "iteration (–)"
    lower = [
        Panel(x, "J (–)", (Curve(steps, J, marker="."),), whole_x=True),
        Panel(x, "bandwidth (Hz)", (Curve(steps, bandwidth, marker="."),), whole_x=True),
    ]
    if cost is not None:
        lower.append(Panel(x, cost_axis(problem), (Curve(steps, cost, marker="."),), whole_x=True))
    bounds = tuple(
        Level(value, "") for value in sorted({*problem.lower, *problem.upper}) if len(units) == 0
    )
    rows = ((Panel(x, y, parameters, levels=bounds, whole_x=True),), tuple(lower))
    title = "Parameters, objective, bandwidth and hardware cost over the iterations"
    lines = Lines(rows, title, (2.8, 2.5))
    return Figure(lines, _descent_caption(descent), (_descent_table(problem, descent),))


def _descent_caption(descent: Descent) -> str:
    """From where to where, and why it ended."""
    items = descent.iterates
    first, last = items[0], items[-1]
    return (
        f"{len(items)} iterations from J = {first.objective:.3f}, "
        f"{first.bandwidth / HZ:.2f} Hz to J = {last.objective:.3f}, {last.bandwidth / HZ:.2f} Hz; "
        f"first step {100 * descent.first_step:.3g} % of the box. It ended because: "
        f"{descent.stop.value}."
    )


def _descent_table(problem: CoDesignProblem, descent: Descent) -> Table:
    """One row an iterate."""
    swept = baseline_of(problem).swept
    head = (
        "iteration", *problem.names, "J", "bandwidth (Hz)",
        *(("ω_S (Hz)", "ω_T (Hz)") if swept else ()), "syntheses",
    )  # fmt: skip
    rows = tuple(
        (
            i,
            *item.theta,
            item.objective,
            item.bandwidth / HZ,
            *((item.omega_S / HZ, item.omega_T / HZ) if swept else ()),
            item.syntheses,
        )
        for i, item in enumerate(descent.iterates)
    )
    return Table(head, rows)


def theta_paths(methods: Sequence[Method]) -> tuple[ThetaPath, ...]:
    """Each method's way over the two parameters."""
    return tuple(
        ThetaPath(LABELS[method.name], np.array(method.path))
        for method in methods
        if len(method.path)
    )
