"""Chapters and parts of a page: what binds, what limits the bandwidth, error budget, sections."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView, frequency_and_damping
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLACK, CYCLE, GREY
from ccd_casadi.fixed_structure.bounds import kind_and_channel
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.kinds import LoopBudget, loop_budget
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant, true_inner
from ccd_casadi.inner_problem.sections_words import SectionWords, sampled_words
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.state_space import StateSpace, sigma_max
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.reporting.facts import binding, gain_words, paragraph, paragraphs, theta_axes
from ccd_casadi.reporting.gain_figures import gain_panels, over_hz, synthesised_loop, view_of
from ccd_casadi.support.text import HZ, display_unit, number, plural, spoken
from ccd_casadi.synthesis.closed_loop import measure

if TYPE_CHECKING:
    from ccd_casadi.budget.evaluation import BudgetFigures
    from ccd_casadi.codesign.outer_mixed import VerifiedDesign
    from ccd_casadi.codesign.verified_structured import VerifiedStructured

MOST_TOLERANCES, LEAST_HZ = 5, 1e-6  # that are named; with less in Hz a tolerance costs nothing


def bandwidths_table(verified: "VerifiedStructured") -> c.Table:
    """Every ω_b of the one controller: which plant, and whether sampled."""
    design, problem = verified.design, verified.problem
    assert design.certificate is not None
    assert design.controller is not None
    sampling, plants = structured_of(problem).sampling, design.certificate.plants
    as_run = "continuous" if sampling is None else f"as sampled at {number(sampling.rate_hz)} Hz"
    least = f"the least of {plural(len(plants), 'plant')} that the search kept, which J counts"
    rows = [(least, as_run, design.certificate.bandwidth),
            ("the model", as_run, plants[0].crossing)]  # fmt: skip
    if sampling is not None:
        found = measure(
            scaled_plant(problem, verified.theta), design.controller, problem.weights,
            omega_low=problem.inner.omega_low,
        )  # fmt: skip
        rows.append(("the model", "continuous", found.bandwidth))
    head = ("-3 dB of S with this controller, on", "loop", "Hz")
    return c.Table(head, tuple((on, loop, number(omega / HZ, 5)) for on, loop, omega in rows))


def binding_words(problem: CoDesignProblem, result: Mapping[str, Any]) -> list[str]:
    """Describe what holds θ, and what the controller, with what loosening it would gain."""
    over_theta = binding(problem, {**result, "active": []})
    mu, kink = result["controller"]["multipliers"], result["kkt"].get("kink")
    if kink is not None:  # at this θ they are not unique; with θ, which follows the kink, they are
        mu = kink["multipliers"]
    v = problem.figure
    most = HZ * result["bandwidth_hz"] if v is BANDWIDTH else result[f"{v.entry}_of_set"]
    names = {"S_MAX": "The peak of S", "SHAPE": "The shape of S", "LEVEL": "|S| below ω_b",
             "S_LOW": "|S| at ω_low",
             "KS": "|W_KS KS|", "T": "|W_T T|", "GS": "The compliance"}  # fmt: skip
    over_kappa = []
    for kind, words in names.items():
        for name in (name for name, value in mu.items() if value > 1e-6):
            own, channel = kind_and_channel(name)
            if own == kind:
                of = f" of channel {channel}" if channel else ""
                worth = v.format_value(0.01 * mu[name] * most, 3)
                more = f"1 % more of it gives {worth} on this hardware"
                over_kappa.append(f"{words}{of} binds; {more}.")
    ranges = [key.rpartition(" ") for key in result["controller"]["at_range"]]
    ends = [f"{name if ': ' in name else name[:1].upper() + name[1:]} is at the {end} end of its "
            "range." for name, _, end in ranges]  # fmt: skip
    return [*over_theta, *over_kappa, *ends]


def limits_blocks(problem: CoDesignProblem, result: Mapping[str, Any]) -> tuple[c.Block, ...]:
    """Make the blocks on what bounds every controller at θ, and what the set, hold and delay cost
    this structure."""
    costs, gap = result["costs"], result["gap"] or {}
    sampled = structured_of(problem).sampling is not None

    def hz(value: float | None) -> str:
        return "not known" if value is None else f"{number(value, 4)} Hz"

    loop, v = "sampled" if sampled else "continuous", problem.figure
    least = "" if v.larger_is_better else f", of the least {v.words}"
    whole = f"{plural(result['certificate']['plants'], 'plant')} that the search kept"
    bound = hz(gap.get("bandwidth_bound_hz"))
    rows = [
        ("no controller of any order exceeds", gap.get("plants", "the model"), loop, bound),
        ("sections", "the model alone", loop, hz(costs["on_model_hz"])),
        *([("sections", whole, "continuous", hz(costs["continuous_hz"]))] if sampled else []),
        (f"sections: the design{least}", whole, loop, hz(result["bandwidth_hz"])),
    ]
    most = sorted(costs.get("tolerances_hz", {}).items(), key=lambda item: item[1])
    shown = [item for item in most[:MOST_TOLERANCES] if item[1] < -LEAST_HZ]
    words = c.Words(paragraph("report.costs", shown))
    return c.Table(("", "designed for", "loop", "ω_b"), tuple(rows)), words


def controller_blocks(result: Mapping[str, Any]) -> tuple[c.Words, c.Table]:
    """Write gain and sections of a controller in Hz and damping.

    Parameters
    ----------
    result : mapping
        Only `controller` is read, and the rate of the verdict.

    Returns
    -------
    Words, Table
    """
    controller = result["controller"]
    found = [SectionWords(**item) for item in controller["sections"]]
    deployable = result.get("verdict", {}).get("deployable", {})
    moved = sampled_words(found, deployable.get("rate_hz"))
    words = paragraph("report.sections", controller, gain_words(controller), moved)
    return c.Words(words), structured_table(found)


def structured_table(found: Sequence[SectionWords]) -> c.Table:
    """Zeros and poles of a controller's sections."""
    head = ("section", "zero Hz", "zero ζ", "pole Hz", "pole ζ")
    rows = ((s.kind, s.zero_hz, s.zero_damping, s.pole_hz, s.pole_damping) for s in found)
    return c.Table(head, tuple(rows))


