"""report.html of a deployment: full, reduced and sampled loop, orders, sections."""

import numpy as np

from ccd_casadi.analysis.loop_figures import step_response
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.c_code import COMPILE
from ccd_casadi.deployment.discretise import Conversion
from ccd_casadi.deployment.on_hardware import OnHardware
from ccd_casadi.deployment.outcome import ChannelOrders, Deployment
from ccd_casadi.deployment.sections import Root, sections_of
from ccd_casadi.deployment.words import figure_rows, order_words, reason_words, short_status
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREEN, ORANGE
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.sections_words import gain_of, section_words
from ccd_casadi.lti.closed_loop import sensitivity, sigma_max
from ccd_casadi.lti.grid import frequency_grid
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.lti.loop import Loop
from ccd_casadi.reporting.facts import run_name, theta_words
from ccd_casadi.reporting.loops import bandwidth_level, over_hz, sensitivity_panel
from ccd_casadi.reporting.moves import move_blocks
from ccd_casadi.reporting.structured_page import structured_table
from ccd_casadi.reporting.verdict import head_of
from ccd_casadi.support.units import HZ, number, with_unit

POINTS = 900
PERIODS = 6.0  # of ω_b that the step is shown for


def deploy_page(
    run: FinishedRun, found: Deployment, moved: OnHardware | None = None, index: str = ""
) -> c.Page:
    """report.html of a deployment; `index`: the page that links all of the run."""
    meta = f"{theta_words(run.result)}; S_max {run.problem.inner.S_max:g}"
    head = head_of(
        f"Controller of {run_name(run.folder)}, deployed", found.passed,
        short_status(run, found), reason_words(run, found), meta, _conclusion(run, found),
        run.result,
    )  # fmt: skip
    chapters = [
        c.Chapter("The loop", (_loop(run, found),)),
        c.Chapter("Figures", _facts(run, found)),
    ]
    if found.sampled.stable:
        chapters.append(c.Chapter("Step of the reference", (_step(run, found),)))
    if moved is not None:
        chapters.append(c.Chapter("A move on the machine", move_blocks(moved)))
    chapters += [
        c.Chapter("Sampling rate", (_rates(found),)),
        c.Chapter("Orders", tuple(block for item in found.orders for block in _orders(item, run))),
        c.Chapter("As sections",
                tuple(block for item in found.orders for block in _sections(item, run))),
    ]  # fmt: skip
    if found.stable:
        chapters.append(c.Chapter("The code", _code(found)))
    return c.Page(head, tuple(chapters), index)


def _conclusion(run: FinishedRun, found: Deployment) -> str:
    if not found.stable:
        return f"At {number(found.rate_hz)} Hz the sampled loop is {found.shortfalls[0]}."
    rest = "" if found.statics is None else f" {found.statics.words}"
    return f"The controller has {order_words(run, found)}.{rest}"


def _loops(run: FinishedRun, found: Deployment) -> tuple[tuple[Loop, str, str, str], ...]:
    """The loops beside each other: name, colour, line; nothing is reduced of what was designed."""
    G, K = run.plant.plant_si(), found.realisation.system
    sampled = Loop(G, K, Sampling(1.0 / K.period, 1e6 * found.delay)), "sampled", ORANGE, "-"
    if kind_of(run.problem).as_designed:
        return (Loop(G, run.controller), "continuous", BLUE, "-"), sampled
    full = Loop(G, run.controller), "full", BLUE, "-"
    return full, (Loop(G, found.reduced), "reduced", GREEN, "--"), sampled


def _loop(run: FinishedRun, found: Deployment) -> c.Figure:
    scalar = run.plant.B.shape[1] == len(run.plant.C) == 1
    nyquist, named = 0.5 * found.rate_hz, "|{}|" if scalar else "σ_max({})"
    low, high = run.problem.inner.omega_low / HZ, 0.98 * nyquist
    hz = frequency_grid(low, high, POINTS, run.plant.grid * run.plant.omega_0 / HZ)
    curves, drawn = [], []
    for loop, name, colour, line in _loops(run, found):
        G, K = loop.responses(HZ * hz)
        label = name if loop.sampling is None else f"{name} at {number(found.rate_hz)} Hz"
        curves.append(c.Curve(hz, sigma_max(sensitivity(G @ K)), label, colour, line))
        drawn.append(c.Curve(hz, sigma_max(K), name, colour, line))
    S_max, own = run.problem.inner.S_max, found.sampled.bandwidth / HZ
    crossing = bandwidth_level(own, text=", sampled") if np.isfinite(own) else (
        bandwidth_level(run.figures.bandwidth / HZ, text=", continuous")
    )  # fmt: skip
    top = sensitivity_panel(curves, (low, nyquist), S_max, (crossing,), f"{named.format('S')} (–)")
    bottom = over_hz(f"{named.format('K')} (N/m)", drawn, (low, nyquist), legend=None)
    title = f"Sensitivity and controller over frequency: {', '.join(k.label for k in drawn)}"
    ends = (f"{with_unit(each.y[-1], 'N/m')} ({each.label})" for each in drawn)
    caption = (
        "S of the sampled loop is taken at the sampling instants, with zero-order hold and delay, "
        "up to half the sampling rate. The gain of the controller there amplifies sensor noise and "
        f"unmodelled resonances. It is {', '.join(ends)}."
    )
    return c.Figure(c.Lines(((top,), (bottom,)), title, (3.4, 2.4)), caption)


