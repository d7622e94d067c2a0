"""Figures of the loops that a controller of fixed structure closes on every plant of its set."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ccd_casadi.analysis.loop_figures import force_step
from ccd_casadi.fixed_structure import SectionsDesign
from ccd_casadi.fixed_structure.composite import CompositeProblem, largest_gains
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.loop_problem import Problem
from ccd_casadi.fixed_structure.sections_design import in_problem_units
from ccd_casadi.fixed_structure.structure import response
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_plant_set import bounds_of, plants_of, sections_of_problem
from ccd_casadi.reporting.bode import phase_deg
from ccd_casadi.reporting.lines import Band, Curve, Level, Panel, figure_lines
from ccd_casadi.reporting.loops import Areas, above, forbidden, section_bounds
from ccd_casadi.reporting.page import figure_html, number
from ccd_casadi.reporting.svg import CYCLE, GREY, ORANGE
from ccd_casadi.reporting.tables import over_frequency, over_time
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ, counted

if TYPE_CHECKING:
    from ccd_casadi.codesign.verified_sections import VerifiedSections

POINTS = 700
BOUNDS = {"S": "its shape", "KS": "weighted_level/|W_KS|", "T": "weighted_level/|W_T|"}
SETTLED = 4.0  # time constants of the slowest pole that the force step is shown for
STEPS = 200  # points of it


@dataclass(frozen=True)
class Loops:
    """S, KS (N/m), T, L and GS (m/N) of every plant (rows) over Hz; `bounds` of S, KS, T (3, k).

    Of several channels the largest singular values, and no L; GS only where the case bounds it.
    """

    hz: Array
    S: np.ndarray
    KS: np.ndarray
    T: np.ndarray
    L: np.ndarray
    GS: np.ndarray
    bounds: Array


def loops_of(problem: CoDesignProblem, theta: Sequence[float], made: SectionsDesign) -> Loops:
    """The loops of all plants of the set at θ, hold and delay exact where they are sampled."""
    sampling = sections_of_problem(problem).sampling
    inside = problem_for(
        plants_of(problem, theta),
        made.structure,
        bounds_of(problem),
        sampling,
        made.frequencies,
    )
    P = inside.plants
    poles = P.poles
    if isinstance(inside, CompositeProblem):
        poles = np.concatenate([part.problem.plants.poles.ravel() for part in inside.parts])
    low = 0.2 * problem.inner.omega_low
    high = 20.0 * float(np.abs(poles).max()) * P.omega_0
    if sampling is not None:
        high = min(high, 0.98 * np.pi / sampling.period)
    near = np.abs(poles.imag)[..., None] + np.abs(poles.real)[..., None] * np.linspace(-12, 12, 97)
    omega = np.concatenate([np.geomspace(low, high, POINTS), near.ravel() * P.omega_0])
    omega = np.unique(omega[(omega >= low) & (omega <= high)])
    v = P.variable(omega / P.omega_0)
    kappa = in_problem_units(inside, made.kappa)
    bounds = section_bounds(problem, omega / HZ, made.bandwidth / HZ)
    nothing = np.zeros((0, len(v)))
    if isinstance(inside, CompositeProblem):
        S, KS, T = largest_gains(inside, kappa, v)
        return Loops(omega / HZ, S, KS * P.force, T, nothing, nothing, bounds)
    assert isinstance(inside, Problem)
    which, grid = np.meshgrid(np.arange(len(P.plants)), v, indexing="ij")
    K = response(inside.structure, kappa, 1j * v)
    L = P.responses(which, grid)[0][..., 0, 0] * K
    S = 1.0 / (1.0 + L)
    GS = nothing
    if inside.bounds.compliance_max is not None:
        GS = np.abs(P.responses(which, grid, free=True)[0][..., 0, 0] * S) / P.force
    return Loops(omega / HZ, S, K * P.force * S, 1.0 - S, L, GS, bounds)


def compared_html(
    problem: CoDesignProblem, designs: Mapping[str, tuple[Sequence[float], SectionsDesign]]
) -> str:
    """|S| of several designs, each the largest on the plants of the set at its θ."""
    found = {name: loops_of(problem, theta, made) for name, (theta, made) in designs.items()}
    inner = problem.inner
    curves, tables, words = [], [], []
    for i, (name, loops) in enumerate(found.items()):
        top, hz = np.abs(loops.S).max(axis=0), designs[name][1].bandwidth / HZ
        curves.append(Curve(loops.hz, top, name, CYCLE[i % len(CYCLE)]))
        words.append(f"{name}: ω_b = {hz:.2f} Hz, ‖S‖∞ = {top.max():.3f}")
        tables.append(over_time((f"Hz, {name}", "|S| largest"), loops.hz, top))
    levels = (
        Level(inner.S_max, f"S_max {inner.S_max:g}", colour=GREY),
        Level(2**-0.5, "-3 dB", colour=GREY),
    )
    panel = Panel("frequency (Hz)", "largest |S| (–)", tuple(curves), levels=levels, log_x=True,
                  log_y=True, legend="lower right")  # fmt: skip
    svg = figure_lines([[panel]], key="sections-compared", heights=(3.6,),
                       title="Largest S on the plants of the set, several designs")  # fmt: skip
    return figure_html(svg, f"The largest on the plants of the set. {'; '.join(words)}.", *tables)


def gain_panels(
    problem: CoDesignProblem, verified: "VerifiedSections", loops: Loops
) -> tuple[Panel, Panel, Panel]:
    """S, KS and T with what is forbidden to them, each as the model's and a band of all plants."""
    inner, bandwidth = problem.inner, verified.design.bandwidth / HZ
    x = (float(loops.hz[0]), float(loops.hz[-1]))

    def panel(i: int, label: str, gains: np.ndarray, levels: Sequence[Level]) -> Panel:
        made = loop_panel(loops, label, np.abs(gains), levels)
        bound, size = loops.bounds[i], np.abs(gains)
        if not np.isfinite(bound).any():
            return made
        top = 4.0 * float(size.max())
        curves = (
            *made.curves,
            Curve(loops.hz, bound, list(BOUNDS.values())[i], ORANGE, "--", width=0.9),
        )
        low = max(float(size.min()) / 1.5, 1e-6 * top)
        return replace(made, curves=curves, y_range=(low, top),
                       forbidden=above(loops.hz, bound, top))  # fmt: skip

    def gain(of: str) -> str:  # of several channels the largest singular value
        return f"|{of}|" if len(loops.L) else f"σ_max({of})"

    at = Level(bandwidth, f"ω_b {number(bandwidth, 4)} Hz", True)
    unnamed = replace(at, text="")
    asked = Level(inner.S_max, f"S_max {inner.S_max:g}", colour=GREY)
    S = panel(0, f"{gain('S')} (–)", loops.S, (asked, Level(2**-0.5, "-3 dB", colour=GREY), at))
    KS = panel(1, f"{gain('KS')} (N/m)", loops.KS, (unnamed,))
    T = panel(2, f"{gain('T')} (–)", loops.T, (unnamed,))
    top = 2.5 * max(inner.S_max, float(np.abs(loops.S).max()))
    areas: Areas = (*forbidden(inner, x[0], x[1], top), *S.forbidden)
    S = replace(S, forbidden=areas,
                y_range=(0.5 * float(np.abs(loops.S[0]).min()), top))  # fmt: skip
    return S, KS, T


