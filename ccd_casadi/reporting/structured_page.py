"""Pages of a controller of fixed structure: on a model's set, and on measured lines."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from ccd_casadi.cases.measured_case import MeasuredCase
from ccd_casadi.codesign.verified_structured import VerifiedStructured
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.content import Block, Table, Words
from ccd_casadi.drawing.svg import BLUE, GREEN, GREY, ORANGE
from ccd_casadi.fixed_structure.between_lines import between
from ccd_casadi.fixed_structure.bounds import kind_and_channel
from ccd_casadi.fixed_structure.measured_loop import controller_response
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.inner_problem.sections_words import SectionWords
from ccd_casadi.inner_problem.structured_plant_set import structured_of
from ccd_casadi.lti.state_space import StateSpace, equivalent_open_loop, sensitivity, sigma_max
from ccd_casadi.reporting.facts import binding, facts, gain_words, paragraph
from ccd_casadi.reporting.gain_figures import bandwidth_level, forbidden, over_hz, sensitivity_panel
from ccd_casadi.reporting.nyquist import drawable, nyquist_panel
from ccd_casadi.reporting.run_verdict import head_of
from ccd_casadi.support.text import HZ, counted, number, spoken
from ccd_casadi.synthesis.closed_loop import measure

MOST_TOLERANCES, LEAST_HZ = 5, 1e-6  # that are named; with less in Hz a tolerance costs nothing


def bandwidths_table(verified: VerifiedStructured) -> Table:
    """Every ω_b of the one controller: which plant, and whether sampled."""
    design, problem = verified.design, verified.problem
    assert design.certificate is not None
    assert design.controller is not None
    sampling, plants = structured_of(problem).sampling, design.certificate.plants
    as_run = "continuous" if sampling is None else f"as sampled at {number(sampling.rate_hz)} Hz"
    least = f"the least of {counted(len(plants), 'plant')} of the set, which J counts"
    rows = [(least, as_run, design.certificate.bandwidth),
            ("the model", as_run, plants[0].crossing)]  # fmt: skip
    if sampling is not None:
        found = measure(
            scaled_plant(problem, verified.theta), design.controller, problem.weights,
            omega_low=problem.inner.omega_low,
        )  # fmt: skip
        rows.append(("the model", "continuous", found.bandwidth))
    head = ("-3 dB of S with this controller, on", "loop", "Hz")
    return Table(head, tuple((on, loop, number(omega / HZ, 5)) for on, loop, omega in rows))


def binding_words(problem: CoDesignProblem, result: Mapping[str, Any]) -> list[str]:
    """What holds θ, and what the controller, with what loosening it would gain."""
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
                worth = v.shown(0.01 * mu[name] * most, 3)
                more = f"1 % more of it gives {worth} on this hardware"
                over_kappa.append(f"{words}{of} binds; {more}.")
    ranges = [words.rpartition(" ") for words in result["controller"]["at_range"]]
    ends = [f"{name if ': ' in name else name[:1].upper() + name[1:]} is at the {end} end of its "
            "range." for name, _, end in ranges]  # fmt: skip
    return [*over_theta, *over_kappa, *ends]


def limits_blocks(problem: CoDesignProblem, result: Mapping[str, Any]) -> tuple[Block, ...]:
    """What bounds every controller at θ, and what the set, hold and delay cost this structure."""
    costs, gap = result["costs"], result["gap"] or {}
    sampled = structured_of(problem).sampling is not None

    def hz(value: float | None) -> str:
        return "not known" if value is None else f"{number(value, 4)} Hz"

    loop, v = "sampled" if sampled else "continuous", problem.figure
    least = "" if v.larger_is_better else f", of the least {v.words}"
    whole = f"{counted(result['certificate']['plants'], 'plant')} of the set"
    bound = hz(gap.get("bandwidth_bound_hz"))
    rows = [
        ("no controller of any order exceeds", gap.get("plants", "the model"), loop, bound),
        ("sections", "the model alone", loop, hz(costs["on_model_hz"])),
        *([("sections", whole, "continuous", hz(costs["continuous_hz"]))] if sampled else []),
        (f"sections: the design{least}", whole, loop, hz(result["bandwidth_hz"])),
    ]
    most = sorted(costs.get("tolerances_hz", {}).items(), key=lambda item: item[1])
    told = [item for item in most[:MOST_TOLERANCES] if item[1] < -LEAST_HZ]
    words = Words(paragraph("report.costs", told))
    return Table(("", "designed for", "loop", "ω_b"), tuple(rows)), words


def controller_blocks(result: Mapping[str, Any]) -> tuple[Words, Table]:
    """Gain and sections in Hz and damping; of `result` only `controller` is read."""
    controller = result["controller"]
    found = [SectionWords(**item) for item in controller["sections"]]
    words = paragraph("report.sections", controller, gain_words(controller))
    return Words(words), structured_table(found)


def structured_table(found: Sequence[SectionWords]) -> Table:
    """Zeros and poles of a controller's sections."""
    head = ("section", "zero Hz", "zero ζ", "pole Hz", "pole ζ")
    rows = ((s.kind, s.zero_hz, s.zero_damping, s.pole_hz, s.pole_damping) for s in found)
    return Table(head, tuple(rows))


