"""What the co-design changed: the best loop of the hardware that it began with, beside its own."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView, frequency_and_damping
from ccd_casadi.drawing.content import Curve, Figure, Level, Lines, Panel, Section, Table, Words
from ccd_casadi.drawing.svg import BLUE, GREY, ORANGE
from ccd_casadi.inner_problem.design_loops import design_view
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant, true_inner
from ccd_casadi.lti.closed_loop import largest
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.reporting.facts import theta_axes
from ccd_casadi.reporting.loops import bandwidth_level, over_hz, sensitivity_panel
from ccd_casadi.support.units import HZ, number
from ccd_casadi.synthesis.synthesis import Design, synthesise

if TYPE_CHECKING:
    from ccd_casadi.codesign.verified_mixed import VerifiedDesign

HEADING = "Start against optimum"
SAME = 1e-6  # of the box: an optimum this close to the start is the start
HEIGHTS = (3.0, 3.0)  # inches


@dataclass(frozen=True)
class _Side:
    """One θ: its name and colour, f, the loop over frequency."""

    name: str
    colour: str
    theta: tuple[float, ...]
    cost: float
    loop: LoopView

    @property
    def roots(self) -> tuple[np.ndarray, np.ndarray]:
        """|p| in Hz and -Re p/|p| of the loop's poles, a conjugate pair once, in rising order."""
        return frequency_and_damping(self.loop.loop.poles / HZ)


def start_section(problem: CoDesignProblem, verified: "VerifiedDesign") -> list[Section]:
    """Both as figures, poles and a table; nothing where the run did not leave its start.

    At the start the true inner problem is solved, so that each hardware has its best controller.
    """
    width = np.subtract(problem.upper, problem.lower)
    if (np.abs(np.subtract(verified.theta, problem.start)) <= SAME * width).all():
        return []
    found = true_inner(problem, problem.start)
    if found.optimum is None:
        words = f"The hardware that the run began with has no feasible loop: {found.shortfall}."
        return [Section(HEADING, (Words(words),))]
    made = synthesise(
        scaled_plant(problem, problem.start),
        problem.weights.at(found.optimum.figures.omega_S, found.optimum.figures.omega_T),
        omega_low=problem.inner.omega_low, gamma_backoff=problem.inner.gamma_backoff,
    )  # fmt: skip
    sides = (
        _side(problem, "start", ORANGE, problem.start, made),
        _side(problem, "optimum", BLUE, verified.theta, verified.design),
    )
    lines = Lines(_panels(problem, sides), HEADING, HEIGHTS)
    poles = [(s.name, float(hz), float(z)) for s in sides for hz, z in zip(*s.roots, strict=True)]
    table = Table(("loop", "Hz", "damping ratio"), tuple(poles))
    figure = Figure(lines, _caption(sides), (table,))
    return [Section(HEADING, (figure, _table(problem, sides)))]


def _side(
    problem: CoDesignProblem, name: str, colour: str, theta: tuple[float, ...], design: Design
) -> _Side:
    f = design.figures
    loop = design_view(
        problem, theta, design.controller, weights=problem.weights.at(f.omega_S, f.omega_T),
        gamma=f.gamma, bandwidth_hz=f.bandwidth / HZ, label=name,
    )  # fmt: skip
    cost = hardware_cost(plant_of(problem), theta)
    return _Side(name, colour, theta, cost, loop)


def _panels(problem: CoDesignProblem, sides: tuple[_Side, ...]) -> tuple[tuple[Panel, ...], ...]:
    """S over the plants and the poles of the loops."""
    ends, named = sides[0].loop.ends, sides[0].loop.named
    S = [Curve(s.loop.hz, s.loop.gains[0], s.name, s.colour) for s in sides]
    G = [Curve(s.loop.hz, largest(s.loop.plant), s.name, s.colour) for s in sides]
    poles = tuple(Curve(*s.roots, s.name, s.colour, line="", marker="x") for s in sides)
    at = [bandwidth_level(s.loop.bandwidth_hz, s.colour) for s in sides]
    pole_map = Panel(
        "|pole| (Hz)", "damping ratio of the loop's poles (–)", poles, log_x=True, legend=None,
        levels=(Level(0.0, "unstable below", colour=GREY),), y_range=(-0.1, 1.1),
    )  # fmt: skip
    return (
        (sensitivity_panel(S, ends, problem.inner.S_max, at, f"{named('S')} (–)"),),
        (over_hz(f"{named('G')} (m/N)", G, ends), pole_map),
    )


def _caption(sides: tuple[_Side, ...]) -> str:
    start, end = sides
    least = [number(float(side.roots[1].min()), 2) for side in sides]
    gained = 100.0 * (end.loop.bandwidth_hz / start.loop.bandwidth_hz - 1.0)
    cost = 100.0 * (end.cost / start.cost - 1.0) if start.cost else np.nan
    spared = f", f changes by {cost:+.3g} %" if np.isfinite(cost) else ""
    return (
        f"Each hardware with its own best controller. From the start to the optimum the bandwidth "
        f"changes by {gained:+.3g} %{spared}. Poles of the closed loops by size and damping "
        f"ratio; the least damped one has {least[0]} at the start and "
        f"{least[1]} at the optimum."
    )


def _table(problem: CoDesignProblem, sides: tuple[_Side, ...]) -> Table:
    rows = [
        (name, unit or "–", *(factor * s.theta[i] for s in sides))
        for i, (name, unit, factor) in enumerate(theta_axes(problem))
    ]
    J = (problem.w1 * s.cost + problem.w2 * HZ * s.loop.bandwidth_hz for s in sides)
    rows += [
        ("hardware cost f", problem.cost_unit or "–", *(s.cost for s in sides)),
        ("first resonance", "Hz", *(min(s.loop.resonances_hz, default=np.nan) for s in sides)),
        ("bandwidth ω_b", "Hz", *(s.loop.bandwidth_hz for s in sides)),
        ("objective J", "–", *J),
    ]
    return Table(("", "unit", "start", "optimum"), tuple(rows))
