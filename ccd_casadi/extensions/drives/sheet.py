"""The sheet that a person types into a drive: numbers, names, values, units; as text, as JSON, and
as a page that draws the cascade as wired, with |S| at every place where the loop may be broken."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREEN, ORANGE
from ccd_casadi.extensions.drives.arithmetic import ArithmeticOptions, following_error, program_of
from ccd_casadi.extensions.drives.drive_case import DriveProblem
from ccd_casadi.extensions.drives.drive_codesign import DriveAt
from ccd_casadi.extensions.drives.drive_design import DriveDesign
from ccd_casadi.extensions.drives.two_rates import lift
from ccd_casadi.fixed_structure.bounds import kind_and_channel
from ccd_casadi.fixed_structure.box_proof import ProofOutcome
from ccd_casadi.lti.frequency_grid import frequency_grid
from ccd_casadi.lti.loop import sampled
from ccd_casadi.reporting.facts import theta_words
from ccd_casadi.reporting.gain_figures import bandwidth_level, sensitivity_panel
from ccd_casadi.support.text import HZ, number, template

Today = Mapping[str, float]  # values by number or name


def sheet_rows(design: DriveDesign, today: Today | None = None) -> list[dict[str, Any]]:
    """One entry for each parameter, in the drive's unit; `today`'s values by number or name."""
    rows, given = [], today or {}
    own = zip(design.cascade.settings, design.values.tolist(), strict=True)
    for setting, value in [*own, *design.feedforward]:
        shown = setting.shown(round(value * setting.per_si / setting.step))
        old = given.get(setting.name, given.get(setting.number))
        rows.append({"number": setting.number, "name": setting.name, "value": shown,
                     "unit": setting.unit, "today": old})  # fmt: skip
    return rows


def move_errors(drive: DriveProblem, design: DriveDesign) -> tuple[float, float] | None:
    """m that the model's position is behind its setpoint at most, in a simulated move with and
    without feedforward; None of a drive that has none."""
    if not design.feedforward:
        return None
    plant = drive.uncertain.plant(drive.uncertain.nominal).plant_si()
    G, own = sampled(plant, drive.sampling.period, drive.sampling.delay), design.cascade
    first, second = (program_of(own, design.values, ahead) for ahead in (design.ahead, (0.0, 0.0)))
    return (following_error(first, G, own.position, own.velocity),
            following_error(second, G, own.position, own.velocity))  # fmt: skip


def entry(
    problem: DriveProblem,
    design: DriveDesign,
    today: Today | None = None,
    moved: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Everything that is known, as JSON holds it; `moved` by `move_errors`."""
    drive, judged, bounds = design.cascade.drive, design.certificate, design.certificate.worst
    return {
        "status": design.status,
        "drive": drive.title,
        "theta": named_theta(problem, problem.theta),
        "rate_hz": 1.0 / design.cascade.period,
        "bandwidth_hz": design.bandwidth / HZ,
        "free_bandwidth_hz": design.free.bandwidth / HZ,
        "filter_gain": design.rise,
        "compliance": design.compliance,
        "judge": {"passed": judged.passed, "words": judged.words, "plants": len(judged.plants),
                  "shares": bounds},
        "position_rate_hz": 1.0 / (design.cascade.period * design.cascade.slower),
        "proof": None if design.proof is None else {
            "proven": design.proof.proven, "words": design.proof.words,
            "levels": design.proof.levels, "slack": design.proof.slack},
        "parameters": sheet_rows(design, today),
        "between_samples": None if design.between is None else design.between.entry,
        "following_error": None if moved is None else {"m": moved[0], "without_m": moved[1]},
        "sources": list(drive.sources),
        "chosen": list(drive.chosen),
        "unknown": list(drive.unknown),
    }  # fmt: skip


def named_theta(problem: DriveProblem, theta: Sequence[float]) -> dict[str, float]:
    """θ by name, in the case's units."""
    return dict(zip(problem.problem.names, theta, strict=True))


def figures_of(problem: DriveProblem, at: DriveAt) -> dict[str, Any]:
    """What is known of a θ before rounding."""
    return {"theta": named_theta(problem, at.theta), "bandwidth_hz": at.candidate.bandwidth / HZ,
            "hardware_cost": at.cost, "objective": at.objective}  # fmt: skip


def codesign_words(problem: DriveProblem, entry: Mapping[str, Any]) -> str:
    """Both designs of a co-design, a line each."""
    units = problem.problem.parameter_units
    return "\n".join(
        f"{name:14s}J {number(one['objective'], 5)}, {number(one['bandwidth_hz'], 4)} Hz, cost "
        f"{number(one['hardware_cost'], 4)} {problem.problem.cost_unit}".rstrip()
        + f" at {theta_words({'theta': one['theta'], 'units': units})}"
        for name, one in entry.items()
    )


def proof_words(design: DriveDesign) -> str:
    """What is proven, in a sentence."""
    if design.proof is not None:
        left = "" if design.compliance is None else "; compliance is judged, not proven"
        if design.proof.outcome is ProofOutcome.VARIES and not left:
            left = "; give values of it as [robust] plants, which can be proven"
        return f"{design.proof.words}{left}"
    if len(design.certificate.plants) == 1:
        return "not needed: the set is one plant"
    return "there is none of two rates; between the judged plants nothing is proven"