def _facts(run: FinishedRun, found: Deployment) -> tuple[c.Block, ...]:
    rows = figure_rows(run, found)
    rows.append(("Slowest sampled mode", number(found.sampled.spectral_radius, 8), "below 1"))
    unstable = [r for r in np.linalg.eigvals(found.reduced.A) if r.real > 0.0]
    words = (
        "The controller is unstable by itself (its loop is not): close the loop at rest, and open "
        "it when the actuator saturates."
    )
    return (c.Facts(tuple(rows)), *([c.Words(words)] if unstable else []))


def _step(run: FinishedRun, found: Deployment) -> c.Figure:
    direction = found.orders[0].channel.outputs[:, 0]
    seconds = PERIODS * HZ / run.figures.bandwidth
    curves = []
    for loop, label, colour, line in _loops(run, found):
        t, outputs = step_response(loop, direction, seconds, POINTS)
        y = outputs @ direction
        curves.append(c.Curve(1e3 * t, y, label, colour, line))
    where = "" if len(direction) == 1 else f", channel {found.orders[0].channel.name}"
    panel = c.Panel("time (ms)", f"y{where} (of the step)", tuple(curves))
    caption = f"Overshoot of the sampled loop {100.0 * (float(y.max()) - 1.0):.1f} %."
    return c.Figure(c.Lines(((panel,),), "Step of the reference", (3.0,)), caption)


def _rates(found: Deployment) -> c.Words:
    hz = "no rate" if found.needed_hz is None else f"{number(found.needed_hz, 4)} Hz"
    if found.conversion is Conversion.TUSTIN:
        return c.Words(f"The loop was designed for {hz} with Tustin's rule, hold and delay in it.")
    lead = (
        " The lead filter makes up for the phase of hold and delay, and raises the gain at half "
        "the sampling rate."
    )
    return c.Words(
        f"From {hz} on the loop keeps S_max to 5 % and ω_b to 3 %, hold and delay included "
        f"({found.conversion.value}).{lead if found.conversion is Conversion.LEAD else ''}"
    )


def _orders(item: ChannelOrders, run: FinishedRun) -> tuple[c.Block, ...]:
    if item.designed is not None:
        return (_of(item, f"{item.chosen.order} states, as designed."),)
    head = ("order", "method", "peak of S", "ω_b, Hz", "|S| at ω_low", "norm/γ", "")
    rows = tuple(
        (row.order, row.method.value, f.sensitivity_peak, f.bandwidth / HZ, f.sensitivity_low,
         f.gamma / run.figures.gamma if f.certified else float("nan"),
         f.outcome.value if not f.certified else "chosen" if row is item.chosen else "")
        for row in item.rows for f in [row.figures]
    )  # fmt: skip
    words = (
        f"{item.chosen.order} of {item.rows[0].order} states are enough "
        f"({item.chosen.method.value}) for S_max to 0.5 %, S_low, 99 % of ω_b and no gain "
        f"above twice its bound; {item.strict.order} keep S_max itself."
    )
    return _of(item, words), c.Table(head, rows)


def _of(item: ChannelOrders, words: str) -> c.Words:
    """Words about a channel, which is named where there are several."""
    alone = item.channel.name == "all"
    words = f"{words[0].upper()}{words[1:]}" if alone else f"Channel {item.channel.name}: {words}"
    return c.Words(words)


def _sections(item: ChannelOrders, run: FinishedRun) -> tuple[c.Block, ...]:
    K = item.chosen.controller
    if K.D.shape != (1, 1):
        words = "This controller does not fall apart into scalar channels: no sections."
        return (c.Words(words),)
    if item.designed is not None:
        structure, kappa = item.designed
        words = f"gain {with_unit(gain_of(kappa), 'N/m', 4)}; the sections as they were designed."
        return _of(item, words), structured_table(section_words(structure, kappa))
    found = sections_of(K, run.figures.bandwidth)
    rows = tuple(
        (s.kind, *_root(s.zero), *_root(s.pole), number(s.depth_db, 4)) for s in found.sections
    )
    head = ("section", "zero Hz", "zero ζ", "pole Hz", "pole ζ", "depth dB")
    words = (
        f"gain {with_unit(found.gain, 'N/m', 4)} at s = 0, "
        f"{with_unit(found.gain_at_bandwidth, 'N/m', 4)} at ω_b; every section has the gain 1 at "
        "s = 0. A negative ζ, or a negative frequency of a single root, is in the right half plane."
    )
    return _of(item, words), c.Table(head, rows)


def _root(root: Root | None) -> tuple[str, str]:
    if root is None:
        return "", ""
    return number(root.hz, 5), "" if root.damping is None else number(root.damping, 4)


def _code(found: Deployment) -> tuple[c.Block, ...]:
    K = found.realisation
    sizes = f"{K.blocks.count(1)} of one state, {K.blocks.count(2)} of two"
    larger = len(K.blocks) - K.blocks.count(1) - K.blocks.count(2)
    words = (
        f"controller.c holds {len(K.system.A)} states, A block-diagonal ({sizes}"
        f"{f', {larger} larger' if larger else ''}). Call controller_step every "
        f"{number(1e6 * K.system.period, 6)} µs. controller_test.c compares it with forces that "
        "the Python difference equation gave; controller.st is the same as structured text "
        "(IEC 61131-3). controller_takeover starts without a jump, controller_forward gives the "
        "feedforward of a setpoint:"
    )
    return c.Words(words), c.Source(f"{COMPILE}\n./controller_test")
