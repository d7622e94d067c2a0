"""robustness.html: what the design survives, in figures with the numbers behind them."""

import numpy as np

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.drawing.content import Chapter, Facts, Figure, Heading, Page, Table, Words
from ccd_casadi.reporting import robustness_figures as figures
from ccd_casadi.reporting.facts import run_name, theta_words
from ccd_casadi.reporting.loops import figure_gains
from ccd_casadi.reporting.moves import way_words, ways_figure
from ccd_casadi.reporting.verdict import head_of
from ccd_casadi.robust.margins import DiskMargin
from ccd_casadi.robust.perturbed import Line, PerturbedLoop
from ccd_casadi.robust.study import Study
from ccd_casadi.support.units import HZ, number, with_unit

LOSS = 0.05  # of ω_b: what hardware within its tolerances may cost without being mentioned


def robustness_page(
    run: FinishedRun, found: Study, seed: int, index: str = "", *, own: bool = True
) -> Page:
    """robustness.html; `index`: the page that links all of the run.

    `own`: of the run's own controller, so that the run's decision and verdict stand on it.
    """
    lead, *others = conclusion(run, found)
    given = "This controller is stable on every plant that was tried."
    if not found.survives:
        given = "Do not use this controller: it is not stable on every plant that was tried."
    head = head_of(
        f"Robustness: {run_name(run.folder)}", found.survives,
        "stable on all plants" if found.survives else "not stable on all plants",
        "that were tried; others were not examined",
        f"{theta_words(run.result)} · seed {seed}", lead, run.result if own else {},
        "" if own else given,
    )  # fmt: skip
    chapters = (
        Chapter("In short", tuple(map(Words, others))),
        _margins(found),
        _gains(found),
        _perturbed(run, found),
        _tolerances(run, found),
        *_structured(found),
        *([_move(found)] if found.moves else []),
    )
    return Page(head, chapters, index)


def conclusion(run: FinishedRun, found: Study) -> list[str]:
    """The findings in sentences, the most important first."""
    reach, hard, S_max = found.demands.shift, found.tolerances, run.problem.inner.S_max
    low, high = found.shift.stable
    words = [
        f"Stable for resonance shifts of {100.0 * low:+.2f} to {100.0 * high:+.2f} % (tried to "
        f"±{100.0 * reach:g} %); ‖S‖∞ stays within S_max = {S_max:g} from "
        f"{100.0 * found.shift.within[0]:+.2f} to {100.0 * found.shift.within[1]:+.2f} %.",
        f"Damping times {found.demands.damping[0]:g} to {found.demands.damping[1]:g}: "
        + _damping(found.damping, found.demands.damping)
        + f" Shift and damping together: worst at {100 * found.box.place[0]:+.2f} % and damping × "
        f"{found.box.place[1]:.3g}, {_outcome(found.box)}.",
        f"Hardware within ±{100 * hard.tolerance:g} %: {hard.unstable} of {len(hard.judged)} "
        f"random plants unstable, {hard.above(S_max)} others above S_max; "
        f"{hard.within(S_max).words}. Worst found: {_outcome(hard.worst)}.",
    ]
    words += _bandwidth_lost(run, found)
    if hard.failed:
        words.append(f"{hard.failed} random sets of hardware made no plant and are not counted.")
    disk = found.margins.outputs
    words.append(
        f"Disk margin, all outputs at once: {disk.alpha:.3f} at {number(disk.hz, 4)} Hz, which "
        f"allows any gain between 1/{disk.gain:.3g} and {disk.gain:.3g} or {disk.phase_deg:.1f}° "
        f"in every output at once."
    )
    if found.structured is not None:
        bound = found.structured
        words.append(
            f"Structured singular value: stable while every modal stiffness errs by less than "
            f"{100 * bound.stiffness:.3g} % (every frequency by {100 * bound.shift:.3g} %), "
            "each mode by itself; proven on a grid of frequencies."
        )
    words.append(found.statics.words)
    words += [_moved(found, i) for i in range(len(found.moves))]
    if run.sampling is not None:
        step = f"{1e6 * run.sampling.period:.5g} µs"
        words.append(f"The loop is sampled every {step}; hold and delay are exact at the instants.")
    return words


