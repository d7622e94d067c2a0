"""A structure on measured lines, designed and judged there, under the contract's keys."""

from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_figures import measured_entry
from ccd_casadi.cases.measured_case import MeasuredCase
from ccd_casadi.codesign.inner_answer import InnerAnswer
from ccd_casadi.codesign.structured_entries import sections_controller
from ccd_casadi.extensions.measured.measured_design import MeasuredDesign, design_on_data
from ccd_casadi.extensions.measured.measured_loop import controller_response
from ccd_casadi.inner_problem.sections_words import sections_dict
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import equivalent_open_loop
from ccd_casadi.support.terminal import Tell, silent
from ccd_casadi.support.text import HZ


def measured_answer(
    case: MeasuredCase, *, seed: int, tell: Tell = silent
) -> tuple[InnerAnswer, MeasuredDesign]:
    """Design the structure of a case on its measured lines.

    Parameters
    ----------
    case : MeasuredCase
    seed : int
        Of the multi-start search.
    tell : callable
        Takes lines of progress.

    Returns
    -------
    InnerAnswer, MeasuredDesign
    """
    made = design_on_data(
        case.responses, case.structure, case.bounds, period=case.period, starts=case.starts,
        seed=seed, progress=tell,
    )  # fmt: skip
    return answer_of(case, made), made


def answer_of(case: MeasuredCase, design: MeasuredDesign) -> InnerAnswer:
    """Describe a design on the lines of a case under the keys of `inner`.

    Parameters
    ----------
    case : MeasuredCase
    design : MeasuredDesign

    Returns
    -------
    InnerAnswer
    """
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
