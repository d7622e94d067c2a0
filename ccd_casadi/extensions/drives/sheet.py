"""What is said of a drive's design: its verdict, the sheet to type into it, text and JSON, a page.

The verdict has the keys of result.json, as solve has them. Margins are of the loop broken at one
place, L = 1/S - 1, on the model and on the corners of its set. Of two rates S is the part that has
the frequency of a sine (`two_rates`), the modulus margin counts the rest as well.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_figures import loop_entry
from ccd_casadi.codesign.final_judgement import judge_survival
from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.structured_entries import box_findings, proof_dict
from ccd_casadi.codesign.survival import Survival, loops_of
from ccd_casadi.codesign.verdict import (
    Check,
    OwnSet,
    State,
    VerdictOptions,
    between_finding,
    survives,
)
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREEN, ORANGE
from ccd_casadi.extensions.drives.cascade import ArithmeticOptions, following_error, program_of
from ccd_casadi.extensions.drives.drive_case import DriveProblem, meets_constraints, named_theta
from ccd_casadi.extensions.drives.drive_design import DriveDesign
from ccd_casadi.extensions.drives.two_rates import LiftedLoop, lift, place_name
from ccd_casadi.fixed_structure.bounds import kind_and_channel
from ccd_casadi.fixed_structure.certificate import SetCertificate
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.lti.frequency_grid import frequency_grid
from ccd_casadi.lti.loop import Loop, zoh
from ccd_casadi.reporting.concerns import lines_of
from ccd_casadi.reporting.decision import advice
from ccd_casadi.reporting.facts import theta_words
from ccd_casadi.reporting.gain_figures import bandwidth_level, over_hz, sensitivity_panel
from ccd_casadi.reporting.nyquist import drawable, nyquist_panel
from ccd_casadi.reporting.run_verdict import run_head
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.text import HZ, number, spoken, template, with_unit
from ccd_casadi.synthesis.closed_loop import classical_margins


def verdict_entry(problem: DriveProblem, design: DriveDesign) -> dict[str, Any]:
    """Judge a design as `ccd solve` judges sections: it is verified where no line fails.

    Gives `status`, `reason`, `verdict`, `margins` of every place, and margins and steps as
    result.json has them, of a stable loop.
    """
    own, stable = design.cascade, all(one.stable for one in design.certificate.plants)
    figures: dict[str, Any] = {}
    certified, ranges = _certify(problem, design), None
    if stable:
        figures = _margins(problem, design)
    if stable and own.slower == 1:
        K, places = design.controller, problem.bounds.places
        plants = problem.uncertain.as_written(problem.uncertain.corners())
        loops = [Loop(plant, K, problem.sampling, places) for plant in plants]
        peak = max(1.0 / one["modulus_margin"] for one in figures["margins"])
        figures = loop_entry(loops, design.bandwidth, peak) | figures
        if certified.state is State.PASSED:
            ranges = _survival(problem, design)
    lines = certified, _survives(problem, design, ranges), _deployable(problem, design, ranges)
    lost = [f"{line.name}: {line.words}" for line in lines if line.state is State.FAILED]
    return {
        "status": "not_verified" if lost else "verified",
        "reason": f"failed: {'; '.join(lost)}" if lost else "",
        "verdict": {line.name: line.entry for line in lines},
        **figures,
    }


def lift_loops(problem: DriveProblem, design: DriveDesign) -> list[LiftedLoop]:
    """The loops on the model and on the corners of the set."""
    rate = problem.sampling.period, problem.sampling.delay
    plants = problem.uncertain.as_written(problem.uncertain.corners())
    return [lift(design.cascade, design.values, zoh(plant, *rate)) for plant in plants]


def _margins(problem: DriveProblem, design: DriveDesign) -> dict[str, Any]:
    """The least of these plants at every place, and of all places."""
    loops, rows = lift_loops(problem, design), list[dict[str, Any]]()
    for place in loops[0].places:
        each, peak = [], 0.0
        for loop in loops:
            omega = loop.grid(0.05 * problem.bounds.omega_low)
            if place == design.cascade.position:  # above it a slower position is aliased
                omega = omega[omega < np.pi / (loop.slower * loop.period)]

            def opened(w: Array, loop: LiftedLoop = loop, place: int | None = place) -> np.ndarray:
                return 1.0 / loop.fundamental(place, w.ravel()).reshape(w.shape) - 1.0

            each.append(classical_margins(opened, omega))
            peak = max(peak, float(loop.sensitivity(place, omega).max()))
        rows.append({
            "place": place_name(problem.bounds, place),
            "crossover_hz": each[0].crossover / HZ,
            "phase_margin_deg": min(one.phase_deg for one in each),
            "gain_up": min(one.gain_up for one in each),
            "gain_down": max(one.gain_down for one in each),
            "gain_margin": min(min(one.gain_up, 1.0 / max(one.gain_down, 1e-300)) for one in each),
            "delay_margin_us": 1e6 * min(one.delay for one in each),
            "modulus_margin": 1.0 / peak,
        })  # fmt: skip
    least = ("phase_margin_deg", "gain_margin", "delay_margin_us", "modulus_margin")
    return {"margins": rows, **{key: min(row[key] for row in rows) for key in least}}


def _certify(problem: DriveProblem, design: DriveDesign) -> Check:
    judged, own = design.certificate, design.cascade
    line = partial(Check, "certified", figures={"figures_over_bounds": judged.worst})
    if design.rise > own.filter_gain:
        words = f"filters raise their gain to {design.rise:.4g}, above filter_gain"
        return line(State.FAILED, (Reason.JUDGED(words=words),))
    if not judged.passed:
        return line(State.FAILED, (Reason.JUDGED(words=_worst_words(judged)),))
    if not meets_constraints(problem.problem, problem.theta):
        return line(State.FAILED, (Reason.CONSTRAINT_NOT_MET(),))
    return line(State.PASSED, (Reason.JUDGED(words=judged.words),))


def _worst_words(judged: SetCertificate) -> str:
    """Describe the bound that is exceeded most, by the judge."""
    name, share = max(judged.worst.items(), key=lambda one: one[1], default=("", 0.0))
    return f"exceeds {name} by {100.0 * (share - 1.0):.2g} %" if share > 1.0 else judged.words


def _survival(problem: DriveProblem, design: DriveDesign) -> Survival | None:
    """The ranges of a certified loop off its model."""
    loops = loops_of(problem.problem, problem.theta, design.controller)
    # a drive's design has what is read of one of sections
    return judge_survival(problem.problem, loops, design)[0]  # type: ignore[arg-type]


def _survives(problem: DriveProblem, design: DriveDesign, ranges: Survival | None) -> Check:
    held = kind_of(problem.problem).common_shifts()
    judged = replace(design.certificate, words=_worst_words(design.certificate))
    known = box_findings(
        judged, len(judged.plants), design.proof, design.worst, design.drawn,
        along=ranges is None or ranges.within(*held),
    )  # fmt: skip
    if judged.passed and design.cascade.slower > 1:  # nothing off the set is tried
        figures = known["figures"] | {"set": known["own"].value, "set_shift": list(held)}
        states = {OwnSet.BROKEN: State.FAILED, OwnSet.NONE: State.WARNED}
        state = states.get(known["own"], State.UNKNOWN)
        return Check("survives", state, tuple(known["own_findings"]), figures)
    known["figures"] |= {"set_shift": list(held)}
    return survives(ranges, S_max=problem.bounds.S_max, **known)


def _deployable(problem: DriveProblem, design: DriveDesign, ranges: Survival | None) -> Check:
    rate, between = problem.sampling, design.between
    figures = {"rate_hz": rate.rate_hz, "delay_us": rate.delay_us}
    words = f"judged at {rate.rate_hz:g} Hz with a delay of {rate.delay_us:g} us, "
    words += "hold and delay exact; cascade.c is its code"
    line = partial(Check, "deployable", figures=figures)
    if not design.certificate.passed or (ranges and ranges.contradiction):
        return line(State.UNKNOWN, (Reason.JUDGED(words="the loop is not certified"),))
    if between is None:
        words = f"S between its samples is not judged; {words}"
        return line(State.WARNED, (Reason.JUDGED(words=words),))
    options = VerdictOptions()
    above, finding = between_finding(between, problem.bounds.S_max, options.between_excess)
    state = State.WARNED if above else State.PASSED
    return line(state, (Reason.JUDGED(words=words), finding))


Today = Mapping[str, float]  # values by number or name


def sheet_rows(design: DriveDesign, today: Today | None = None) -> list[dict[str, Any]]:
    """One entry for each parameter, in the drive's unit; `today`'s values by number or name."""
    rows, given = [], today or {}
    own = zip(design.cascade.settings, design.values.tolist(), strict=True)
    for setting, value in [*own, *design.feedforward, *design.cascade.current]:
        shown = setting.format_steps(round(value * setting.per_si / setting.step))
        old = given.get(setting.name, given.get(setting.number))
        rows.append({"number": setting.number, "name": setting.name, "value": shown,
                     "unit": setting.unit, "today": old})  # fmt: skip
    return rows


def _move_errors(drive: DriveProblem, design: DriveDesign) -> tuple[float, float] | None:
    """m that the model's position is behind its setpoint at most, in a simulated move with and
    without feedforward; None of a drive that has none."""
    if not design.feedforward:
        return None
    plant = drive.uncertain.plant(drive.uncertain.nominal).plant_si()
    G, own = zoh(plant, drive.sampling.period, drive.sampling.delay), design.cascade
    first, second = (program_of(own, design.values, ahead) for ahead in (design.ahead, (0.0, 0.0)))
    return (following_error(first, G, own.position, own.velocity),
            following_error(second, G, own.position, own.velocity))  # fmt: skip


def entry(problem: DriveProblem, design: DriveDesign, today: Today | None = None) -> dict[str, Any]:
    """Everything that is known, as JSON holds it."""
    moved = _move_errors(problem, design)
    drive, judged, bounds = design.cascade.drive, design.certificate, design.certificate.worst
    return json_values({
        **verdict_entry(problem, design),
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
        "proof": proof_dict(design.proof) | {"proven": design.proof.proven},
        "parameters": sheet_rows(design, today),
        "between_samples": None if design.between is None else design.between.entry,
        "following_error": None if moved is None else {"m": moved[0], "without_m": moved[1]},
        "sources": list(drive.sources),
        "chosen": list(drive.chosen),
        "unknown": list(drive.unknown),
    })  # fmt: skip


def sheet_figures(
    problem: DriveProblem, design: DriveDesign, answer: Mapping[str, Any]
) -> list[tuple[str, str]]:
    """List what the design reaches, each figure with its limit; `answer` by `entry`."""
    own, (Kv, _, Tn), of = design.cascade, design.values[:3], problem.problem
    rounded, free = design.bandwidth / HZ, design.free.bandwidth / HZ
    ruled = own.allowed_bandwidths(design.values).min() <= design.bandwidth * (1.0 + 1e-9)
    least = "what decay and filters allow" if ruled else "the least of the plants"
    found = []
    if of.names:
        named = {"theta": named_theta(problem, problem.theta), "units": of.parameter_units}
        found.append(("hardware", theta_words(named)))
    found += [
        ("bandwidth", f"{rounded:.4g} Hz, {least}; {free:.4g} Hz before rounding, "
         "on fewer plants"),
        ("peaks of S", _peaks(problem, design)),
        *((f"margins at {one['place']}", _margin_words(one)) for one in answer.get("margins", ())),
    ]  # fmt: skip
    if design.compliance is not None:
        until = "" if np.isinf(own.stiff_below) else f" up to {own.stiff_below / HZ:.4g} Hz"
        most = with_unit(design.compliance, "/".join(of.spoken[:2]), 4)
        found.append(("compliance", f"at most {most}{until} on the judged plants"))
    lowest = design.values[own.hertz].min(initial=np.inf) / rounded
    found.append(("filters", f"raise their gain to {design.rise:.4g} of rest, limit "
                  f"{own.filter_gain:.4g}; lowest at {lowest:.4g} of ω_b, at least "
                  f"{own.filters_above:.4g}"))  # fmt: skip
    step = abs(
        float(design.controller.D[0, own.velocity])
    )  # the difference, PI and filters at once
    motor = place_name(problem.bounds, own.velocity)
    turned = own.drive.travel
    torque = "" if turned is None else f", {with_unit(1e-9 * step * turned, 'N m')} at the motor"
    found.append(("encoder", f"a step of 1 n{of.spoken[0]} at {motor} changes the force by "
                  f"{with_unit(1e-9 * step, of.spoken[1])}{torque}"))  # fmt: skip
    found.append(("decay", f"ω_b Tn {design.bandwidth * Tn:.4g}, ω_b/Kv "
                  f"{design.bandwidth / Kv:.4g}; limit {own.decay:.4g}"))  # fmt: skip
    if (moved := answer["following_error"]) is not None:
        o = ArithmeticOptions()
        found.append(("move", f"{1e3 * o.distance:g} mm in {o.seconds:g} s: off by "
                      f"{1e6 * moved['m']:.4g} µm at most, {1e6 * moved['without_m']:.4g} µm "
                      "without feedforward"))  # fmt: skip
    return found


def _margin_words(one: Mapping[str, Any]) -> str:
    """The margins of the loop broken at one place, the least of model and corners."""
    down = f"× {number(one['gain_down'], 2)}" if one["gain_down"] else "any"
    return (f"phase {number(one['phase_margin_deg'], 3)}°, gain × {number(one['gain_up'], 3)} up "
            f"and {down} down, delay {number(one['delay_margin_us'], 3)} µs, "
            f"modulus {number(one['modulus_margin'], 3)}")  # fmt: skip


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
    design: DriveDesign, figures: Sequence[tuple[str, str]], answer: Mapping[str, Any],
    today: Today | None = None,
) -> str:  # fmt: skip
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
    said = [
        ("decision", advice(answer)),
        *((line.name, f"{line.state:9s}{line.words}") for line in lines_of(answer)),
        *figures,
        *(("chosen", words) for words in drive.chosen),
        *(("not known", words) for words in drive.unknown),
    ]
    return "\n".join([drive.title, *table, "", *(f"{name:20s}{words}" for name, words in said)])


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
    bounds, own, loops = drive.bounds, design.cascade, lift_loops(drive, design)
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
