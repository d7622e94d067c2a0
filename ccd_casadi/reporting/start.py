"""What the co-design changed: the best loop of the hardware that it began with, beside its own."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView, frequency_and_damping
from ccd_casadi.drawing.content import Chapter, Curve, Figure, Level, Lines, Panel, Table, Words
from ccd_casadi.drawing.svg import CYCLE, GREY
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, true_inner
from ccd_casadi.lti.closed_loop import sigma_max
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.reporting.facts import paragraph, theta_axes
from ccd_casadi.reporting.loops import gain_panels, over_hz, synthesised_loop, view_of
from ccd_casadi.support.units import HZ, spoken

if TYPE_CHECKING:
    from ccd_casadi.codesign.verified_mixed import VerifiedDesign

HEADING = "Start against optimum"
SAME = 1e-6  # of the box: an optimum this close to the start is the start
HEIGHTS = (3.0, 3.0)  # inches


def start_chapter(problem: CoDesignProblem, verified: "VerifiedDesign") -> list[Chapter]:
    """Both as figures, poles and a table; nothing where the run did not leave its start.

    At the start the true inner problem is solved, so that each hardware has its best controller.
    """
    width = np.subtract(problem.upper, problem.lower)
    if (np.abs(np.subtract(verified.theta, problem.start)) <= SAME * width).all():
        return []
    found = true_inner(problem, problem.start)
    if found.optimum is None:
        words = f"The hardware that the run began with has no feasible loop: {found.shortfall}."
        return [Chapter(HEADING, (Words(words),))]
    f = found.optimum.figures
    start = synthesised_loop(problem, problem.start, f.omega_S, f.omega_T, "start")
    loops = (start, replace(view_of(verified), label="optimum"))
    thetas = (problem.start, verified.theta)
    costs = [hardware_cost(plant_of(problem), theta) for theta in thetas]
    poles = [_roots(loop) for loop in loops]
    lines = Lines(_panels(loops[::-1]), HEADING, HEIGHTS)
    least = [float(damping.min()) for _, damping in poles]
    gained = 100.0 * (loops[1].bandwidth_hz / start.bandwidth_hz - 1.0)
    spared = 100.0 * (costs[1] / costs[0] - 1.0) if costs[0] else None
    words = paragraph("report.start", gained, spared, least)
    beside = _table(problem, thetas, loops, costs)
    return [Chapter(HEADING, (Figure(lines, words), beside))]


def _roots(loop: LoopView) -> tuple[np.ndarray, np.ndarray]:
    """|p| in Hz and -Re p/|p| of the loop's poles, a conjugate pair once, in rising order."""
    return frequency_and_damping(loop.loop.poles / HZ)


def _panels(loops: Sequence[LoopView]) -> tuple[tuple[Panel, ...], ...]:
    """S over the plants and the poles of the loops."""
    coloured = list(zip(loops, CYCLE, strict=False))
    G = [Curve(v.hz, sigma_max(v.plant), v.label, colour) for v, colour in coloured]
    poles = tuple(Curve(*_roots(v), v.label, colour, "", "x") for v, colour in coloured)
    pole_map = Panel(
        "|pole| (Hz)", "damping ratio of the loop's poles (–)", poles, log_x=True, legend=None,
        levels=(Level(0.0, "unstable below", colour=GREY),), y_range=(-0.1, 1.1),
    )  # fmt: skip
    S = gain_panels(loops, bounds=False)[0]
    return (S,), (over_hz(spoken(f"{loops[0].named('G')} (m/N)"), G, loops[0].ends), pole_map)


def _table(
    problem: CoDesignProblem, thetas: Sequence[Sequence[float]], loops: Sequence[LoopView],
    costs: Sequence[float],
) -> Table:  # fmt: skip
    hz = [loop.bandwidth_hz for loop in loops]
    J = [problem.w1 * f + problem.w2 * HZ * v for f, v in zip(costs, hz, strict=True)]
    first = [min(loop.resonances_hz, default=np.nan) for loop in loops]
    rows = [
        (name, unit or "–", *(factor * theta[i] for theta in thetas))
        for i, (name, unit, factor) in enumerate(theta_axes(problem))
    ]
    rows += [
        ("hardware cost f", problem.cost_unit or "–", *costs), ("first resonance", "Hz", *first),
        ("bandwidth ω_b", "Hz", *hz), ("objective J", "–", *J),
    ]  # fmt: skip
    return Table(("", "unit", "start", "optimum"), tuple(rows))