def sheet_figures(
    problem: DriveProblem, design: DriveDesign, moved: tuple[float, float] | None = None
) -> list[tuple[str, str]]:
    """What the design reaches, each figure with its limit; `moved` by `move_errors`."""
    own, (Kv, _, Tn), of = design.cascade, design.values[:3], problem.problem
    rounded, free = design.bandwidth / HZ, design.free.bandwidth / HZ
    found = []
    if of.names:
        named = {"theta": named_theta(problem, problem.theta), "units": of.parameter_units}
        found.append(("hardware", theta_words(named)))
    found += [
        ("bandwidth", f"{rounded:.4g} Hz, the least of the plants; {free:.4g} Hz before rounding, "
         "on fewer"),
        ("peaks of S", _peaks(problem, design)),
        ("judged", design.certificate.words),
        ("proof", proof_words(design)),
    ]  # fmt: skip
    if design.compliance is not None:
        until = "" if np.isinf(own.stiff_below) else f" up to {own.stiff_below / HZ:.4g} Hz"
        found.append(("compliance", f"at most {design.compliance:.4g} m/N{until} on the judged "
                      "plants"))  # fmt: skip
    lowest = design.values[own.hertz].min(initial=np.inf) / rounded
    found.append(("filters", f"raise their gain to {design.rise:.4g} of rest, limit "
                  f"{own.filter_gain:.4g}; lowest at {lowest:.4g} of ω_b, at least "
                  f"{own.filters_above:.4g}"))  # fmt: skip
    found.append(("decay", f"ω_b Tn {design.bandwidth * Tn:.4g}, ω_b/Kv "
                  f"{design.bandwidth / Kv:.4g}; limit {own.decay:.4g}"))  # fmt: skip
    if moved is not None:
        o = ArithmeticOptions()
        found.append(("move", f"{1e3 * o.distance:g} mm in {o.seconds:g} s: off by "
                      f"{1e6 * moved[0]:.4g} µm at most, {1e6 * moved[1]:.4g} µm without "
                      "feedforward"))  # fmt: skip
    return found


def _peaks(problem: DriveProblem, design: DriveDesign) -> str:
    """The largest |S| of the judged plants at every place, and its bound."""
    bounds, worst = problem.bounds, design.certificate.worst
    own = {one.name: one.S_max or bounds.S_max for one in bounds.channels}
    limits = own or {"": bounds.S_max}
    shares = {kind_and_channel(name)[1]: share for name, share in worst.items()
              if kind_and_channel(name)[0].upper() == "S_MAX"}  # fmt: skip
    return ", ".join(f"{number(shares[name] * limit, 4)} (limit {number(limit)}) at "
                     f"{name or 'the sensor'}" for name, limit in limits.items() if name in shares
                     ) or "not known: a loop is not stable"  # fmt: skip


def sheet_text(
    design: DriveDesign, figures: Sequence[tuple[str, str]], today: Today | None = None
) -> str:
    """The sheet as text, `today`'s values beside the new ones; figures of `sheet_figures`."""
    head = ["number", "parameter", "new", "unit"] if today is None else [
        "number", "parameter", "today", "new", "unit"]  # fmt: skip
    lines = [head]
    for row in sheet_rows(design, today):
        old = row["today"]
        before = [] if today is None else ["" if old is None else f"{old:.10g}"]
        lines.append([row["number"], row["name"], *before, f"{row['value']:.10g}", row["unit"]])
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    table = ["  ".join(part.ljust(width) for part, width in zip(line, widths, strict=True)).rstrip()
             for line in lines]  # fmt: skip
    drive = design.cascade.drive
    found = [drive.title, *table, "", *(f"{name:14s}{words}" for name, words in figures)]
    found += [f"chosen        {words}" for words in drive.chosen]
    found += [f"not known     {words}" for words in drive.unknown]
    return "\n".join(found)


def drive_page(
    title: str, drive: DriveProblem, design: DriveDesign, figures: Sequence[tuple[str, str]],
    today: Today | None = None,
) -> c.Page:  # fmt: skip
    """Make report.html."""
    own = design.cascade.drive
    head = c.Head(
        f"{own.title}: {title}", "good" if design.status == "verified" else "bad",
        design.status.replace("_", " "), "", design.certificate.words,
        f"|S| is below -3 dB up to {number(design.bandwidth / HZ, 4)} Hz. "
        f"Proof: {proof_words(design)}",
    )  # fmt: skip
    notes = tuple(f"Chosen: {words}" for words in own.chosen)
    notes += tuple(f"Not known: {words}" for words in own.unknown)
    return c.Page(head, (
        c.Chapter("As wired", (diagram(drive, design, today or {}),)),
        c.Chapter("Figures", (c.Table(("figure", "value"), tuple(figures)),)),
        c.Chapter("Sensitivity", (_sensitivity(drive, design),)),
        c.Chapter("What the manuals do not say", (c.Bullets(notes),), folded=True),
    ), index="")  # fmt: skip


def diagram(drive: DriveProblem, design: DriveDesign, today: Today) -> c.Picture:
    """Draw the cascade with the drive's numbers, names, values and units, today's beside them."""
    own, rows = design.cascade, sheet_rows(design, today)
    names = [channel.name for channel in drive.bounds.channels] or ["the position", "the motor"]
    period, late = 1e6 * own.period, 1e6 * drive.sampling.delay
    often = f"every {number(own.slower * period)} µs"
    ahead, at_speed = rows[len(own.settings) :], own.drive.speed_feedforward is not None
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
    words = "Of the model; the bandwidth is the least of the set, whose other plants are not drawn."
    return c.Figure(c.Lines(((panel,),), "Sensitivity over frequency", (3.4,)), words)