def _bandwidth_lost(run: FinishedRun, found: Study) -> list[str]:
    """What the stable plants with other hardware have left of ω_b, where they lose any to speak of.

    A loop that stays stable and within S_max can be half as fast.
    """
    hz = np.array([item.bandwidth / HZ for item in found.tolerances.judged if item.stable])
    hz = hz[np.isfinite(hz)]
    design = run.figures.bandwidth / HZ
    if not hz.size or hz.min() > (1.0 - LOSS) * design:
        return []
    quarter, least = float(np.quantile(hz, 0.25)), float(hz.min())
    return [
        f"Bandwidth on that hardware: a quarter of the stable plants has {number(quarter, 4)} Hz "
        f"or less, the slowest {number(least, 4)} Hz, where the design has {number(design, 4)} Hz."
    ]


def _moved(found: Study, i: int) -> str:
    move = found.moves[i]
    stroke, window = (with_unit(v, "m") for v in (found.demands.limits.stroke, move.window))
    return (
        f"Move of {stroke} in {1e3 * move.duration:.4g} ms {way_words(move.words, [move])} "
        f"(±{window}), peak force {max(move.peak_force):.4g} N."
    )


def _place(omega: float) -> str:
    if omega in (0.0, np.inf):
        return "at rest" if omega == 0.0 else "towards infinite frequency"
    return f"at {number(omega / HZ, 4)} Hz"


def _damping(line: Line, ends: tuple[float, float]) -> str:
    whole = np.allclose(line.stable, ends, rtol=1e-9)
    stable = "stable throughout" if whole else (
        f"stable only from {line.stable[0]:.3g} to {line.stable[1]:.3g}"
    )  # fmt: skip
    return f"{stable}, within S_max from {line.within[0]:.3g} to {line.within[1]:.3g}."


def _outcome(item: PerturbedLoop) -> str:
    if not item.stable:
        return "unstable"
    return f"peak of S {item.peak:.4g}, ω_b {item.bandwidth / HZ:.4g} Hz"


def _margins(found: Study) -> Chapter:
    head = (
        "loop broken at", "gain up", "gain down", "phase °", "crossover Hz", "disk α", "at Hz",
        "disk gain", "disk phase °",
    )  # fmt: skip

    def disk(margin: DiskMargin) -> tuple[float, ...]:
        return margin.alpha, margin.hz, margin.gain, margin.phase_deg

    nothing = float("nan")
    rows = [
        (m.name, m.gain_up, m.gain_down, m.phase_deg, m.crossover_hz, *disk(m.disk))
        for m in found.margins.loops
    ]
    for name, margin in (("outputs", found.margins.outputs), ("inputs", found.margins.inputs)):
        rows.append((f"all {name} at once", *([nothing] * 4), *disk(margin)))
    words = (
        "Gains are factors: the nearest above and below 1 at which stability is lost. A disk "
        "margin covers gain and phase errors at once."
    )
    return Chapter("Margins", (Table(head, tuple(rows)), Words(words)))


def _gains(found: Study) -> Chapter:
    shapes = (("S", ""), ("T", ""), ("GS", "m"), ("KS", "N/m"))
    tops = [
        (found.view.named(name),
         with_unit(peak, unit, 5) + "/N" * (name == "GS") if unit else number(peak), _place(omega))
        for (name, unit), (peak, omega) in zip(shapes, found.peaks, strict=True)
    ]  # fmt: skip
    n, d = found.noise, found.demands
    # noise is linear: by itself it is told for 1 nm/√Hz, as nobody has a metre of it
    share = 1e-9 if d.sensor == 1.0 else 1.0
    sensor = f"{1e9 * share * d.sensor:.4g} nm/√Hz"
    force = f"{d.disturbance:g} N/√Hz"
    rms = (
        ("position by sensor noise", 1e9 * share * n.position_by_noise, f"nm RMS for {sensor}"),
        ("force by sensor noise", share * n.force_by_noise, f"N RMS for {sensor}"),
        ("position by force noise", 1e6 * n.position_by_disturbance, f"µm RMS for {force}"),
        ("force by force noise", n.force_by_disturbance, f"N RMS for {force}"),
    )
    facts = tuple((name, ", ".join(number(float(v), 4) for v in values), unit)
                  for name, values, unit in rms)  # fmt: skip
    caption = (
        "Sensitivity, complementary sensitivity, position by a force at the actuators (GS), and "
        "force by sensor noise (KS)."
    )
    drawn = Figure(figure_gains([found.view], compliance=True), caption)
    white = (Heading("White noise (one-sided density)"), Facts(facts))
    body = (drawn, Facts(tuple(tops)), *white)  # at rest: in short
    return Chapter("Disturbance and noise", body)


