"""What the co-design changed: the best loop of the hardware that it began with, beside its own."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.drawing.content import Curve, Figure, Level, Lines, Panel, Section, Table, Words
from ccd_casadi.drawing.svg import BLUE, GREY, ORANGE
from ccd_casadi.inner_problem.design_loops import design_view
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant, true_inner
from ccd_casadi.lti.closed_loop import largest
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.reporting.loops import bandwidth_level, over_hz, sensitivity_panel
from ccd_casadi.support.units import HZ, number, shown_unit
from ccd_casadi.synthesis.synthesis import Design, synthesise

if TYPE_CHECKING:
    from ccd_casadi.codesign.verified_mixed import VerifiedDesign

HEADING = "Start against optimum"
SAME = 1e-6  # of the box: an optimum this close to the start is the start
HEIGHTS = (3.0, 3.0)  # inches


@dataclass(frozen=True)
class _Side:
    """One θ: name, colour, f, the loop over frequency, its poles in 1/s."""

    name: str
    colour: str
    theta: tuple[float, ...]
    cost: float
    loop: LoopView
    poles: np.ndarray

    def objective(self, problem: CoDesignProblem) -> float:
        return problem.w1 * self.cost + problem.w2 * HZ * self.loop.bandwidth_hz

    @property
    def resonance(self) -> float:
        """The first flexible one in Hz; NaN where there is none."""
        return min(self.loop.resonances_hz, default=np.nan)


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
    rows = ((_gains(problem, sides),), (_plants(sides), _pole_map(sides)))
    figure = Figure(Lines(rows, HEADING, HEIGHTS), _caption(sides), (_poles_table(sides),))
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
    return _Side(name, colour, theta, cost, loop, loop.loop.poles)


def _gains(problem: CoDesignProblem, sides: tuple[_Side, ...]) -> Panel:
    curves = tuple(Curve(s.loop.hz, s.loop.gains[0], s.name, s.colour) for s in sides)
    at = [bandwidth_level(s.loop.bandwidth_hz, s.colour) for s in sides]
    return sensitivity_panel(curves, sides[0].loop.ends, problem.inner.S_max, at)


def _plants(sides: tuple[_Side, ...]) -> Panel:
    curves = [Curve(s.loop.hz, largest(s.loop.plant), s.name, s.colour) for s in sides]
    return over_hz("σ_max(G) (m/N)", curves, sides[0].loop.ends)


def _pole_map(sides: tuple[_Side, ...]) -> Panel:
    curves = tuple(
        Curve(hz, zeta, s.name, s.colour, line="", marker="x")
        for s in sides
        for hz, zeta in [_frequency_and_damping(s.poles)]
    )
    return Panel("|pole| (Hz)", "damping ratio of the loop's poles (–)", curves,
                 levels=(Level(0.0, "unstable below", colour=GREY),), log_x=True,
                 y_range=(-0.1, 1.1), legend=None)  # fmt: skip


def _frequency_and_damping(poles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """|p| in Hz and -Re p/|p|, a conjugate pair once, in rising order."""
    upper = poles[poles.imag >= 0.0]
    upper = upper[np.argsort(np.abs(upper))]
    size = np.abs(upper)
    return size / HZ, -upper.real / np.maximum(size, np.finfo(float).tiny)


def _caption(sides: tuple[_Side, ...]) -> str:
    start, end = sides
    gained = 100.0 * (end.loop.bandwidth_hz / start.loop.bandwidth_hz - 1.0)
    cost = 100.0 * (end.cost / start.cost - 1.0) if start.cost else np.nan
    spared = f", f changes by {cost:+.3g} %" if np.isfinite(cost) else ""
    return (
        f"Each hardware with its own best controller. From the start to the optimum the bandwidth "
        f"changes by {gained:+.3g} %{spared}. Poles of the closed loops by size and damping "
        f"ratio; the least damped one has {number(_least(start), 2)} at the start and "
        f"{number(_least(end), 2)} at the optimum."
    )


def _least(side: _Side) -> float:
    return float(_frequency_and_damping(side.poles)[1].min())


def _table(problem: CoDesignProblem, sides: tuple[_Side, ...]) -> Table:
    rows = []
    for i, name in enumerate(problem.names):
        unit, factor = shown_unit(problem.units[i], problem.upper[i])
        rows.append((name, unit or "–", *(factor * s.theta[i] for s in sides)))
    rows += [
        ("hardware cost f", problem.cost_unit or "–", *(s.cost for s in sides)),
        ("first resonance", "Hz", *(s.resonance for s in sides)),
        ("bandwidth ω_b", "Hz", *(s.loop.bandwidth_hz for s in sides)),
        ("objective J", "–", *(s.objective(problem) for s in sides)),
    ]
    return Table(("", "unit", "start", "optimum"), tuple(rows))


def _poles_table(sides: tuple[_Side, ...]) -> Table:
    rows = [
        (s.name, float(hz), float(zeta))
        for s in sides
        for hz, zeta in zip(*_frequency_and_damping(s.poles), strict=True)
    ]
    return Table(("loop", "Hz", "damping ratio"), tuple(rows))
