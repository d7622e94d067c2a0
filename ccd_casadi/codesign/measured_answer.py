"""Sections on a measured response, designed and judged on its lines; as JSON."""

from collections.abc import Callable
from typing import Any

from ccd_casadi.analysis.loop_figures import measured_entry
from ccd_casadi.cases.measured_case import MeasuredCase
from ccd_casadi.codesign.design_entries import controller_dict
from ccd_casadi.codesign.inner_answer import InnerAnswer
from ccd_casadi.fixed_structure.measured_design import MeasuredDesign, design_on_data
from ccd_casadi.fixed_structure.measured_loop import controller_response
from ccd_casadi.inner_problem.sections_words import sections_dict
from ccd_casadi.lti.closed_loop import open_alone
from ccd_casadi.support.units import HZ


def measured_answer(
    case: MeasuredCase, *, seed: int, progress: Callable[[str], None] | None = None
) -> tuple[InnerAnswer, MeasuredDesign]:
    """The structure of the case on its measured lines, and the design behind the answer."""
    made = design_on_data(
        case.responses, case.structure, case.bounds, period=case.period, starts=case.starts,
        seed=seed, progress=progress,
    )  # fmt: skip
    return answer_of(case, made), made


def answer_of(case: MeasuredCase, made: MeasuredDesign) -> InnerAnswer:
    """What a design on the lines of a case says of itself."""
    hz = case.responses[0].hz
    plant = {"file": case.file, "lines": len(hz), "first_hz": hz[0], "last_hz": hz[-1]}
    figures: dict[str, Any] = {"plant": plant, "theta": {}, "words": made.words, "syntheses": 1}
    if made.controller is None or made.figures is None:
        return InnerAnswer("infeasible", figures | {"reason": made.words})
    f = made.figures
    parts = sections_dict(made.structure, made.kappa) | {"kappa": made.kappa.tolist()}
    figures |= {
        "reason": "" if made.usable else made.words,
        "bandwidth_hz": made.bandwidth / HZ,
        "sensitivity_peak": f.S_peak,
        "sensitivity_peak_hz": f.S_peak_frequency / HZ,
        "sensitivity_peak_between_lines": f.S_between,
        "sensitivity_low": f.S_low,
        "compliance_max": f.GS,
        "KS_max": f.KS,
        **_loop_entry(case, made),
        "certificate": {
            "stable": f.stable,
            "sure": f.sure,
            "right_half_plane_poles": f.right_half_plane,
            "passed": made.usable,
            "figures_over_bounds": case.bounds.shares(f),
        },
        "controller": parts,
    }
    loop: dict[str, Any] = {} if case.period is None else {
        "loop": {"rate_hz": 1.0 / case.period, "delay_us": 0.0, "method": "tustin"}
    }  # fmt: skip
    controller = controller_dict(made.controller) | {"sections": parts | loop}
    return InnerAnswer("verified" if made.usable else "not_verified", figures, controller)


def _loop_entry(case: MeasuredCase, made: MeasuredDesign) -> dict[str, Any]:
    """Margins on the lines; nothing of an unstable loop."""
    if made.controller is None or made.figures is None or not made.figures.stable:
        return {}
    joints = [(HZ * one.hz, one.matrix @ controller_response(made.controller, one.hz, case.period))
              for one in case.responses]  # fmt: skip
    loops = [(omega, open_alone(L, i)) for omega, L in joints for i in range(L.shape[1])]
    return measured_entry(loops, made.controller, made.bandwidth, made.figures.S_peak)