PARTS = ("|S|", "|KS|", "|T|")


def shares(loop: LoopView, hz: float) -> np.ndarray:
    """(3,) |W_S S|, |W_KS KS|, |W_T T| over γ at a frequency in Hz."""
    i = int(np.abs(np.log(loop.hz / hz)).argmin())
    return np.asarray(loop.gains[:, i] / loop.bounds[:, i])


def table_limits(loop: LoopView) -> c.Table:
    """Shares of γ where it matters: below, at and above the bandwidth, and at the peaks of S."""
    most = max((gain for _, gain in loop.peaks), default=0.0)
    places = [
        ("half the bandwidth", 0.5 * loop.bandwidth_hz),
        ("bandwidth ω_b", loop.bandwidth_hz),
        ("twice the bandwidth", 2.0 * loop.bandwidth_hz),
        *(("peak of S" if gain == most else "local peak of S", hz)
          for hz, gain in loop.peaks if gain > 1.05),
    ]  # fmt: skip
    rows = []
    for name, hz in sorted(places, key=lambda place: place[1]):
        found = shares(loop, hz)
        percent = (float(f"{100.0 * share:.3g}") for share in found)
        rows.append((name, hz, *percent, PARTS[int(found.argmax())]))
    heads = (f"{part}, % of its bound" for part in PARTS)
    return c.Table(("where", "Hz", *heads, "closest"), tuple(rows))


