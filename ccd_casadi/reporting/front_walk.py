"""The designs along a front: machine and S of each, behind a slider."""

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.pareto import Front, FrontPoint
from ccd_casadi.drawing.content import Landscape, Lines, Place, Steps
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.reporting.facts import theta_words
from ccd_casadi.reporting.glance import machine
from ccd_casadi.reporting.loops import S_panel, synthesised_loop
from ccd_casadi.support.units import HZ, number

MOST = 12  # designs: each is synthesised and drawn


def front_walk(run: FinishedRun, front: Front) -> tuple[Steps, ...]:
    """Of a fixed structure the machine alone is drawn."""
    problem = run.problem
    points = front.points
    chosen = np.unique(np.linspace(0, len(points) - 1, min(MOST, len(points))).round().astype(int))
    shown = [points[i] for i in chosen]
    loops = [_loop(problem, point) for point in shown if np.isfinite(point.omega_S)]
    tops = [float(loop.gains[0].max()) for loop in loops]
    lows = [float(loop.gains[0].min()) for loop in loops]
    steps = []
    for i, point in enumerate(shown):
        row: list[Place] = [_machine(problem, point)]
        if loops:
            top = 1.5 * max(problem.inner.S_max, *tops)
            row.append(S_panel(loops[i], y_range=(0.5 * min(lows), top), marks=()))
        steps.append((_words(problem, point), Lines((tuple(row),), "A design of the front")))
    own = float(run.result["hardware_cost"])
    first = int(np.argmin([abs(point.hardware_cost - own) for point in shown]))
    return (Steps(tuple(steps), first, "lightest to heaviest"),)


def _loop(problem: CoDesignProblem, point: FrontPoint) -> LoopView:
    return synthesised_loop(problem, point.theta, point.omega_S, point.omega_T, "")


def _machine(problem: CoDesignProblem, point: FrontPoint) -> Place:
    drawing = plant_of(problem).drawing
    if drawing is None:
        return machine(problem, point.theta)
    shown = drawing({"": point.theta}).drawing
    if isinstance(shown, Lines):
        return shown.rows[0][0]
    return None if isinstance(shown, Landscape) else shown


def _words(problem: CoDesignProblem, point: FrontPoint) -> str:
    theta = dict(zip(problem.names, point.theta, strict=True))
    named = theta_words({"theta": theta, "units": problem.parameter_units})
    state = "verified" if point.verified else "not verified"
    held = f"; at {', '.join(point.active)}" if point.active else ""
    return (
        f"f = {f'{number(point.hardware_cost, 4)} {problem.cost_unit}'.strip()}, {named}: "
        f"{number(point.bandwidth / HZ, 4)} Hz, {state}{held}."
    )
