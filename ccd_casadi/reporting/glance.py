"""What an engineer looks at first: the machine, S with what is forbidden to it, Nyquist, a move."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ccd_casadi.analysis.loop import Loop as ClosedLoop
from ccd_casadi.analysis.move import Move
from ccd_casadi.analysis.signals import LIMITS, signals_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant
from ccd_casadi.plants.modal import Suspension, modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.reporting.lines import Curve, Level, Mark, Panel, figure_lines
from ccd_casadi.reporting.loops import forbidden, marked
from ccd_casadi.reporting.machine import lumped, lumped_svg, modes_html, surface_modes_html
from ccd_casadi.reporting.nyquist import around_resonances, loci_of, nyquist_panel
from ccd_casadi.reporting.page import Section, Table, figure_html, number
from ccd_casadi.reporting.sections_loops import Loops, gain_panels
from ccd_casadi.reporting.svg import GREEN, GREY
from ccd_casadi.reporting.tables import over_frequency, over_time
from ccd_casadi.support.units import HZ, counted
from ccd_casadi.synthesis.classical_margins import least_margins
from ccd_casadi.synthesis.closed_loop import responses
from ccd_casadi.synthesis.loop_responses import Loop, loop_data

if TYPE_CHECKING:
    from ccd_casadi.codesign.verified_mixed import VerifiedDesign
    from ccd_casadi.codesign.verified_sections import VerifiedSections

HEIGHT = 3.0  # inches of a row


def glance(problem: CoDesignProblem, verified: "VerifiedDesign", bandwidth_hz: float) -> Section:
    """Of a full-order design on its model."""
    design, inner = verified.design, problem.inner
    K, plant = design.controller, scaled_plant(problem, verified.theta)
    loop = loop_data(
        plant, K, design.weights, gamma=design.figures.gamma, bandwidth_hz=bandwidth_hz,
        omega_low=inner.omega_low,
    )  # fmt: skip
    system = mechanics(plant_of(problem), verified.theta)
    modal = modal_plant(system, Suspension(0.0, 0.0))
    move = signals_of(ClosedLoop(plant.plant_si(), K), modal, bandwidth_hz).move
    fine = np.unique(np.concatenate([loop.hz, around_resonances(plant, K)]))
    fine = fine[(fine >= loop.hz[0]) & (fine <= loop.hz[-1])]
    G, k, _ = responses(plant, K, HZ * fine)
    L = G @ k
    rows: list[list[Panel | str | None]] = [
        [machine(problem, verified.theta), _sensitivity(problem, loop)],
        [nyquist_panel(list(loci_of(L).T), inner.S_max, HEIGHT), _move(move)],
    ]
    peak = design.figures.sensitivity_peak
    words = (
        f"The machine at this design. S stays out of the shaded area: its peak, {number(peak, 4)}, "
        f"is {100.0 * peak / inner.S_max:.4g} % of S_max, so that "
        f"{'L' if L.shape[1] == 1 else 'every eigenvalue of L'} keeps at least "
        f"{number(1.0 / peak, 3)} from -1."
    )
    if L.shape[1:] == (1, 1):
        m = least_margins(lambda omega: responses(plant, K, omega)[:2], HZ * fine)
        words += (
            f" The gain may fall to {number(m.gain_down, 3)} or rise to {number(m.gain_up, 3)} "
            f"times; the phase margin is {number(m.phase_deg, 3)}° and the delay margin "
            f"{number(1e6 * m.delay, 3)} µs."
        )
    words += _move_words(move)
    svg = figure_lines(rows, key="glance", title="At a glance", heights=(HEIGHT, HEIGHT))
    return Section("At a glance", figure_html(svg, words, _table(loop), _move_table(move)))


def glance_of_sections(
    problem: CoDesignProblem,
    verified: "VerifiedSections",
    loops: Loops,
    moves: tuple[list[Panel], str, Table] | None,
) -> str:
    """Of a fixed structure on every plant of its set; of several channels the machine and S."""
    S = gain_panels(problem, verified, loops)[0]
    rows: list[list[Panel | str | None]] = [[machine(problem, verified.theta), S]]
    certificate = verified.design.certificate
    assert certificate is not None
    count, S_max = len(loops.S), problem.inner.S_max
    words = (
        f"The machine at this design, and its loop on {counted(count, 'plant')} of the set (blue: "
        f"the model; band, green: the others). S stays below S_max = {S_max:g}"
    )
    tables = [over_frequency(("Hz", "largest |S|"), loops.hz, np.abs(loops.S).max(axis=0))]
    if moves is not None:
        panels, told, table = moves
        rows.append([nyquist_panel(list(loops.L), S_max, HEIGHT), panels[-1]])
        far = number(1.0 / S_max, 3)
        words += f": in the Nyquist plot L = GK keeps at least {far} from -1. {told}"
        tables.append(table)
    else:
        words += "."
    svg = figure_lines(rows, key="glance", title="At a glance", heights=[HEIGHT] * len(rows))
    return figure_html(svg, words, *tables)


def machine(problem: CoDesignProblem, theta: Sequence[float]) -> str:
    """Masses and springs with their modes, the first modes of a surface, or a table of modes."""
    stage = surface_modes_html(problem, theta)
    if stage:
        return stage
    system = mechanics(plant_of(problem), theta)
    modal, found = modal_plant(system, problem.suspension), lumped(system)
    if found is None:
        return modes_html(modal)
    return lumped_svg(found, modal, float(np.abs(found.masses).max()))


def _sensitivity(problem: CoDesignProblem, loop: Loop) -> Panel:
    inner, S = problem.inner, loop.gains[0]
    ends = float(loop.hz[0]), float(loop.hz[-1])
    top = 3.5 * max(inner.S_max, float(S.max()))  # room for the words at its peak
    tops = sorted((p for p in loop.peaks if p[1] > 1.05), key=lambda p: -p[1])[:1]
    name = "|S|" if loop.plant.shape[1:] == (1, 1) else "σ_max(S)"
    return Panel(
        "frequency (Hz)", f"{name} (–)", (Curve(loop.hz, S, width=1.8),),
        marks=tuple(Mark(hz, gain, f"{gain:.3g} at {number(hz, 4)} Hz")
                    for hz, gain in tops),
        levels=(
            Level(inner.S_max, f"S_max {inner.S_max:g}", colour=GREY),
            Level(2**-0.5, "-3 dB", colour=GREY),
            Level(loop.bandwidth_hz, f"ω_b {number(loop.bandwidth_hz, 4)} Hz", True, GREEN),
        ),
        log_x=True, log_y=True, x_range=ends, y_range=(0.5 * float(S.min()), top),
        forbidden=forbidden(inner, *ends, top),
    )  # fmt: skip


def _move(move: Move) -> Panel:
    at = np.unique(np.linspace(0, len(move.time) - 1, 700).astype(int))
    end = (Level(1e3 * move.duration, "end of the move", True, GREY),)
    curve = Curve(1e3 * move.time[at], 1e6 * move.error[at], width=1.6)
    return Panel("time (ms)", "error of a move (µm)", (curve,), levels=end)


def _move_words(move: Move) -> str:
    return (
        f" A move of {number(1e3 * LIMITS.stroke)} mm in {number(1e3 * move.duration, 4)} ms "
        f"({move.words}) errs by at most {number(1e6 * float(np.abs(move.error).max()), 3)} µm on "
        "the model (other moves: robustness)."
    )


def _table(loop: Loop) -> Table:
    L = loop.plant @ loop.controller
    if L.shape[1:] != (1, 1):
        return over_frequency(("Hz", "σ_max(S)"), loop.hz, loop.gains[0], special=marked(loop))
    L = L[:, 0, 0]
    return over_frequency(
        ("Hz", "|S|", "Re L", "Im L"), loop.hz, loop.gains[0], L.real, L.imag, special=marked(loop)
    )


def _move_table(move: Move) -> Table:
    return over_time(("ms", "error µm"), 1e3 * move.time, 1e6 * move.error)
