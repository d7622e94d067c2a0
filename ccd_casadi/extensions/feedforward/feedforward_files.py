"""What a feedforward for a set leaves in its folder: JSON, C code, words; and the log of a move."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.analysis.setpoint import Setpoint
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.realisation import literals
from ccd_casadi.extensions.feedforward.learning import learned, learning_gain
from ccd_casadi.extensions.feedforward.move_responses import Shape, responses_of
from ccd_casadi.extensions.feedforward.set_feedforward import SetFeedforward
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.text import counted, spoken, template, with_unit

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
        f"{found.kept} of {counted(len(found.judged), 'plant')} drawn from the set have settled "
        f"by {1e3 * found.found.time:.4g} ms" if len(found.judged)
        else "not judged: the case has no set to draw plants from"
    )  # fmt: skip
    rows = {
        "move": moved(found),
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


def moved(found: SetFeedforward) -> str:
    """`10 mm in 180 ms, settled within ±1 µm`."""
    unit = spoken("m")
    far = with_unit(float(np.abs(found.responses[0].end).max()), unit)
    window = with_unit(found.window, unit)
    return f"{far} in {1e3 * found.profile.duration:.4g} ms, settled within ±{window}"


def in_ms(seconds: float) -> str:
    """A time, which may be infinite, in words."""
    return f"{1e3 * seconds:.4g} ms" if np.isfinite(seconds) else "not within what was simulated"


def write_code(folder: Path, answer: Mapping[str, Any]) -> None:
    """Write feedforward.h and feedforward.c.

    Parameters
    ----------
    folder : Path
    answer : mapping
        Of feedforward.json.
    """
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

    Parameters
    ----------
    log : Path
    period : float
        From line to line, s; a column `time` has to agree.

    Returns
    -------
    array (N, q)

    Raises
    ------
    UserError
        There is no such column, one has another unit or rate, or a value is not a number.
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


def improved(
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
    if run.loop.at or run.loop.ported:
        words = "learning is for loops whose error counts at their sensors, one for each actuator"
        raise UserError(f"{path}: {words}")
    model = responses_of(run.loop, profile, shape.orders, axis=before["axis"] - 1,
                         samples=before["samples"])  # fmt: skip
    count, q = model.reached.shape[:2]
    if error.shape[1] != q:
        words = f"{counted(error.shape[1], 'column')} of error; this plant has {q}"
        raise UserError(f"{path}: the log has {words}")
    if len(error) * model.period < profile.duration:
        raise UserError(f"{path}: the log ends before the setpoint; record longer")
    far, largest = float(np.abs(model.end).max()), float(np.abs(error).max())
    if largest > far:
        words = f"the error in the log is up to {largest:.4g} {spoken('m')}, the move {far:.4g}"
        raise UserError(f"{path}: {words}; give the error in {spoken('m')}")
    count = min(count, len(error))
    model = replace(model, reached=model.reached[:count])
    shaped = model.shaped(shape)
    x = learned(shape.joined(np.array(before["shaper"]), F), error[:count],
                learning_gain(shaped, shape), shape)  # fmt: skip
    rms, moves = float(np.sqrt(np.mean(error**2))), before["learned"] + 1
    new = {"forces": shape.split(x)[1].tolist(), "learned": moves} | dict.fromkeys(OF_DESIGN)
    return json_values(dict(before) | new), [
        f"learned       from move {moves}, RMS of its error {with_unit(rms, spoken('m'))}",
        "judged        unknown: the page and its plants judge those before",
        f"coefficients  {path}, and feedforward.c beside it",
    ]  # fmt: skip