def loop_panel(
    loops: Loops, label: str, values: np.ndarray, levels: Sequence[Level] = (), *, log: bool = True
) -> Panel:
    """Values of every plant over frequency: the model's in a band of all."""
    band = Band(loops.hz, values.min(axis=0), values.max(axis=0), "all plants")
    curve = Curve(loops.hz, values[0], "the model")
    ends = (float(loops.hz[0]), float(loops.hz[-1]))
    return Panel("frequency (Hz)", label, (curve,), (band,), levels=tuple(levels), log_x=True,
                 log_y=log, x_range=ends, legend="lower right",
                 y_step=None if log else 90.0)  # fmt: skip


def _open_loop(problem: CoDesignProblem, verified: "VerifiedSections", loops: Loops) -> list:
    """L of one channel as a Bode plot, and |GS| where it is bounded."""
    rows: list[list[Panel]] = []
    if len(loops.L):
        hz = verified.design.bandwidth / HZ
        at = Level(hz, "", True)  # as above
        phase = phase_deg(loops.L.T).T
        rows.append([
            loop_panel(loops, "|L| (–)", np.abs(loops.L), (Level(1.0, "1", colour=GREY), at)),
            loop_panel(loops, "phase of L (deg)", phase, (Level(-180.0, "", colour=GREY), at),
                       log=False),
        ])  # fmt: skip
    most = sections_of_problem(problem).compliance_max
    if len(loops.GS) and most is not None:
        level = Level(1e6 * most, f"compliance_max {1e6 * most:g} µm/N", colour=GREY)
        rows.append([loop_panel(loops, "|GS| (µm/N)", 1e6 * loops.GS, (level,))])
    return rows


