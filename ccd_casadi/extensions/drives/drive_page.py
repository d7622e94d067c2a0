"""The page of a drive's design: the cascade as wired, each value beside today's, and |S| at every
place where the loop may be broken."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREEN, ORANGE
from ccd_casadi.extensions.drives.drive_case import DriveProblem
from ccd_casadi.extensions.drives.drive_design import DriveDesign
from ccd_casadi.extensions.drives.sheet import proof_words, sheet_rows
from ccd_casadi.extensions.drives.two_rates import lift
from ccd_casadi.lti.frequency_grid import frequency_grid
from ccd_casadi.lti.loop import sampled
from ccd_casadi.reporting.gain_figures import bandwidth_level, sensitivity_panel
from ccd_casadi.support.text import HZ, number, template

Today = Mapping[str, float]


def drive_page(
    title: str, drive: DriveProblem, design: DriveDesign, today: Today | None = None
) -> c.Page:  # fmt: skip
    """Make report.html."""
    own = design.cascade.drive
    head = c.Head(
        f"{own.title}: {title}", "good" if design.status == "verified" else "bad",
        design.status.replace("_", " "), "", design.certificate.words,
        f"{number(design.bandwidth / HZ, 4)} Hz at -3 dB of S. Proof: {proof_words(design)}",
    )  # fmt: skip
    notes = tuple(f"Chosen: {words}" for words in own.chosen)
    notes += tuple(f"Not known: {words}" for words in own.unknown)
    return c.Page(head, (
        c.Chapter("As wired", (diagram(drive, design, today or {}),)),
        c.Chapter("Sensitivity", (_sensitivity(drive, design),)),
        c.Chapter("What the manuals do not say", (c.Bullets(notes),), folded=True),
    ), index="")  # fmt: skip


def diagram(drive: DriveProblem, design: DriveDesign, today: Today) -> c.Picture:
    """Draw the cascade with the drive's numbers, names, values and units, today's beside them."""
    own, rows = design.cascade, sheet_rows(design, today)
    names = [channel.name for channel in drive.bounds.channels] or ["the position", "the motor"]
    period, late = 1e6 * own.period, 1e6 * drive.sampling.delay
    often = f"every {number(own.slower * period)} µs"
    blocks = [_block("position", often, rows[:1], "", "left")]
    current: list[dict[str, Any]] = []
    at = 3
    for slot in own.slots:
        part = rows[at : at + len(slot.settings)]
        at += len(part)
        block = _block(slot.name, "", part, f"{slot.name}, ")
        (current if slot.place == "current" else blocks).append(block)
    blocks.append(_block("velocity", f"every {number(period)} µs", rows[1:3], "", "right"))
    blocks += [*current, _block("current loop", f"part of the delay, {number(late)} µs", [], "")]
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


def _sensitivity(drive: DriveProblem, design: DriveDesign) -> c.Figure:
    """|S| of the model at every place."""
    uncertain, sampling, bounds = drive.uncertain, drive.sampling, drive.bounds
    plant = uncertain.plant(uncertain.nominal).plant_si()
    loop = lift(design.cascade, design.values, sampled(plant, sampling.period, sampling.delay))
    low = bounds.omega_low / HZ
    high = 0.499 / (sampling.period * design.cascade.slower)  # above it the position is aliased
    hz = frequency_grid(low, high, 900, np.abs(plant.rates) / HZ)
    curves = []
    for place, colour in zip(loop.places, (BLUE, ORANGE, GREEN), strict=False):
        name = "actuator" if place is None else (
            bounds.channels[place].name if bounds.channels else "the sensor")  # fmt: skip
        S = loop.sensitivity(place, HZ * hz)
        curves.append(c.Curve(hz, S, f"broken at {name}", colour))
    panel = sensitivity_panel(curves, (low, high), bounds.S_max,
                              (bandwidth_level(design.bandwidth / HZ),), "|S| (–)")  # fmt: skip
    words = "Of the model. Other plants of the set are judged and proven, not drawn."
    return c.Figure(c.Lines(((panel,),), "Sensitivity over frequency", (3.4,)), words)