def _perturbed(run: FinishedRun, found: Study) -> Chapter:
    caption = (
        "Above: all flexible frequencies shifted together, mode shapes kept. Below: all damping "
        "multiplied. The controller stays the same. A gap in a curve is an unstable loop; where it "
        f"leaves at the top, the peak exceeds {figures.SHOWN_PEAK:g} S_max."
    )
    drawn = figures.perturbed(run, found, caption)
    rows = tuple(
        (number(item.place[0], 5), 100.0 * item.place[1], "yes" if item.stable else "NO",
         item.bandwidth / HZ, item.peak) for item in found.modes
    )  # fmt: skip
    head = ("mode Hz", "shift %", "stable", "ω_b Hz", "‖S‖∞")
    modes = (Heading("One mode at a time"), Table(head, rows)) if rows else ()
    return Chapter("Plants off the model", (drawn, *modes))


def _tolerances(run: FinishedRun, found: Study) -> Chapter:
    hard, shown = found.tolerances, figures.shown_peak(run, found)
    count = len(hard.judged)
    lost, beyond = hard.unstable, hard.above(shown)
    caption = (
        f"{count} plants with every hardware parameter uniformly within "
        f"±{100 * hard.tolerance:g} % of its value: the share of them below a peak of S, and below "
        f"a bandwidth. {lost} are unstable: both curves end at {number(1.0 - lost / count, 3)}."
    )
    if beyond:
        caption += (
            f" {beyond} more are stable and lie right of the axis, above a peak of {shown:.4g}."
        )
    theta = theta_words({
        "theta": dict(zip(run.problem.names, hard.worst.place, strict=True)),
        "units": dict(zip(run.problem.names, run.problem.units, strict=True)),
    })  # fmt: skip
    words = (
        f"Worst found, by a local search from the worst of them: {theta}: {_outcome(hard.worst)}."
    )
    drawn = figures.tolerances(run, found, caption)
    return Chapter("Hardware tolerances", (drawn, Words(words)))


def _structured(found: Study) -> list[Chapter]:
    bound = found.structured
    if bound is None:
        return []
    caption = (
        "Upper bound of the structured singular value of complex errors δ_i in the modal "
        f"stiffnesses, one a mode ({bound.modes} in all): at every frequency the loop is stable "
        "for |δ_i| < 1/μ. Real errors are allowed to be larger: up to the inverse of the level "
        f"shown, {bound.stiffness:.4g}."
    )
    return [Chapter("Structured singular value", (figures.structured(bound, caption),))]


def _move(found: Study) -> Chapter:
    plant = (
        "with its rigid bodies free"
        if found.moves[0].free
        else "on its soft suspension, without which the loop is not stable"
    )
    ways = {"with mass feedforward" if m.feedforward else "without feedforward": [m]
            for m in found.moves}  # fmt: skip
    words = (
        f"A fourth-order setpoint for output {found.demands.axis + 1}, simulated exactly on the "
        f"plant {plant}. It reaches {number(found.setpoint.velocity)} m/s, "
        f"{number(found.setpoint.acceleration)} m/s² and {number(found.setpoint.jerk)} m/s³."
    )
    return Chapter("A move", (Words(words), ways_figure(ways, "The loop is simulated exactly.")))
