"""report.html of a deployment: full, reduced and sampled loop, orders, sections."""

from dataclasses import replace
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_figures import step_response
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.deploy_files import Root, sections_of
from ccd_casadi.deployment.on_hardware import OnHardware
from ccd_casadi.deployment.outcome import ChannelOrders, DeployedRun, Deployment
from ccd_casadi.deployment.source_code import COMPILE
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLACK, BLUE, GREEN, GREY, ORANGE
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.sections_words import gain_of, section_words
from ccd_casadi.lti.frequency_grid import frequency_grid
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.state_space import sigma_max
from ccd_casadi.reporting.facts import paragraph, paragraphs, run_name, theta_words
from ccd_casadi.reporting.gain_figures import bandwidth_level, over_hz, sensitivity_panel
from ccd_casadi.reporting.limit_figures import structured_table
from ccd_casadi.reporting.moves import move_blocks
from ccd_casadi.reporting.run_verdict import head_of
from ccd_casadi.support.extensions import function
from ccd_casadi.support.text import HZ, number, spoken, with_unit

POINTS = 900
BROKEN = (ORANGE, BLUE, GREEN, BLACK, GREY)  # loops of several sensors at their places
PERIODS = 6.0  # of ω_b that the step is shown for


def deploy_page(
    run: FinishedRun, found: Deployment, moved: OnHardware | None = None, index: str = ""
) -> c.Page:
    """Make report.html of a deployment.

    Parameters
    ----------
    run : FinishedRun
    found : Deployment
    moved : OnHardware, optional
        The simulated move on the machine.
    index : str
        Address of the page that links all pages of the run.

    Returns
    -------
    Page
    """
    meta = f"{theta_words(run.result)}; S_max {run.problem.inner.S_max:g}"
    deployed = DeployedRun(run, found)
    head = head_of(
        f"Controller of {run_name(run.folder)}, deployed", found.passed,
        deployed.short_status, deployed.reason, meta, _conclusion(run, found),
        run.result,
    )  # fmt: skip
    chapters = [
        c.Chapter("The loop", (_loop(run, found),)),
        c.Chapter("Figures", _facts(run, found)),
    ]
    if found.sampled.stable:
        step = (_step(run, found),)
        chapters.append(c.Chapter("Step of the reference", step, folded=True))
    if moved is not None:
        chapters.append(c.Chapter("A move on the machine", move_blocks(moved)))
    chapters += [
        c.Chapter("Sampling rate", _words("rate", found)),
        c.Chapter("Orders", tuple(block for item in found.orders for block in _orders(item, run)),
                  folded=True),
        c.Chapter("As sections",
                  tuple(block for item in found.orders for block in _sections(item, run)),
                  folded=True),
    ]  # fmt: skip
    if found.stable:
        chapters.append(c.Chapter("The code", _code(found)))
    return c.Page(head, tuple(chapters), index)


def _conclusion(run: FinishedRun, found: Deployment) -> str:
    if not found.stable:
        return f"At {number(found.rate_hz)} Hz the sampled loop is {found.shortfalls[0]}."
    rest = "" if found.statics is None else f" {found.statics.words}"
    return f"The deployed controller has {DeployedRun(run, found).order}.{rest}"


def _loops(run: FinishedRun, found: Deployment) -> tuple[tuple[Loop, str, str, str], ...]:
    """The loops beside each other: name, colour, line; nothing is reduced of what was designed."""
    G, K, at = run.plant.plant_si(), found.realisation.system, kind_of(run.problem).bounds().places
    sampled = Loop(G, K, Sampling(1.0 / K.period, 1e6 * found.delay), at), "sampled", ORANGE, "-"
    if not run.figures.certificate.stable:
        return (sampled,)
    if kind_of(run.problem).as_designed:
        return (Loop(G, run.controller, at=at), "continuous", BLUE, "-"), sampled
    full = Loop(G, run.controller), "full", BLUE, "-"
    return full, (Loop(G, found.reduced), "reduced", GREEN, "--"), sampled


