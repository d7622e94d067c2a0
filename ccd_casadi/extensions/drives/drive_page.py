"""report.html of a drive's design: whether to build it, the cascade as wired, |S| and the Nyquist
plot at every place where the loop may be broken."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREEN, ORANGE
from ccd_casadi.extensions.drives.drive_case import DriveProblem
from ccd_casadi.extensions.drives.drive_design import DriveDesign
from ccd_casadi.extensions.drives.drive_verdict import lifted
from ccd_casadi.extensions.drives.sheet import Today, sheet_rows
from ccd_casadi.extensions.drives.two_rates import place_name
from ccd_casadi.lti.frequency_grid import frequency_grid
from ccd_casadi.reporting.gain_figures import bandwidth_level, over_hz, sensitivity_panel
from ccd_casadi.reporting.nyquist import drawable, nyquist_panel
from ccd_casadi.reporting.run_verdict import run_head
from ccd_casadi.support.text import HZ, number, spoken, template


def drive_page(
    title: str, drive: DriveProblem, design: DriveDesign, answer: Mapping[str, Any],
    figures: Sequence[tuple[str, str]], today: Today | None = None,
) -> c.Page:  # fmt: skip
    """Make report.html; `answer` of `entry`, `figures` of `sheet_figures`."""
    own = design.cascade.drive
    lead = f"|S| is below -3 dB up to {number(design.bandwidth / HZ, 4)} Hz."
    head = run_head(f"{own.title}: {title}", answer, "", lead)
    notes = tuple(f"Chosen: {words}" for words in own.chosen)
    notes += tuple(f"Not known: {words}" for words in own.unknown)
    return c.Page(head, (
        c.Chapter("As wired", (diagram(drive, design, today or {}),)),
        c.Chapter("Figures", (c.Table(("figure", "value"), tuple(figures)),)),
        c.Chapter("The loop at every place", (_loops(drive, design),)),
        c.Chapter("What the manuals do not say", (c.Bullets(notes),), folded=True),
    ), index="")  # fmt: skip


def diagram(drive: DriveProblem, design: DriveDesign, today: Today) -> c.Picture:
    """Draw the cascade with the drive's numbers, names, values and units, today's beside them."""
    own, rows = design.cascade, sheet_rows(design, today)
    names = [channel.name for channel in drive.bounds.channels] or ["the position", "the motor"]
    period, late = 1e6 * own.period, 1e6 * drive.sampling.delay
    often = f"every {number(own.slower * period)} µs"
    ahead, at_speed = rows[len(own.settings) :], own.drive.speed_feedforward is not None
    ahead, inner = ahead[: len(design.feedforward)], ahead[len(design.feedforward) :]
    blocks = [_block("position", often, [*rows[:1], *ahead[:at_speed]], "", "left")]
    current: list[dict[str, Any]] = []
    at = 3
    for slot in own.slots:
        part = rows[at : at + len(slot.settings)]
        at += len(part)
        block = _block(slot.name, "", part, f"{slot.name}, ")
        (current if slot.place == "current" else blocks).append(block)
    blocks.append(_block("velocity", f"every {number(period)} µs", [*rows[1:3], *ahead[at_speed:]],
                         "", "right"))  # fmt: skip
    blocks += [*current, _block("current loop", f"delay of {number(late)} µs", inner, "")]
    blocks.append(_block("machine", "", [], ""))
    y = 18
    for block in blocks:
        y += 44 if block["side"] else 16
        block["y"], y = y, y + block["high"]
    encoders = [
        (30, 1, [f"encoder of {names[own.position]}"]),
        (195, -1, [f"encoder of {names[own.velocity]}", f"difference over {number(period)} µs"]),
    ]
    svg = template("extensions/drives/templates/diagram.svg").render(
        blocks=blocks, encoders=encoders, bottom=y + 33, high=y + 54
    )
    return c.Picture(svg)


def _block(
    title: str, note: str, rows: list[dict[str, Any]], prefix: str, side: str = ""
) -> dict[str, Any]:
    """A block; `side`: from where a sensor's signal comes in front of it."""
    shown = [{"label": row["name"].removeprefix(prefix), "number": row["number"],
              "new": f"{row['value']:.10g}", "unit": row["unit"],
              "today": None if row["today"] is None else f"{row['today']:.10g}"}
             for row in rows]  # fmt: skip
    return {"title": title, "note": note, "rows": shown, "side": side,
            "high": 22 + 14 * len(rows)}  # fmt: skip


def _loops(drive: DriveProblem, design: DriveDesign) -> c.Figure:
    """|S| of the model, and L = 1/S - 1 of model and corners, at every place; |K|."""
    bounds, own, loops = drive.bounds, design.cascade, lifted(drive, design)
    rates = drive.uncertain.plant(drive.uncertain.nominal).plant_si().rates
    low = bounds.omega_low / HZ
    # above half its rate the position is aliased
    high = 0.499 / (own.period * own.slower)
    hz = frequency_grid(low, high, 900, np.abs(rates) / HZ)
    curves, panels = [], []
    for place, colour in zip(loops[0].places, (BLUE, ORANGE, GREEN), strict=False):
        name = place_name(bounds, place)
        label = f"broken at {name}"
        curves.append(c.Curve(hz, loops[0].sensitivity(place, HZ * hz), label, colour))
        loci = [drawable(1.0 / loop.fundamental(place, HZ * hz) - 1.0) for loop in loops]
        panels.append(nyquist_panel(hz, loci, bounds.S_max, names=(label, "corners of the set")))
    K = own.responses(design.values, np.exp(1j * HZ * hz * own.period))[0]
    names = [place_name(bounds, i) for i in range(own.sensors)]
    gains = [c.Curve(hz, np.abs(K[i]), f"from {names[i]}", colour)
             for i, colour in zip((own.position, own.velocity)[: own.sensors], (BLUE, ORANGE),
                                  strict=False)]  # fmt: skip
    panels.append(over_hz(spoken("|K| (N/m)"), gains, (low, high)))
    level = bandwidth_level(design.bandwidth / HZ)
    top = sensitivity_panel(curves, (low, high), bounds.S_max, (level,), "|S| (–)")
    rows = ((top,), *(tuple(panels[i : i + 2]) for i in range(0, len(panels), 2)))
    words = ("|S| is of the model; its bandwidth is the least of the set. Every Nyquist plot has "
             "the model and the corners of the set.")  # fmt: skip
    lines = c.Lines(rows, "Sensitivity, loop and controller", (3.4, *[3.0] * (len(rows) - 1)))
    return c.Figure(lines, words)