def limit_sentences(loop: LoopView) -> list[str]:
    """Describe what holds ω_b, and what is largest where S is."""
    found = shares(loop, loop.bandwidth_hz)
    held = [(PARTS[i], found[i]) for i in np.argsort(found)[::-1]]
    top = max(
        (peak for peak in loop.peaks if peak[1] > 1.05), key=lambda peak: peak[1], default=None
    )
    near = []
    if top is not None:
        kinds = {"resonance": loop.resonances_hz, "transmission zero": loop.antiresonances_hz}
        near = [
            (kind, min(places, key=lambda f: abs(np.log(f / top[0]))))
            for kind, places in kinds.items() if places
        ]  # fmt: skip
    controlled = [f for f in loop.resonances_hz if f < 2.0 * loop.bandwidth_hz]
    return paragraphs("report.limits", loop, held, top, near, controlled)


def limit_blocks(loop: LoopView, *more: str) -> tuple[c.Block, ...]:
    """The sentences, `more` of them, and the table."""
    return (*map(c.Words, (*limit_sentences(loop), *more)), table_limits(loop))


SHOWN = 3e-2  # of the whole error: the axis of frequency starts where this much is together
DECADES = 3.5  # of the error's axis


def budget_chapter(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> list[c.Chapter]:
    """Nothing for a problem without a budget."""
    found = loop_budget(problem, theta, controller)
    if found is None:
        return []
    if found.model is None:
        words = "The loop with the model is not stable: it has no stationary error."
        return [c.Chapter("Error budget", (c.Words(words),))]
    return [c.Chapter("Error budget", (*_budget_table(found, found.model), _figure(found.model)))]


def _budget_table(found: LoopBudget, model: "BudgetFigures") -> tuple[c.Words, c.Table]:
    windowed = model.window is not None
    unit, scale = display_unit(spoken("m"), model.error)
    head = ["source", "enters as", f"RMS error ({unit})", "of the variance (%)"]
    head += [f"MA ({unit})", f"MSD ({unit})"] if windowed else []
    head += [spoken("RMS force (N)")]
    rows = []
    for item in model.sources:
        share = 100.0 * (item.error / model.error) ** 2 if model.error > 0.0 else 0.0
        moving = (scale * item.average, scale * item.deviation) if windowed else ()
        kind = item.source.kind.value.replace("_", " ")
        rows.append((item.source.name, kind, scale * item.error, share, *moving, item.force))
    moving = (scale * model.average, scale * model.deviation) if windowed else ()
    rows.append(("together", "", scale * model.error, 100.0, *moving, model.force))
    words = paragraph("report.budget_table", found, model)
    return c.Words(words), c.Table(tuple(head), tuple(rows))


def _figure(model: "BudgetFigures") -> c.Figure:
    shown = [item for item in model.sources if item.cumulative[-1] > 0.0]
    hz = np.unique(np.concatenate([item.hz for item in shown]))
    parts = [np.interp(hz, item.hz, item.cumulative, left=0.0) for item in shown]
    whole = np.sum(parts, axis=0)
    low = float(hz[np.searchsorted(whole, SHOWN**2 * whole[-1])])
    high = float(hz[min(np.searchsorted(whole, (1.0 - 1e-6) * whole[-1]), len(hz) - 1)])
    x = (low, max(2.0 * high, 10.0 * low))
    unit, scale = display_unit(spoken("m"), model.error)
    curves = [
        c.Curve(hz, scale * np.sqrt(part), item.source.name, CYCLE[i % (len(CYCLE) - 1)],
              "-" if i < len(CYCLE) - 1 else "--")
        for i, (item, part) in enumerate(zip(shown, parts, strict=True))
    ]  # fmt: skip
    total = c.Curve(hz, scale * np.sqrt(whole), "together", BLACK, width=1.8)
    top = scale * float(np.sqrt(whole[-1]))
    panel = c.Panel("frequency (Hz)", f"RMS error up to it ({unit})", (*curves, total), log_x=True,
                  log_y=True, x_range=x, y_range=(top * 10.0**-DECADES, 1.5 * top))  # fmt: skip
    lines = c.Lines(((panel,),), "Cumulative RMS error over frequency by source", (3.4,))
    return c.Figure(lines, paragraph("report.budget"))


HEADING = "Start against optimum"
HEIGHTS = (3.0, 3.0)  # inches


def start_chapter(
    problem: CoDesignProblem, verified: "VerifiedDesign", *, same: float = 1e-6
) -> list[c.Chapter]:
    """Both as figures, poles and a table; nothing where the run stayed within `same` (a share of
    the box) of its start.

    At the start the true inner problem is solved, so that each hardware has its best controller.
    """
    width = np.subtract(problem.upper, problem.lower)
    if (np.abs(np.subtract(verified.theta, problem.start)) <= same * width).all():
        return []
    found = true_inner(problem, problem.start)
    if found.optimum is None:
        words = f"The hardware that the run began with has no feasible loop: {found.shortfall}."
        return [c.Chapter(HEADING, (c.Words(words),))]
    f = found.optimum.figures
    start = synthesised_loop(problem, problem.start, f.omega_S, f.omega_T, "start")
    loops = (start, replace(view_of(verified), label="optimum"))
    thetas = (problem.start, verified.theta)
    costs = [hardware_cost(plant_of(problem), theta) for theta in thetas]
    poles = [_roots(loop) for loop in loops]
    lines = c.Lines(_panels(loops[::-1]), HEADING, HEIGHTS)
    least = [float(damping.min()) for _, damping in poles]
    gained = 100.0 * (loops[1].bandwidth_hz / start.bandwidth_hz - 1.0)
    spared = 100.0 * (costs[1] / costs[0] - 1.0) if costs[0] else None
    words = paragraph("report.start", gained, spared, least)
    beside = _start_table(problem, thetas, loops, costs)
    return [c.Chapter(HEADING, (c.Figure(lines, words), beside))]


def _roots(loop: LoopView) -> tuple[np.ndarray, np.ndarray]:
    """|p| in Hz and -Re p/|p| of the loop's poles, a conjugate pair once, in rising order."""
    return frequency_and_damping(loop.loop.poles / HZ)


def _panels(loops: Sequence[LoopView]) -> tuple[tuple[c.Panel, ...], ...]:
    """S over the plants and the poles of the loops."""
    coloured = list(zip(loops, CYCLE, strict=False))
    G = [c.Curve(v.hz, sigma_max(v.plant), v.label, colour) for v, colour in coloured]
    poles = tuple(c.Curve(*_roots(v), v.label, colour, "", "x") for v, colour in coloured)
    pole_map = c.Panel(
        "|pole| (Hz)", "damping ratio of the loop's poles (–)", poles, log_x=True, legend=None,
        levels=(c.Level(0.0, "unstable below", colour=GREY),), y_range=(-0.1, 1.1),
    )  # fmt: skip
    S = gain_panels(loops, bounds=False)[0]
    return (S,), (over_hz(spoken(f"{loops[0].name_gain('G')} (m/N)"), G, loops[0].ends), pole_map)


def _start_table(
    problem: CoDesignProblem, thetas: Sequence[Sequence[float]], loops: Sequence[LoopView],
    costs: Sequence[float],
) -> c.Table:  # fmt: skip
    hz = [loop.bandwidth_hz for loop in loops]
    J = [problem.w1 * f + problem.w2 * HZ * v for f, v in zip(costs, hz, strict=True)]
    first = [min(loop.resonances_hz, default=np.nan) for loop in loops]
    rows = [
        (name, unit or "–", *(factor * theta[i] for theta in thetas))
        for i, (name, unit, factor) in enumerate(theta_axes(problem))
    ]
    rows += [
        ("hardware cost f", problem.cost_unit or "–", *costs), ("first resonance", "Hz", *first),
        ("bandwidth ω_b", "Hz", *hz), ("objective J", "–", *J),
    ]  # fmt: skip
    return c.Table(("", "unit", "start", "optimum"), tuple(rows))
