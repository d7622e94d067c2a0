"""Figures that set methods side by side: cost against progress, paths over θ."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.drawing.content import Curve, Figure, Lines, Panel, Table, ThetaPath
from ccd_casadi.drawing.svg import CYCLE
from ccd_casadi.studies.comparison import Method
from ccd_casadi.studies.conclusions import LABELS
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
        (Panel(x, "least J so far (–)", tuple(curves_J), log_x=True),),
        (Panel(x, "its bandwidth (Hz)", tuple(curves_b), log_x=True),),
    )
    lines = Lines(rows, "Objective and bandwidth against the number of true syntheses", (3.6, 2.6))
    return Figure(lines, "Further left is cheaper, lower is better.", (_cost_table(methods),))


def _steps(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A staircase: a value holds until the next one is found."""
    return np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]


def _cost_table(methods: Sequence[Method]) -> Table:
    """Every improvement of every method."""
    rows = (
        (LABELS[method.name], int(spent), float(objective), float(bandwidth))
        for method in methods
        for spent, objective, bandwidth in zip(*best_so_far(method), strict=True)
    )
    return Table(("method", "syntheses", "least J", "bandwidth (Hz)"), tuple(rows))


def theta_paths(methods: Sequence[Method]) -> tuple[ThetaPath, ...]:
    """The way over the two parameters of each method that is no formulation."""
    walked = [method for method in methods if method.path and method.solution is None]
    return tuple(ThetaPath(LABELS[method.name], np.array(method.path)) for method in walked)
