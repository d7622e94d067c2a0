"""A point-to-point move of a controller of fixed structure on every plant of its set."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ccd_casadi.analysis.loop import Loop
from ccd_casadi.analysis.move import Move, mass_feedforward, moves
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.inner_problem.sections_plant_set import plants_of, sections_of_problem
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.reporting.lines import Band, Curve, Level, Panel, figure_lines
from ccd_casadi.reporting.page import Table, figure_html, number
from ccd_casadi.reporting.svg import BLUE, GREY
from ccd_casadi.reporting.tables import over_time
from ccd_casadi.robust.demands import Demands
from ccd_casadi.support.units import HZ

if TYPE_CHECKING:
    from ccd_casadi.codesign.verified_sections import VerifiedSections

AFTER = 1.0  # of the move's duration, that is shown after its end
POINTS = 600


def move_panels(verified: "VerifiedSections") -> tuple[list[Panel], str, Table]:
    """Error of the default move of `robustness`, without and with mass feedforward; words, data."""
    problem, made = verified.problem, verified.design
    assert made.controller is not None
    sampling = sections_of_problem(problem).sampling
    demands = Demands()
    profile = setpoint(demands.limits)
    released = replace(problem, suspension=Suspension(0.0, 0.0))
    modal = modal_plant(mechanics(plant_of(problem), verified.theta), released.suspension)
    ahead = mass_feedforward(modal, demands.axis)
    ways = {"without feedforward": None} | ({} if ahead is None else {"mass feedforward": ahead})
    suspended, free = (
        [Loop(plant.plant_si(), made.controller, sampling)
         for plant in plants_of(of, verified.theta)]
        for of in (problem, released)
    )  # fmt: skip
    found = moves(suspended, free, tuple(ways.values()), profile, axis=demands.axis,
                  window=demands.window, bandwidth_hz=made.bandwidth / HZ)  # fmt: skip
    end = profile.duration
    time = np.linspace(0.0, (1.0 + AFTER) * end, POINTS)
    panels, words = [], []
    columns = [1e3 * time]
    heads = ["ms"]
    for name, made_so in zip(ways, found, strict=True):
        error = 1e6 * np.array([np.interp(time, move.time, move.error) for move in made_so])
        panels.append(Panel(
            "time (ms)", f"error (µm), {name}", (Curve(1e3 * time, error[0], "the model", BLUE),),
            (Band(1e3 * time, error.min(axis=0), error.max(axis=0), "all plants"),),
            levels=(Level(1e3 * end, "end of the move", True, GREY),), legend="upper right",
        ))  # fmt: skip
        columns += [error[0], error.min(axis=0), error.max(axis=0)]
        heads += [f"µm, {name}", "least", "largest"]
        words.append(_words(name, made_so))
    how = "continuous loop" if sampling is None else "hold and delay exact, at the instants"
    stroke = number(1e3 * demands.limits.stroke)
    where = "on plants without the suspension" if found[0][0].free else "on the suspended plants"
    caption = (
        f"{stroke} mm in {number(1e3 * end, 4)} ms {where} ({how}; for other moves the options of "
        f"robustness). {' '.join(words)}"
    )
    return panels, caption, over_time(heads, *columns)


def move_html(panels: list[Panel], caption: str, table: Table) -> str:
    """What `move_panels` found, as a figure."""
    svg = figure_lines([panels], key="sections-move", heights=(3.2,),
                       title="Error of a move on every plant of the set")  # fmt: skip
    return figure_html(svg, caption, table)


def _words(name: str, moves: list[Move]) -> str:
    latest = max(move.settling for move in moves)
    settled = (
        f"settles within ±{number(1e6 * moves[0].window)} µm {number(1e3 * latest, 3)} ms after "
        "the end at the latest"
        if np.isfinite(latest)
        else "does not settle on all plants while it is watched"
    )
    peak = 1e6 * max(move.peak_error for move in moves)
    force = max(float(move.peak_force.max()) for move in moves)
    return (
        f"{name[0].upper()}{name[1:]}: error of at most {number(peak, 3)} µm, {settled}, "
        f"{number(force, 4)} N at most."
    )
