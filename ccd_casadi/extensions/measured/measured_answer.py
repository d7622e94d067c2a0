"""A structure on measured lines, designed and judged there: the contract's keys, and its page."""

from collections import defaultdict
from collections.abc import Mapping
from itertools import cycle
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_figures import measured_entry
from ccd_casadi.cases.measured_case import MeasuredCase
from ccd_casadi.codesign.inner_answer import InnerAnswer
from ccd_casadi.codesign.structured_entries import sections_controller
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREEN, GREY, ORANGE
from ccd_casadi.extensions.measured.between_lines import bound_between_lines
from ccd_casadi.extensions.measured.measured_design import MeasuredDesign, design_on_data
from ccd_casadi.extensions.measured.measured_loop import controller_response
from ccd_casadi.inner_problem.sections_words import sections_dict
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace, equivalent_open_loop, sensitivity, sigma_max
from ccd_casadi.reporting.facts import facts
from ccd_casadi.reporting.gain_figures import (
    bandwidth_level,
    forbidden_gains,
    over_hz,
    sensitivity_panel,
)
from ccd_casadi.reporting.limit_figures import controller_blocks
from ccd_casadi.reporting.nyquist import drawable, nyquist_panel
from ccd_casadi.reporting.run_verdict import head_of
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import HZ, number, spoken


def measured_answer(
    case: MeasuredCase, *, seed: int, log: Log = silent
) -> tuple[InnerAnswer, MeasuredDesign]:
    """Design the structure of a case on its measured lines.

    Parameters
    ----------
    case : MeasuredCase
    seed : int
        Of the multi-start search.
    log : callable
        Takes lines of progress.

    Returns
    -------
    InnerAnswer, MeasuredDesign
    """
    made = design_on_data(
        case.responses, case.structure, case.bounds, period=case.period, starts=case.starts,
        seed=seed, progress=log,
    )  # fmt: skip
    return answer_of(case, made), made


def answer_of(case: MeasuredCase, design: MeasuredDesign) -> InnerAnswer:
    """Describe a design on the lines of a case under the keys of `inner`."""
    hz = case.responses[0].hz
    plant = {"file": case.file, "lines": len(hz), "first_hz": hz[0], "last_hz": hz[-1]}
    figures: dict[str, Any] = {"plant": plant, "theta": {}, "words": design.words, "syntheses": 1}
    if design.controller is None or design.figures is None:
        return InnerAnswer("infeasible", figures | {"reason": design.words})
    f, kappa = design.figures, design.kappa
    figures |= {
        "reason": "" if design.usable else design.words,
        "bandwidth_hz": design.bandwidth / HZ,
        "sensitivity_peak": f.S_peak,
        "sensitivity_peak_hz": f.S_peak_frequency / HZ,
        "sensitivity_peak_between_lines": f.S_between,
        "sensitivity_peak_between_lines_hz": f.S_between_frequency / HZ,
        "sensitivity_low": f.S_low,
        "compliance_max": f.GS,
        "KS_max": f.KS,
        **_loop_entry(case, design),
        "certificate": {
            "stable": f.stable,
            "sure": f.sure,
            "right_half_plane_poles": f.right_half_plane,
            "passed": design.usable,
            "figures_over_bounds": case.bounds.shares(f),
        },
        "controller": sections_dict(design.structure, kappa)
        | {"kappa": kappa.tolist(), "sign": design.sign},
    }
    sampling = None if case.period is None else Sampling(1 / case.period)
    controller = sections_controller(design, sampling)
    controller["sections"]["sign"] = design.sign
    return InnerAnswer("verified" if design.usable else "not_verified", figures, controller)


def _loop_entry(case: MeasuredCase, design: MeasuredDesign) -> dict[str, Any]:
    """Margins on the lines; nothing of an unstable loop."""
    K = design.controller
    if K is None or design.figures is None or not design.figures.stable:
        return {}
    loops = []
    for one in case.responses:
        L = one.matrix @ controller_response(K, one.hz, case.period)
        sizes = np.linalg.norm(one.matrix, axis=2)  # the loop is cut at an output
        loops += [(HZ * one.hz, equivalent_open_loop(L, i), sizes[:, i]) for i in range(L.shape[1])]
    return measured_entry(loops, K, design.bandwidth, design.figures.S_peak)


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
            reach = bound_between_lines(one, joint, K)  # drawn at the middle of two lines
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
            forbidden=forbidden_gains(bounds.S_max, bounds.S_low, bounds.omega_low / HZ, *ends,
                                      top)),
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
