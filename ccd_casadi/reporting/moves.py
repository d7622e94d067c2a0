"""A move and a step of force of a design on every plant of its set; a move on the machine."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.analysis import LIMITS
from ccd_casadi.analysis.loop_figures import force_response, largest_force_step, rest_time
from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.analysis.move import Move, moves
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.analysis.setpoint_feedforward import feedforward_of, forward_force
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.paint import tables_of
from ccd_casadi.drawing.svg import BLACK, BLUE, GREEN, GREY, ORANGE
from ccd_casadi.inner_problem.kinds import member_loops
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.lti.loop import Loop
from ccd_casadi.reporting.facts import paragraph
from ccd_casadi.reporting.gain_figures import of_plants
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, display_unit, spoken, with_unit

if TYPE_CHECKING:  # a move on the machine is of `deploy`
    from ccd_casadi.deployment.on_hardware import OnHardware

POINTS = 600
STEPS = 200  # points of a force step, and again as many about its beginning
DRAWN = 1200  # points of a curve of a move on the machine
FLAT = 30.0  # an error so many times smaller than another is flat beside it
MASS_ERRORS = (-0.01, 0.01)  # relative, of what feedforward takes the mass for
COLOURS = (GREY, BLUE, ORANGE, GREEN, BLACK)
FIGURES: dict[str, Callable[[Move], float]] = {  # of a move, in a table
    "settled after, ms": lambda m: 1e3 * m.settled,
    "RMS error, µm": lambda m: 1e6 * m.rms_error,
    "peak error, µm": lambda m: 1e6 * m.peak_error,
    "largest error of the last quarter, µm": lambda m: 1e6 * m.last_error(0.25),
    "peak force, N": lambda m: float(m.peak_force.max()),
    "at the limit, %": lambda m: 100.0 * m.saturated,
}


def move_blocks_of(
    problem: CoDesignProblem, theta: Sequence[float], view: LoopView
) -> tuple[c.Figure, c.Table]:
    """The case's move, or the default one of `robustness`, on all plants of a design, their rigid
    bodies free: without and with feedforward, and a table of plant by feedforward."""
    loops = view.loops
    if problem.source.motion is not None:
        from ccd_casadi.inner_problem.structured_bandwidth import motion_of

        motion = motion_of(problem, theta)
        profile, window = motion.cycle.profile, motion.motion.window
        ahead: Array | None = motion.forward
        other = ", that of [move]"
    else:
        profile, window = setpoint(LIMITS), LIMITS.window
        other, ahead = "; set your own under [move]", feedforward_of(loops[0], 0)
    ways: dict[str, Array | None] = {"without feedforward": None}
    if ahead is not None:
        ways["with feedforward up to snap"] = ahead
    found = moves(loops, tuple(ways.values()), profile, axis=0, window=window,
                  bandwidth_hz=view.bandwidth_hz)  # fmt: skip
    end = profile.duration
    mm = 1e3 * float(profile.at(np.array([end]))[0, 0])
    made = (mm, 1e3 * end, other, loops[0].sampling is not None, len(loops) > 1)
    words = paragraph("report.move", *made)
    rows = []
    for name, each in zip(ways, found, strict=True):
        rows.append((name, "the model", each[0]))
        if len(each) > 1:
            rows.append((name, "the worst of its set", max(each, key=lambda m: m.peak_error)))
    if ahead is not None:
        wrong = [(1.0 + off) * ahead for off in MASS_ERRORS]
        tried = moves(loops[:1], wrong, profile, axis=0, window=window,
                      bandwidth_hz=view.bandwidth_hz)  # fmt: skip
        rows += [
            (name, f"the model, feedforward {100.0 * off:+g} %", each[0])
            for off, each in zip(MASS_ERRORS, tried, strict=True)
        ]
    made_ways = ways_figure(dict(zip(ways, found, strict=True)), words)
    return made_ways, _move_table(rows)


def _move_table(rows: Sequence[tuple[str, str, Move]]) -> c.Table:
    """One error of one move for each feedforward and plant."""
    unit, scale = display_unit(spoken("m"), max(move.peak_error for *_, move in rows))
    window = with_unit(rows[0][2].window, spoken("m"))
    head = ("feedforward", "plant", f"peak error ({unit})", f"within ±{window} from (ms)",
            spoken("peak force (N)"))  # fmt: skip
    return c.Table(head, tuple(
        (way, plant, scale * move.peak_error, 1e3 * move.settled, float(move.peak_force.max()))
        for way, plant, move in rows
    ))  # fmt: skip


def cycle_chapter(
    problem: CoDesignProblem, theta: Sequence[float], result: Mapping[str, Any]
) -> list[c.Chapter]:
    """Force and heat over a cycle of the case's move, what limits it, and its time over the heat
    that is allowed; nothing for a case without a motor."""
    own, shown = problem.source.motion, result.get("move")
    if own is None or own.motor is None or not shown:
        return []
    from ccd_casadi.analysis.motor import Motor, cycle_of
    from ccd_casadi.inner_problem.structured_bandwidth import motion_of

    found, motor = motion_of(problem, theta), own.motor
    profile, settled = found.cycle.profile, shown["settled_latest"]
    k, R, _ = motor.at(found.mass)
    time = np.linspace(0.0, profile.duration + own.dwell, POINTS)
    if problem.sampling is not None:  # what is held for a period from each of its instants on
        T = problem.sampling.period
        time = np.arange(np.ceil(time[-1] / T) + 1) * T
    r = profile.at(time)
    bodies = found.body_forces(r)  # behind an actuator the rest makes up for its lag
    force = bodies
    lagged = bool(problem.source.wiring.actuator)
    if not lagged:
        force = r.T @ found.forward
        if problem.sampling is not None:
            force = forward_force(profile, found.forward, time, problem.sampling.period)[1]
    heat = R / k**2 * (bodies**2).sum(axis=1)
    end = c.Level(1e3 * profile.duration, "end of the setpoint", vertical=True)
    mean = c.Level(shown["power"], "mean")
    ms, late = 1e3 * time, 0.0 if settled is None else settled - profile.duration
    worst = len(found.inertia) > 1 or found.motion.loads.gain > 0.0
    drawn = {"": force[:, 0]}
    if worst and not lagged:  # the heat is of the second
        drawn = {"feedforward, of the model": force[:, 0], "rigid body, worst plant": bodies[:, 0]}
    forces, currents = (
        tuple(c.Curve(ms, y / unit, label, colour)
              for (label, y), colour in zip(drawn.items(), (BLUE, ORANGE), strict=False))
        for unit in (1.0, k)
    )  # fmt: skip
    panels = [
        c.Panel("time (ms)", spoken("force of a motor (N)"), forces, levels=(end,)),
        c.Panel("time (ms)", "its current (A)", currents),
        c.Panel("time (ms)", "heat (W)", (c.Curve(ms, heat),), levels=(mean,)),
    ]
    if not own.required:
        watts = shown["power"] * np.linspace(0.1, 2.0, 39)
        limited = [replace(own, motor=replace(motor, rms_power=float(watt))) for watt in watts]
        times = [cycle_of(each, found.inertia, found.mass).profile.duration for each in limited]
        curve = c.Curve(watts, 1e3 * (np.array(times) + late))
        here = c.Level(shown["power"], "this design", vertical=True)
        panels.append(c.Panel("heat that is allowed (W)", "move and settling (ms)", (curve,),
                              levels=(here,)))  # fmt: skip
    settling = None if settled is None else late
    limited_force = motor.peak_current[0] < Motor.unlimited
    held = found.holding is not None
    known = (ms[-1], 1e3 * profile.duration, settling, limited_force, own.required, held, lagged,
             worst)  # fmt: skip
    words = paragraph("report.cycle", shown, *known)
    lines = c.Lines((tuple(panels[:2]), tuple(panels[2:])), "A cycle of the motor", (2.4, 2.4))
    return [c.Chapter("The motor", (c.Figure(lines, words),))]


def force_step(problem: CoDesignProblem, theta: Sequence[float], view: LoopView) -> c.Figure:
    """The position of every plant after a step of 1 N, of the pair that moves most."""
    K, bandwidth = view.loop.controller, HZ * view.bandwidth_hz
    loops = member_loops(problem, theta, K)
    most, seconds = largest_force_step(loops, bandwidth), max(map(rest_time, loops))
    drawn = []
    for loop in loops:
        t, y = force_response(loop, bandwidth, seconds)
        end = min(t[-1], seconds)
        spread = np.append(np.geomspace(t[1], end, STEPS)[:-1], np.linspace(0.0, end, STEPS)[:-1])
        kept = np.unique(np.searchsorted(t, [*spread, most.seconds]))
        drawn.append(y[most.actuator, most.output][kept])
    t, y = t[kept], np.array(drawn)
    unit, factor = display_unit(spoken("m"), most.size)
    curves, bands = of_plants(1e3 * t, factor * y)
    top = factor * y[most.plant, np.searchsorted(t, most.seconds)]
    mark = c.Mark(1e3 * most.seconds, top, with_unit(most.size, spoken("m")))
    step = f"y after a step of {spoken('1 N')} ({unit})"
    panel = c.Panel("time (ms)", step, curves, bands, marks=(mark,))
    scalar = view.scalar and loops[0].names == Loop.names
    words = paragraph("report.force", most, len(loops), scalar)
    lines = c.Lines(((panel,),), "A step of force", (3.2,))
    return c.Figure(lines, words)


def move_blocks(found: "OnHardware") -> tuple[c.Figure, c.Words]:
    """Error and force over time in every way, a table, and how much force the move needs."""
    ways = {words: [move] for words, move in found.ways.items()}
    words = "Free bodies are free. Hold and delay are exact."
    peak = max(float(move.peak_command.max()) for move in list(found.ways.values())[:2])
    limit = c.Words(paragraph("report.least_force", found, peak))
    return ways_figure(ways, words), limit


def ways_figure(ways: Mapping[str, Sequence[Move]], words: str) -> c.Figure:
    """Error and first force of one move made in several ways, each on one plant or on several, the
    model first, and a table of the largest; `words` end the caption."""
    made = list(ways.values())
    first, until = made[0][0], max(shown_until(m) for each in made for m in each)
    end = c.Level(1e3 * first.duration, "setpoint ends", vertical=True)
    peaks = [max(m.peak_error for m in each) for each in made]
    kept = [way for way in zip(ways, made, peaks, COLOURS, strict=False) if way[2] < 1e3 * peaks[0]]
    top = max(peak for _, _, peak, _ in kept)
    time = np.linspace(0.0, until, DRAWN)
    ms = 1e3 * time
    panels, force = [], []
    for large in (True, False):  # those that are flat beside the large ones by themselves
        same = [way for way in kept if (FLAT * way[2] > top) == large]
        most = max((peak for _, _, peak, _ in same), default=0.0)
        unit, scale = display_unit(spoken("m"), most)
        window = [c.Level(sign * scale * first.window, "window" if sign > 0 else "")
                  for sign in (1, -1) if most < FLAT * first.window]  # fmt: skip
        curves, bands = [], []
        for name, each, _, colour in same:
            error = scale * np.array([_over(time, e, _error(e)) for e in each])
            curves.append(c.Curve(ms, error[0], name, colour))
            force.append(c.Curve(ms, _over(time, each[0], each[0].force[:, 0]), name, colour))
            if len(each) > 1:
                bands.append(c.Band(ms, error.min(axis=0), error.max(axis=0), "", colour))
        if curves:
            panels.append(c.Panel("time (ms)", f"error ({unit})", tuple(curves), tuple(bands),
                                levels=(end, *window)))  # fmt: skip
            end = replace(end, text="")  # said once
    heights = (*[2.6] * len(panels), 2.2)
    panels.append(
        c.Panel("time (ms)", spoken("force 1 (N)"), tuple(force), levels=(end,), legend=None)
    )
    lines = c.Lines(tuple((panel,) for panel in panels), "Error and force of a move", heights)
    figures = dict(FIGURES)
    if first.command is not None:
        figures["peak command, N"] = lambda m: float(m.peak_command.max())
    rows = tuple(
        (name, *(max(map(read, each)) for read in figures.values())) for name, each in ways.items()
    )
    ends = "; ".join(way_words(*way, until) for way in ways.items())
    caption = (
        f"{ends[:1].upper()}{ends[1:]}. It has settled when its error stays within "
        f"{with_unit(first.window, spoken('m'))}. {words}"
    )
    table = c.Table(("way", *map(spoken, figures)), rows)
    return c.Figure(lines, caption, (table, *tables_of(lines)))


def _over(time: Array, m: Move, values: Array) -> Array:
    """A move's values at other times; NaN where it was watched no longer."""
    return np.interp(time, m.time, values, right=np.nan)


