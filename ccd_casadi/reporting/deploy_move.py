"""The part of deploy's page that shows the move on the machine."""

import numpy as np

from ccd_casadi.deployment.on_hardware import WATCHED, OnHardware
from ccd_casadi.drawing.content import Curve, Figure, Level, Lines, Panel, Table, Words
from ccd_casadi.drawing.svg import BLACK, BLUE, GREEN, GREY, ORANGE
from ccd_casadi.support.units import number

POINTS = 1200  # of a curve
COLOURS = (GREY, BLUE, ORANGE, GREEN, BLACK)


def move_blocks(found: OnHardware) -> tuple[Figure, Words]:
    """Error and force over time in every way, a table, and how much force the move needs."""
    shown = [way for way in found.ways if way.move.peak_error < 1e3 * found.ways[0].move.peak_error]
    error, force = [], []
    for way, colour in zip(found.ways, COLOURS, strict=False):
        if way not in shown:
            continue
        m = way.move
        at = np.unique(np.linspace(0, len(m.time) - 1, POINTS).astype(int))
        ms = 1e3 * m.time[at]
        error.append(Curve(ms, 1e6 * m.error[at, 0], way.words, colour))
        force.append(Curve(ms, m.force[at, 0], "", colour))
    end = Level(1e3 * found.profile.duration, "end of the setpoint", vertical=True)
    lines = Lines(
        ((Panel("time (ms)", "error (µm)", tuple(error), levels=(end,), legend="upper right"),),
         (Panel("time (ms)", "force 1 (N)", tuple(force), levels=(end,)),)),
        "A move of output 1, sampled with hold and delay", (3.0, 2.2),
    )  # fmt: skip
    head = ("way", "settled after, ms", "peak error, µm", "last error, µm", "peak force, N",
            "at the limit")  # fmt: skip
    rows = tuple(
        (
            way.words,
            "not" if np.isinf(way.move.settled) else number(1e3 * way.move.settled),
            1e6 * way.move.peak_error,
            1e6 * way.move.last_error(WATCHED),
            float(way.move.peak_force.max()),
            f"{100.0 * way.move.saturated:.3g} %",
        )
        for way in found.ways
    )
    caption = (
        "Settled: from the start until the error stays within "
        f"{number(1e6 * found.window)} µm; last error: the largest over the last quarter of "
        f"{number(1e3 * found.ways[0].move.time[-1])} ms, the amplitude of a limit cycle if there "
        "is one. On the plant with its soft suspension, hold and delay exact (robustness lets the "
        "rigid bodies go where that loop is stable)."
    )
    return Figure(lines, caption, (Table(head, rows),)), Words(_limit_words(found))


def _limit_words(found: OnHardware) -> str:
    words = "" if found.forward is not None else "The plant holds no position: no feedforward. "
    if len(found.ways) < 3:
        return words + "Give --saturation to see the move with the force that there is."
    if np.isnan(found.least_limit):
        return words + (
            "The unlimited move itself does not end in its window within the time watched: ask for "
            "more stiffness at low frequencies (compliance_max, S_low), or widen the window."
        )
    peak = max(float(way.move.peak_force.max()) for way in found.ways[:2])
    if found.least_limit == 1.0:
        return (
            words + "Of the limits tried none below the peak force lets the move end in its window."
        )
    return words + (
        "With back-calculation the move ends in its window down to "
        f"{100 * found.least_limit:.3g} % of the peak force, {number(found.least_limit * peak)} N "
        "(tried in steps)."
    )
