"""The designs along a front: the machine of each, behind a slider."""

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.pareto import Front, FrontPoint
from ccd_casadi.drawing.content import Landscape, Lines, Place, Steps
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.reporting.facts import theta_words
from ccd_casadi.reporting.glance import machine
from ccd_casadi.support.units import number

MOST = 12  # designs that are drawn


def front_walk(run: FinishedRun, front: Front) -> tuple[Steps]:
    """From the lightest to the fastest."""
    problem, points = run.problem, front.points
    chosen = np.unique(np.linspace(0, len(points) - 1, min(MOST, len(points))).round().astype(int))
    shown = [points[i] for i in chosen]
    drawn = (Lines(((_machine(problem, p), None),), "A design of the front") for p in shown)
    steps = tuple(zip([_words(problem, p) for p in shown], drawn, strict=True))
    own = float(run.result["hardware_cost"])
    first = int(np.argmin([abs(point.hardware_cost - own) for point in shown]))
    return (Steps(steps, first, "lightest to heaviest"),)


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
        f"{problem.figure.shown(point.value)}, {state}{held}."
    )