HEIGHT = 3.0  # inches of a row


def measured_page(case: MeasuredCase, controller: StateSpace, answer: Mapping[str, Any]) -> c.Page:
    """Make report.html of a stable design on a measured response.

    Parameters
    ----------
    case : MeasuredCase
    controller : StateSpace
        SI.
    answer : mapping
        What `inner` prints of it.

    Returns
    -------
    Page
    """
    good = answer["status"] == "verified"
    lines = f"{len(case.responses[0].hz)} lines of {case.file}"
    norms = answer.get("models")
    basis = (
        f", and on the model: its sampled loop has stable poles and ‖S‖∞ = {number(max(norms))}"
        if norms else "; no model"
    )  # fmt: skip
    lead = (
        f"A controller of order {answer['controller']['order']} with a bandwidth of "
        f"{number(answer['bandwidth_hz'])} Hz, designed and judged on {lines}{basis}."
    )
    head = head_of(
        f"Controller on {case.file}", good, "verified" if good else "not verified",
        answer["reason"], f"{case.path.name} · {lines}", lead, answer,
    )  # fmt: skip
    figures = (
        c.Facts(tuple(facts("measured", case, answer))),
        c.Words(f"What this rests on: {answer['words']}."),
    )
    chapters = (
        c.Chapter("The loop on the lines", (_loop(case, controller, answer),)),
        c.Chapter("The figures", figures),
        c.Chapter("The controller", controller_blocks(answer)),
    )
    return c.Page(head, chapters, index="")


def _loop(case: MeasuredCase, controller: StateSpace, answer: Mapping[str, Any]) -> c.Figure:
    """|S| and the Nyquist plot, |G| and |L|, |KS| and |T|: values at the lines, joined straight.

    Of several channels the largest singular values, and the loops opened one at a time.
    """
    bounds, curves, loci = case.bounds, defaultdict(list), []
    for one, colour in zip(case.responses, cycle((BLUE, GREEN, ORANGE)), strict=False):
        hz, K = one.hz, controller_response(controller, one.hz, case.period)
        joint = one.matrix @ K
        S = sensitivity(joint)
        if not one.modelled:  # of a model ‖S‖∞ is known
            reach = between(one, joint, K)  # drawn at the middle of two lines
            curves["at most"].append(c.Curve(np.sqrt(hz[1:] * hz[:-1]),
                                           np.where(reach < np.inf, reach, np.nan),
                                           "between lines, at most", GREY, width=0.9))  # fmt: skip
        gains = {"G": one.matrix, "S": S, "KS": K @ S, "T": joint @ S}
        for name, M in gains.items():
            curves[name].append(c.Curve(hz, sigma_max(M), colour=colour))
        loops = [equivalent_open_loop(joint, i) for i in range(joint.shape[1])]
        curves["L"] += [c.Curve(hz, np.abs(L), colour=colour) for L in loops]
        loci += loops
    hz, size = curves["S"][0].x, curves["S"][0].y
    ends = (float(hz[0]), float(hz[-1]))
    top = 2.5 * max(bounds.S_max, *(float(curve.y.max()) for curve in curves["S"]))
    at = bandwidth_level(answer["bandwidth_hz"])
    shown = [drawable(L) for L in loci]
    rows = (
        (sensitivity_panel(
            (*curves["at most"], *curves["S"]), ends, bounds.S_max, (at,), "|S| (–)",
            legend=None, y_range=(0.5 * float(size.min()), top),
            forbidden=forbidden(bounds.S_max, bounds.S_low, bounds.omega_low / HZ, *ends, top)),
         nyquist_panel(hz, shown, bounds.S_max, HEIGHT, ("the first", "the others"))),
        (over_hz(spoken("|G| (m/N)"), curves["G"], ends),
         over_hz("|L| (–)", curves["L"], ends, levels=(c.Level(1.0, "1"), at))),
        (over_hz(spoken("|KS| (N/m)"), curves["KS"], ends, levels=(at,)),
         over_hz("|T| (–)", curves["T"], ends, levels=(at,))),
    )  # fmt: skip
    words = "Every bound is required on every line: S out of the shaded area, L out of the disk."
    if curves["at most"]:
        words += (
            " Grey: what |S| may reach between two lines, if GK bends there as around them. A "
            "resonance that fits between two lines is not seen."
        )
    lines = c.Lines(rows, "The loop on the measured lines", (HEIGHT, 2.6, 2.6))
    return c.Figure(lines, words)