def _loop(run: FinishedRun, found: Deployment) -> c.Figure:
    scalar = run.plant.B.shape[1] == len(run.plant.C) == 1
    nyquist, named = 0.5 * found.rate_hz, "|{}|" if scalar else "σ_max({})"
    low, high = run.problem.inner.omega_low / HZ, 0.98 * nyquist
    hz = frequency_grid(low, high, POINTS, run.plant.grid * run.plant.omega_0 / HZ)
    curves, drawn = [], []
    for loop, name, colour, line in _loops(run, found):
        K = replace(loop, at=()).responses(HZ * hz)[1]
        drawn.append(c.Curve(hz, sigma_max(K), name, colour, line))
        label = name if loop.sampling is None else f"{name} at {number(found.rate_hz)} Hz"
        if loop.at:
            continue
        curves.append(c.Curve(hz, sigma_max(loop.sensitivity(HZ * hz)), label, colour, line))
    for one, colour in zip(loop.places if loop.at else [], BROKEN, strict=False):
        S = np.abs(one.sensitivity(HZ * hz)[:, 0, 0])
        curves.append(c.Curve(hz, S, f"broken at {one.at[0].name}", colour))
    S_max, own = run.problem.inner.S_max, found.sampled.bandwidth / HZ
    crossing = bandwidth_level(own, text=", sampled") if np.isfinite(own) else (
        bandwidth_level(run.bandwidth / HZ, text=", as designed")
    )  # fmt: skip
    of_S = "|S|" if kind_of(run.problem).bounds().places else named.format("S")
    top = sensitivity_panel(curves, (low, nyquist), S_max, (crossing,), f"{of_S} (–)")
    bottom = over_hz(spoken(f"{named.format('K')} (N/m)"), drawn, (low, nyquist), legend=None)
    title = f"Sensitivity and controller over frequency: {', '.join(k.label for k in drawn)}"
    ends = ", ".join(f"{with_unit(each.y[-1], spoken('N/m'))} ({each.label})" for each in drawn)
    caption = paragraph("deployment.loop", ends)
    return c.Figure(c.Lines(((top,), (bottom,)), title, (3.4, 2.4)), caption)


def _facts(run: FinishedRun, found: Deployment) -> tuple[c.Block, ...]:
    unstable = [r for r in np.linalg.eigvals(found.reduced.A) if r.real > 0.0]
    return c.Facts(tuple(DeployedRun(run, found).rows)), *(_words("unstable") if unstable else ())


def _step(run: FinishedRun, found: Deployment) -> c.Figure:
    direction = found.orders[0].channel.outputs[:, 0]
    if at := kind_of(run.problem).bounds().places:  # a setpoint of the one whose error counts
        direction = np.ones(1)
    seconds = PERIODS * HZ / run.bandwidth
    curves = []
    for loop, label, colour, line in _loops(run, found):
        t, outputs = step_response(loop, direction, seconds, POINTS)
        y = outputs @ direction
        curves.append(c.Curve(1e3 * t, y, label, colour, line))
    name = at[0].name if at else found.orders[0].channel.name
    where = f", channel {name}" if at or len(direction) > 1 else ""
    panel = c.Panel("time (ms)", f"y{where} (of the step)", tuple(curves))
    caption = f"Overshoot of the sampled loop {100.0 * (float(y.max()) - 1.0):.1f} %."
    return c.Figure(c.Lines(((panel,),), "Step of the reference", (3.0,)), caption)


def _words(part: str, *known: Any) -> tuple[c.Words, ...]:
    """Render a macro of `templates/deployment.txt`."""
    return tuple(map(c.Words, paragraphs(f"deployment.{part}", *known)))


def _orders(item: ChannelOrders, run: FinishedRun) -> tuple[c.Block, ...]:
    if item.designed is not None:
        return _words("orders", item)
    head = ("order", "method", "peak of S", "ω_b, Hz", "|S| at ω_low", "norm/γ", "")
    rows = tuple(
        (row.order, row.method.value, f.sensitivity_peak, f.bandwidth / HZ, f.sensitivity_low,
         f.gamma / run.figures.gamma if f.certified else float("nan"),
         f.outcome.value if not f.certified else "chosen" if row is item.chosen else "")
        for row in item.rows for f in [row.figures]
    )  # fmt: skip
    return *_words("orders", item), c.Table(head, rows)


def _sections(item: ChannelOrders, run: FinishedRun) -> tuple[c.Block, ...]:
    K = item.chosen.controller
    if K.D.shape != (1, 1):
        return _words("no_sections")
    if item.designed is not None:
        structure, kappa = item.designed
        words = _words("designed", item.channel, gain_of(kappa))
        return *words, structured_table(section_words(structure, kappa))
    found = sections_of(K, run.bandwidth)
    rows = tuple(
        (s.kind, *_root(s.zero), *_root(s.pole), number(s.depth_db, 4)) for s in found.sections
    )
    head = ("section", "zero Hz", "zero ζ", "pole Hz", "pole ζ", "depth dB")
    return *_words("sections", item.channel, found), c.Table(head, rows)


def _root(root: Root | None) -> tuple[str, str]:
    if root is None:
        return "", ""
    return number(root.hz, 5), "" if root.damping is None else number(root.damping, 4)


def _code(found: Deployment) -> tuple[c.Block, ...]:
    text = function("structured_text") is not None
    return *_words("code", found.realisation, text), c.Source(f"{COMPILE}\n./controller_test")
