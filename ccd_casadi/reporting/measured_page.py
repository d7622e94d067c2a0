"""The page of a controller on a measured response: figures, sections, the loop on its lines."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.cases.measured_case import MeasuredCase
from ccd_casadi.fixed_structure.measured_loop import between, controller_response
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.reporting.facts import Fact, loop_facts
from ccd_casadi.reporting.lines import Curve, Level, figure_lines
from ccd_casadi.reporting.loops import bandwidth_level, forbidden, over_hz, sensitivity_panel
from ccd_casadi.reporting.nyquist import FAR, nyquist_panel
from ccd_casadi.reporting.page import (
    Section,
    facts_html,
    figure_html,
    header,
    number,
    page,
    paragraph,
)
from ccd_casadi.reporting.sections_page import controller_html
from ccd_casadi.reporting.svg import GREY
from ccd_casadi.reporting.tables import over_frequency
from ccd_casadi.support.units import HZ
from surrogates.files import write_whole

HEIGHT = 3.0  # inches of a row


def write_measured(
    folder: Path, case: MeasuredCase, controller: StateSpace, answer: Mapping[str, Any]
) -> Path:
    """Write `folder`/report.html of a stable design; `answer` is what `inner` prints of it."""
    good = answer["status"] == "verified"
    lines = f"{len(case.responses[0].hz)} lines of {case.file}"
    lead = (
        f"A controller of order {answer['controller']['order']} with a bandwidth of "
        f"{number(answer['bandwidth_hz'])} Hz, designed and judged on {lines}; no model."
    )
    head = header(
        f"Controller on {case.file}", good, "verified" if good else "not verified",
        answer["reason"], f"{case.path.name} · {lines}", lead,
    )  # fmt: skip
    sections = [
        Section("The loop on the lines", _loop_html(case, controller, answer)),
        Section("The figures", facts_html(_facts(case, answer))
                + paragraph(f"What this rests on: {answer['words']}.")),
        Section("The controller", controller_html(answer)),
    ]  # fmt: skip
    path = folder / "report.html"
    write_whole(path, page(f"Controller on {case.file}", sections, head, index=""))
    return path


def _loop_html(case: MeasuredCase, controller: StateSpace, answer: Mapping[str, Any]) -> str:
    """|S| and the Nyquist plot, |G| and |L|, |KS| and |T|: values at the lines, joined straight."""
    hz, G, bounds = case.responses[0].hz, case.responses[0].G, case.bounds
    K = controller_response(controller, hz, case.period)[:, 0, 0]
    L = G * K
    S, ends = 1.0 / (1.0 + L), (float(hz[0]), float(hz[-1]))
    size = np.abs(S)
    reach = between(hz, L[:, None, None])  # of |S| between two lines, drawn at their middle
    top = 2.5 * max(bounds.S_max, float(size.max()))
    at = bandwidth_level(answer["bandwidth_hz"])
    locus = np.where(np.abs(L) <= FAR, L, np.nan)
    allowed = Curve(np.sqrt(hz[1:] * hz[:-1]), np.where(reach < np.inf, reach, np.nan),
                    "at most between lines", GREY, width=0.9)  # fmt: skip
    rows = [
        [sensitivity_panel(
            (allowed, Curve(hz, size, "at the lines")), ends, bounds.S_max, (at,), "|S| (–)",
            y_range=(0.5 * float(size.min()), top),
            forbidden=forbidden(bounds.S_max, bounds.S_low, bounds.omega_low / HZ, *ends, top)),
         nyquist_panel([locus], bounds.S_max, HEIGHT)],
        [over_hz("|G| measured (m/N)", (Curve(hz, np.abs(G)),), ends),
         over_hz("|L| (–)", (Curve(hz, np.abs(L)),), ends, levels=(Level(1.0, "1"), at))],
        [over_hz("|KS| (N/m)", (Curve(hz, np.abs(K * S)),), ends, levels=(at,)),
         over_hz("|T| (–)", (Curve(hz, np.abs(L * S)),), ends, levels=(at,))],
    ]  # fmt: skip
    svg = figure_lines(rows, key="measured", title="The loop on the measured lines",
                       heights=(HEIGHT, 2.6, 2.6))  # fmt: skip
    words = (
        "Every bound is asked for on every line: S out of the shaded area, L out of the disk. "
        "Grey: what |S| may reach between two lines, if GK bends there as around them. A resonance "
        "that fits between two lines is not seen."
    )
    table = over_frequency(
        ("Hz", "|G| m/N", "|S|", "Re L", "Im L", "|KS| N/m", "|T|"),
        hz, np.abs(G), size, L.real, L.imag, np.abs(K * S), np.abs(L * S),
        special=[answer["bandwidth_hz"], answer["sensitivity_peak_hz"]],
    )  # fmt: skip
    return figure_html(svg, words, table)


def _facts(case: MeasuredCase, answer: Mapping[str, Any]) -> list[Fact]:
    bounds, shares = case.bounds, answer["certificate"]["figures_over_bounds"]
    runs = "continuous" if case.period is None else (
        f"sampled at {number(1.0 / case.period)} Hz; hold and delay are in the response"
    )  # fmt: skip
    found = [
        ("Bandwidth", f"{number(answer['bandwidth_hz'])} Hz", runs),
        ("Peak of S", number(answer["sensitivity_peak"]),
         f"at {number(answer['sensitivity_peak_hz'], 4)} Hz, S_max {bounds.S_max:g}; between lines "
         f"at most {number(answer['sensitivity_peak_between_lines'])}"),
        ("|S| at ω_low", number(answer["sensitivity_low"]),
         f"at most {bounds.S_low:g} at {number(bounds.omega_low / HZ)} Hz"),
        ("Compliance", f"{number(1e6 * answer['compliance_max'], 4)} µm/N", "the largest |GS|"),
        *loop_facts(answer),
        ("Largest |KS|", f"{number(answer['KS_max'], 4)} N/m", ""),
    ]  # fmt: skip
    names = {"S_max": "S_max", "S_low": "S_low", "KS": "weighted KS", "T": "weighted T",
             "GS": "compliance_max"}  # fmt: skip
    over = ", ".join(f"{names[key]} {number(share, 4)}" for key, share in shares.items())
    return [*found, ("Figures over bounds", over, "1 is on the bound")]
