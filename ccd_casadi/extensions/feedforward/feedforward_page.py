"""The page of a feedforward for a set: what is left of the move on every plant, and the forces."""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREY
from ccd_casadi.extensions.feedforward.feedforward_files import in_ms, moved
from ccd_casadi.extensions.feedforward.move_responses import MoveResponses
from ccd_casadi.extensions.feedforward.set_feedforward import SetFeedforward
from ccd_casadi.reporting.facts import run_name
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import display_unit, spoken


@dataclass(frozen=True)
class FeedforwardPageOptions:
    """Numbers of the page.

    Attributes
    ----------
    shown : int
        Plants of which a curve is drawn.
    least : float
        Of the window: a smaller error is drawn there.
    """

    shown: int = 12
    least: float = 1e-3


def feedforward_page(run: FinishedRun, found: SetFeedforward, index: str = "") -> c.Page:
    """Make report.html.

    Parameters
    ----------
    run : FinishedRun
    found : SetFeedforward
    index : str
        Address of the page that links all pages of the run.

    Returns
    -------
    Page
    """
    good = found.kept == len(found.judged)
    drawn = f"{found.kept} of {len(found.judged)} plants drawn from the set settle in time"
    lead = (
        f"A move of {moved(found)}: the latest plant of the set settles after "
        f"{in_ms(found.latest)}; with the model's inverse as feedforward, "
        f"{in_ms(found.latest_inverse)}. The largest heat is "
        f"{100.0 * found.heat / found.limits.heat:.4g} %, and the largest force "
        f"{100.0 * found.peak / found.limits.peak:.4g} %, of what the inverse needs."
    )
    head = c.Head(
        f"Feedforward of {run_name(run.folder)}",
        "bad" if not good else "good" if len(found.judged) else "warn",
        "not verified" if not good else "settles on the set" if len(found.judged)
        else "not judged", "" if good else f"{drawn}.",
        f"{len(found.responses)} plants of the design; {drawn}" if len(found.judged)
        else f"{len(found.responses)} plants of the design, none drawn", lead,
    )  # fmt: skip
    h, F = found.found.shape.split(found.found.x)
    rows = [
        (1e3 * i * found.found.shape.spacing * found.responses[0].period, float(h[i]),
         *(float(value) for j in found.found.shape.orders for value in F[i, j]))
        for i in range(len(h))
    ]  # fmt: skip
    names = {0: "position (N/m)", 1: "velocity (N s/m)", 2: "acceleration (kg)",
             3: "jerk (kg s)", 4: "snap (kg s²)"}  # fmt: skip
    motors = [f", motor {k}" for k in range(1, F.shape[2] + 1)] if F.shape[2] > 1 else [""]
    per = (spoken(f"per {names[j]}{motor}") for j in found.found.shape.orders for motor in motors)
    table = c.Table(("delay (ms)", "of the setpoint (–)", *per), tuple(rows))
    return c.Page(head, (
        c.Chapter("The move on every plant", (_errors(found),)),
        c.Chapter("The coefficients", (table,)),
    ), index)  # fmt: skip


def _errors(
    found: SetFeedforward, options: FeedforwardPageOptions = FeedforwardPageOptions()
) -> c.Figure:
    first = found.responses[0]
    end = 1.3 * max(found.latest, found.profile.duration)
    late = found.latest_inverse if np.isfinite(found.latest_inverse) else end
    count = min(int(max(end, min(1.1 * late, 3.0 * end)) / first.period), len(first.force))
    ms = 1e3 * first.period * np.arange(count, dtype=float)
    unit, scale = display_unit(spoken("m"), found.window)
    chosen = np.unique(np.linspace(0, len(found.responses) - 1, options.shown).astype(int))
    some = [found.responses[i] for i in chosen]

    def left(plant: MoveResponses, x: Array) -> Array:
        error = np.abs(plant.error(x)).max(axis=1)[:count]
        return np.asarray(scale * np.maximum(error, options.least * found.window))

    def force(plant: MoveResponses, x: Array) -> Array:
        u = (plant.force @ x)[:count]
        return np.asarray(u[np.arange(len(u)), np.abs(u).argmax(axis=1)])

    shaped = [plant.shaped(found.found.shape) for plant in some]
    old = [c.Curve(ms, left(plant, found.inverse), "" if i else "the model's inverse", GREY,
                   width=0.7) for i, plant in enumerate(some)]  # fmt: skip
    new = [c.Curve(ms, left(plant, found.found.x), "" if i else "this feedforward", BLUE,
                   width=0.9) for i, plant in enumerate(shaped)]  # fmt: skip
    window = c.Level(scale * found.window, "window")
    done = c.Level(1e3 * found.profile.duration, "end of the setpoint", vertical=True)
    panels = (
        c.Panel("time (ms)", f"distance to the end ({unit})", (*old, *new),
                levels=(window, done), log_y=True),
        c.Panel("time (ms)", spoken("largest force of a motor (N)"),
                (c.Curve(ms, force(some[0], found.inverse), "the model's inverse", GREY),
                 c.Curve(ms, force(shaped[0], found.found.x), "this feedforward", BLUE)),
                levels=(done,)),
    )  # fmt: skip
    words = (
        f"Left: distance to the end of the move on {len(chosen)} of {len(found.responses)} plants "
        "of the design. Right: the force on the model."
    )
    return c.Figure(c.Lines((panels,), "The move", (3.4,)), words)