def _error(m: Move) -> Array:
    """Return the error of the moving output."""
    return m.error if m.error.ndim == 1 else np.asarray(m.error[:, 0])


def shown_until(found: Move) -> float:
    """Return the time in s at which the figure of a move ends."""
    return found.duration + max(0.5 * found.duration, min(found.settling, 2.0 * found.duration))


def _held(made: Move) -> float:
    return float(np.abs(made.force[-1]).max())


def way_words(name: str, made: Sequence[Move], until: float = np.inf) -> str:
    """Write how a move ends, and the error that is left after the end of its figure.

    Parameters
    ----------
    name : str
    made : sequence of Move
        On each plant.
    until : float
        End of the figure, s.

    Returns
    -------
    str
    """
    settled, peak = (max(getattr(m, of) for m in made) for of in ("settled", "peak_error"))
    late = [m for m in made if np.isinf(m.settled)]
    if any(not m.finite for m in made):
        return f"{name}: the simulation was lost, so whether it settles is not known"
    window, most_error = (with_unit(size, spoken("m")) for size in (made[0].window, peak))
    words = f"{name}: the error is at most {most_error}"
    if late:
        watched = with_unit(min(float(m.time[-1]) for m in late), "s")
        stays = any(m.rest > m.window for m in late)
        words += ", and does not settle" if stays else f", and has not settled within {watched}"
        words += f" ({with_unit(max(m.final_error for m in late), spoken('m'))} left)"
    elif settled:
        words += f", and within +-{window} from {with_unit(settled, 's')} on"
    else:
        words += f", always within +-{window}"
    held, most = (max(of(m) for m in made) for of in (_held, lambda m: m.peak_force.max()))
    if held > 0.5 * most:  # at the end of a move, as of a stage on springs
        words += f"; {with_unit(held, spoken('N'))} hold the stage there"
    after = np.abs(np.concatenate([_error(m)[m.time > until] for m in made]))
    if not after.size or settled <= until:
        return words
    left = with_unit(float(after.max()), spoken("m"))
    return f"{words} ({left} left where the figure ends)"
