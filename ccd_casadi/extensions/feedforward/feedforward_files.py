"""What a feedforward for a set leaves in its folder: JSON, C code, words, a page, a log."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.analysis.setpoint import Setpoint
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.realisation import literals
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREY
from ccd_casadi.extensions.feedforward.coefficients import (
    MoveResponses,
    Shape,
    learn,
    learning_gain,
    responses_of,
)
from ccd_casadi.extensions.feedforward.set_feedforward import SetFeedforward
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.lti.loop import Loop
from ccd_casadi.reporting.facts import run_name
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.text import display_unit, plural, spoken, template, with_unit

CODE = ("feedforward.h", "feedforward.c")
OF_DESIGN = ("settled", "settled_model", "kept", "heat", "peak_force")  # unknown once it learns


def entry(found: SetFeedforward, axis: int) -> dict[str, Any]:
    """The content of feedforward.json, SI.

    Parameters
    ----------
    found : SetFeedforward
    axis : int
        From 1.

    Returns
    -------
    dict
        `shaper` is h (taps,), `forces` F (taps, 5, m) by tap and derivative of the setpoint.
    """
    shape, time = found.found.shape, found.found.time
    h, F = shape.split(found.found.x)
    return json_values({
        "axis": axis, "period": found.responses[0].period, "samples": len(found.responses[0].force),
        "orders": list(shape.orders), "taps": shape.taps, "spacing": shape.spacing,
        "shaper": h.tolist(), "forces": F.tolist(),
        "setpoint": {"durations": found.profile.durations.real.tolist(),
                     "snaps": found.profile.snaps.real.tolist()},
        "window": found.window, "duration": found.profile.duration,
        "settled": found.latest, "settled_model": float(found.settled[0]), "designed_for": time,
        "settled_inverse": found.latest_inverse,
        "settled_inverse_model": float(found.settled_inverse[0]),
        "plants": len(found.responses), "judged": len(found.judged), "kept": found.kept,
        "heat": found.heat, "heat_inverse": found.limits.heat,
        "peak_force": found.peak, "peak_force_inverse": found.limits.peak,
        "contraction": found.contraction, "learned": 0,
    })  # fmt: skip


def summary(found: SetFeedforward) -> list[str]:
    """The lines that the command prints."""
    shape = found.found.shape
    taps = "none" if shape.taps == 1 else (
        f"{shape.taps} taps {1e3 * shape.spacing * found.responses[0].period:.4g} ms apart: "
        + ", ".join(f"{value:.4g}" for value in shape.split(found.found.x)[0])
    )  # fmt: skip
    judged = (
        f"{found.kept} of {plural(len(found.judged), 'plant')} drawn from the set have settled "
        f"by {1e3 * found.found.time:.4g} ms" if len(found.judged)
        else "not judged: the case has no set to draw plants from"
    )  # fmt: skip
    rows = {
        "move": move_words(found),
        "latest plant": f"{in_ms(found.latest)} with this feedforward, "
        f"{in_ms(found.latest_inverse)} with the model's inverse",
        "model": f"{in_ms(found.settled[0])}, {in_ms(found.settled_inverse[0])} with its inverse",
        "judged": judged,
        "shaper": taps,
        "forces": f"peak {found.peak:.4g} {spoken('N')} (inverse {found.limits.peak:.4g}), heat "
        f"{100.0 * found.heat / found.limits.heat:.3g} % of the inverse's",
        "learning": f"an error of the coefficients falls to {100.0 * found.contraction:.3g} % or "
        "less with each move, on every plant of the design" if found.contraction < 1.0
        else "does not converge on every plant of the set: do not use --learn",
    }  # fmt: skip
    return [f"{name:14s}{words}" for name, words in rows.items()]


def move_words(found: SetFeedforward) -> str:
    """`10 mm in 180 ms, settled within ±1 µm`."""
    unit = spoken("m")
    far = with_unit(float(np.abs(found.responses[0].end).max()), unit)
    window = with_unit(found.window, unit)
    return f"{far} in {1e3 * found.profile.duration:.4g} ms, settled within ±{window}"


def place_words(run: FinishedRun) -> str:
    """What a reader must know where the error counts elsewhere than at the sensor; else empty."""
    if "performance" not in plant_of(run.problem).ports:
        return ""
    return "figures are of the sensor's position, not of `performance`, where the error counts"


def in_ms(seconds: float) -> str:
    """A time, which may be infinite, in words."""
    return f"{1e3 * seconds:.4g} ms" if np.isfinite(seconds) else "not within what was simulated"


def write_code(folder: Path, answer: Mapping[str, Any]) -> None:
    """Write feedforward.h and feedforward.c of the content of feedforward.json."""
    h, F = np.array(answer["shaper"]), np.array(answer["forces"])
    values = {
        "taps": len(h), "spacing": answer["spacing"], "m": F.shape[2], "h": literals(h, 4),
        "F": literals(F, 4), "last": (len(h) - 1) * answer["spacing"], "period": answer["period"],
    }  # fmt: skip
    for name in CODE:
        text = template(f"extensions/feedforward/templates/{name}").render(values)
        (folder / name).write_text(text, "utf-8")


def read_error(log: Path, period: float) -> Array:
    """The error of a move (N, q) from the columns `error`, or error1, error2, ..., of a CSV file.

    `period` is from line to line in s; a column `time` has to agree. Raises UserError where there
    is no such column, one has another unit or rate, or a value is not a number.
    """
    if not log.exists():
        raise UserError(f"{log}: there is no such file; give the log of a move")
    if not log.stat().st_size:
        raise UserError(f"{log}: is empty; its first line names the columns")
    try:
        table = np.atleast_1d(np.genfromtxt(log, delimiter=",", names=True, dtype=float))
    except (ValueError, IndexError) as why:
        words = str(why).strip().splitlines()[:2]
        raise UserError(f"{log}: is not a table of numbers: {' '.join(words)}") from None
    names = sorted((name for name in table.dtype.names or () if name.startswith("error")),
                   key=lambda name: int(name[5:]) if name[5:].isdigit() else 0)  # fmt: skip
    other = next((name for name in names if name[5:] and not name[5:].isdigit()), None)
    if other is not None:
        raise UserError(f"{log}: column {other!r}: name it error, or error1, error2, ..., in m")
    if not names:
        raise UserError(f"{log}: has no column `error`; its first line names the columns")
    error = np.column_stack([table[name] for name in names])
    if not np.isfinite(error).all():
        row = int(np.flatnonzero(~np.isfinite(error).all(axis=1))[0])
        raise UserError(f"{log}: line {row + 2}: the error is not a finite number")
    if "time" in (table.dtype.names or ()):
        _require_rate(log, table["time"], period)
    return error


def _require_rate(log: Path, time: Array, period: float) -> None:
    """Refuse times of another rate, or with lost samples; half a period is for their digits."""
    wrong = ~(np.abs(time - time[0] - period * np.arange(len(time))) < 0.5 * period)
    if wrong.any():
        row = int(np.flatnonzero(wrong)[0])
        raise UserError(
            f"{log}: line {row + 2}: column 'time' is not in steps of {period:.6g} s; record every "
            "sample of the controller, with its time in s"
        )


def improve(
    run: FinishedRun, path: Path, before: Mapping[str, Any], error: Array
) -> tuple[dict[str, Any], list[str]]:
    """Coefficients after a move of the machine.

    Parameters
    ----------
    run : FinishedRun
    path : Path
        Of feedforward.json, for messages.
    before : mapping
        Its content.
    error : (N, q) array
        The controller's, e = r̃ - y, from the first sample of the move on, unit of y.

    Returns
    -------
    dict
        The new content of feedforward.json.
    list of str
        Lines that say what changed.
    """
    F = np.array(before["forces"])
    shape = Shape(tuple(before["orders"]), F.shape[2], before["taps"], before["spacing"])
    durations, snaps = (np.array(before["setpoint"][name]) for name in ("durations", "snaps"))
    profile = Setpoint(durations, snaps, np.nan, np.nan, np.nan)  # the largest are not needed
    if not before["contraction"] < 1.0:
        raise UserError(f"{path}: learning does not converge on every plant of its set")
    if run.loop.at or run.loop.names != Loop.names:
        words = "learning is for loops whose error counts at their sensors, one for each actuator"
        raise UserError(f"{path}: {words}")
    own = replace(run.loop, drive=None, counted=None)  # the log has the error that K reads
    model = responses_of(own, profile, shape.orders, axis=before["axis"] - 1,
                         samples=before["samples"])  # fmt: skip
    count, q = model.reached.shape[:2]
    if error.shape[1] != q:
        words = f"{plural(error.shape[1], 'column')} of error; this plant has {q}"
        raise UserError(f"{path}: the log has {words}")
    if len(error) * model.period < profile.duration:
        raise UserError(f"{path}: the log ends before the setpoint; record longer")
    far, largest = float(np.abs(model.end).max()), float(np.abs(error).max())
    if largest > far:
        words = f"the error in the log is up to {largest:.4g} {spoken('m')}, the move {far:.4g}"
        raise UserError(f"{path}: {words}; give the error in {spoken('m')}")
    count = min(count, len(error))
    model = replace(model, reached=model.reached[:count])
    shaped = model.with_taps(shape)
    x = learn(shape.join(np.array(before["shaper"]), F), error[:count],
                learning_gain(shaped, shape), shape)  # fmt: skip
    rms, moves = float(np.sqrt(np.mean(error**2))), before["learned"] + 1
    new = {"forces": shape.split(x)[1].tolist(), "learned": moves} | dict.fromkeys(OF_DESIGN)
    return json_values(dict(before) | new), [
        f"learned       from move {moves}, RMS of its error {with_unit(rms, spoken('m'))}",
        "judged        unknown: the page and its plants judge those before",
        f"coefficients  {path}, and feedforward.c beside it",
    ]  # fmt: skip


@dataclass(frozen=True)
class FeedforwardPageOptions:
    """Numbers of the page."""

    shown: int = 12  # plants of which a curve is drawn
    least: float = 1e-3  # of the window: a smaller error is drawn there


def feedforward_page(run: FinishedRun, found: SetFeedforward, index: str = "") -> c.Page:
    """Make report.html; `index` is the address of the page that links all pages of the run."""
    good = found.kept == len(found.judged)
    drawn = f"{found.kept} of {len(found.judged)} plants drawn from the set settle in time"
    lead = (
        f"A move of {move_words(found)}: the latest plant of the set settles after "
        f"{in_ms(found.latest)}; with the model's inverse as feedforward, "
        f"{in_ms(found.latest_inverse)}. The largest heat is "
        f"{100.0 * found.heat / found.limits.heat:.4g} %, and the largest force "
        f"{100.0 * found.peak / found.limits.peak:.4g} %, of what the inverse needs."
    )
    if place := place_words(run):
        lead += f" All {place}."
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

    shaped = [plant.with_taps(found.found.shape) for plant in some]
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