def gains_html(
    problem: CoDesignProblem,
    verified: "VerifiedSections",
    loops: Loops,
    *,
    key: str = "sections-loop",
) -> str:
    """S, KS, T, L and GS of the model in a band of all plants; `key` is unique in the page."""
    S, KS, T = gain_panels(problem, verified, loops)

    def gain(of: str) -> str:
        return f"|{of}|" if len(loops.L) else f"σ_max({of})"

    more = _open_loop(problem, verified, loops)
    svg = figure_lines([[S], [KS, T], *more], key=key, heights=(3.4, *[2.6] * (1 + len(more))),
                       title="The loop of every plant of the set over frequency")  # fmt: skip
    S_size, KS_size, T_size = np.abs(loops.S), np.abs(loops.KS), np.abs(loops.T)
    table = over_frequency(
        ("Hz", f"{gain('S')} model", f"{gain('S')} least", f"{gain('S')} largest",
         f"{gain('KS')} largest N/m", f"{gain('T')} largest"),
        loops.hz, S_size[0], S_size.min(axis=0), *(of.max(axis=0) for of in (S_size, KS_size,
                                                                             T_size)),
    )  # fmt: skip
    one = "The set holds one plant, the model." if len(loops.S) == 1 else (
        f"The band spans {counted(len(loops.S), 'plant')} of the set."
    )  # fmt: skip
    words = f"{one} {' '.join(_closest(loops))} Shaded: beyond a bound of the case."
    return figure_html(svg, words, table)


def _closest(loops: Loops) -> list[str]:
    """How near S, KS and T come to their bounds on any plant."""
    found = []
    for name, gains, bound in zip(BOUNDS, (loops.S, loops.KS, loops.T), loops.bounds, strict=True):
        share = np.abs(gains).max(axis=0) / bound
        if np.isfinite(share).any():
            i = int(np.nanargmax(share))
            told = f"{100.0 * share[i]:.4g} % of {BOUNDS[name]} at {number(float(loops.hz[i]), 3)}"
            found.append(f"|{name}| comes to {told} Hz.")
    return found


def force_step_html(verified: "VerifiedSections") -> str:
    """The position of every plant after a step of force at the actuator."""
    certificate = verified.design.certificate
    assert certificate is not None
    assert verified.design.controller is not None
    sampling = sections_of_problem(verified.problem).sampling
    slow = min(-plant.stability for plant in certificate.plants)
    if sampling is not None:
        slow = -float(np.log1p(-slow)) / sampling.period
    times = np.geomspace(0.02 / verified.design.bandwidth, SETTLED / slow, STEPS)
    plants = plants_of(verified.problem, verified.theta)
    K = verified.design.controller
    steps = [force_step(p.plant_si(), K, sampling, times) for p in plants]
    t = steps[0][0]
    y = 1e6 * np.array([step[1] for step in steps])
    step = Panel("time (ms)", "y after a step of 1 N (µm)", (Curve(1e3 * t, y[0], "the model"),),
                 (Band(1e3 * t, y.min(axis=0), y.max(axis=0), "all plants"),), log_x=True,
                 legend="upper left")  # fmt: skip
    svg = figure_lines([[step]], key="sections-force", heights=(3.2,),
                       title="A step of force on every plant")  # fmt: skip
    head = ("ms", "µm model", "µm least", "µm largest")
    table = over_time(head, 1e3 * t, y[0], y.min(axis=0), y.max(axis=0))
    moved = counted(len(y), "plant")
    words = f"A force of 1 N at the actuator moves {moved} of the set, until they rest."
    return figure_html(svg, words, table)
