"""What is drawn and said of one design: the curves of its loop, words, and a panel a figure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ccd_casadi.analysis import LIMITS
from ccd_casadi.analysis.loop_channels import sampled_figures
from ccd_casadi.analysis.loop_figures import step_response
from ccd_casadi.analysis.loop_view import LoopView, frequency_and_damping, loop_view
from ccd_casadi.analysis.move import Move, MoveOptions, moves
from ccd_casadi.analysis.setpoint import setpoint
from ccd_casadi.analysis.setpoint_feedforward import feedforward_of
from ccd_casadi.drawing.content import Area, Curve, Level, Lines, Modes, Panel
from ccd_casadi.drawing.paint import block_html, escape
from ccd_casadi.drawing.svg import AMBER, BLUE, GREEN, GREY, PURPLE
from ccd_casadi.extensions.explorer.designs import ExploredDesign, Standing
from ccd_casadi.extensions.explorer.knobs import Notched
from ccd_casadi.inner_problem.kinds import kind_of, loop_on
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_bandwidth import motion_of
from ccd_casadi.inner_problem.sweep import missed_by
from ccd_casadi.lti.frequency_grid import frequency_grid
from ccd_casadi.lti.loop import Loop, Sampling
from ccd_casadi.lti.state_space import StateSpace, sigma_max
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.reporting.gain_figures import gain_panels
from ccd_casadi.reporting.machine import SHOWN_MODES, lumped_machine
from ccd_casadi.reporting.nyquist import loci_of, loop_panels, nyquist_panel, size_panels
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, number, spoken, template, with_unit

POINTS = 180  # of the frequency grid, besides those around resonances
STEP_POINTS = 240
STEP_PERIODS = 5.0  # of the bandwidth
WATCHED = 2.0  # durations of the move that are shown
SAME_PEAK = 1e-3  # relative: two values of one peak of S
NO_TIME = np.zeros(0)
AT_REST = Move(NO_TIME, NO_TIME, NO_TIME, np.zeros((0, 1)), False, 0.0, LIMITS.window)


@dataclass(frozen=True)
class Curves:
    """The curves of one design: its loop on the plant that is shown, over frequency and over time.

    Attributes
    ----------
    view : LoopView
        Responses of the loop.
    step_time, step : array (N,)
        s, and the first output after a unit step of its reference.
    move : Move
        Of the first output, with feedforward.

    An unstable loop has no step and no move (`AT_REST`).
    """

    view: LoopView
    step_time: Array
    step: Array
    move: Move

    @cached_property
    def poles(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The poles of the plant, of K and of the loop (of a sampled one ln(z)/T): complex, Hz."""
        loop = self.view.loop
        return loop.plant.poles / HZ, loop.controller.poles / HZ, loop.poles / HZ

    @property
    def unstable(self) -> bool:
        """Whether the loop is unstable: it has no step, no move and no margins."""
        return not self.view.loop.stable

    @property
    def unstable_controller_hz(self) -> list[float]:
        """|p| of the unstable poles p of K by itself, a pair once, ascending."""
        K = self.poles[1]
        return sorted(np.abs(K[(K.real > 1e-9 * np.abs(K)) & (K.imag >= 0.0)]).tolist())


@dataclass(frozen=True)
class AsSampled:
    """The same controller by Tustin's rule at a rate, hold and delay exact: judged, not designed.

    `stable`, ω_b in Hz and ‖S‖∞ are of the sampled loop; σ_max(S) over Hz up to half the rate.
    """

    stable: bool
    bandwidth_hz: float
    peak: float
    hz: Array
    gain: Array


def curves_of(design: ExploredDesign) -> Curves | None:
    """The curves of a design; None where its synthesis ended without a controller."""
    if design.controller is None:
        return None
    plant, K, problem = design.plant, design.controller, design.problem
    loop = loop_on(problem, plant.plant_si(), K)
    bandwidth = design.bandwidth_hz if np.isfinite(design.bandwidth_hz) else plant.omega_0 / HZ
    gamma = float(np.nan_to_num(design.figures.certificate.norm_bound))
    bounded = kind_of(problem).gain_bounds(design.weights, gamma, design.bandwidth_hz)
    f = design.figures
    top, at = f.sensitivity_peak, f.sensitivity_peak_frequency
    # The peak is the largest of the set: it is marked where it is of the plant that is drawn.
    here = float(sigma_max(loop.sensitivity(np.array([at])))[0]) if at > 0.0 else np.nan
    peaks = ((at / HZ, top),) if abs(here / top - 1.0) < SAME_PEAK else None
    view = loop_view([loop], bounded, bandwidth_hz=bandwidth, points=POINTS, peaks=peaks)
    time, step, move = NO_TIME, NO_TIME, AT_REST
    if loop.stable:
        first = np.eye(loop.closed.B_r.shape[1])[0]
        time, y = step_response(loop, first, STEP_PERIODS / bandwidth, STEP_POINTS)
        step, move = y[:, 0], _compute_move(design, loop, bandwidth)
    return Curves(view, time, step, move)


def _compute_move(design: ExploredDesign, loop: Loop, bandwidth_hz: float) -> Move:
    """The move of [move], else the default one of robustness, of the first output."""
    profile, window = setpoint(LIMITS), LIMITS.window
    ahead = feedforward_of(loop, 0)
    if design.problem.source.motion is not None:
        motion = motion_of(design.problem, design.theta)
        profile, window, ahead = motion.cycle.profile, motion.motion.window, motion.forward
    ((made,),) = moves(
        [loop], [ahead], profile, axis=0, window=window, bandwidth_hz=bandwidth_hz,
        options=MoveOptions(doublings=1, patient_doublings=1),
    )  # fmt: skip
    return made.until(WATCHED * made.duration)


def sampled_of(design: ExploredDesign) -> AsSampled | None:
    """A certified design at the rate and delay of its sliders; None where it is designed for it."""
    refused = design.standing is Standing.REFUSED
    if design.controller is None or refused or kind_of(design.problem).as_designed:
        return None
    return as_sampled(design.plant, design.controller, design.knobs.rate_hz, design.knobs.delay_us)


def with_sampled(design: ExploredDesign, found: AsSampled | None) -> ExploredDesign:
    """The design with the standing that its sampled loop leaves it."""
    k, S_max = design.knobs, design.problem.inner.S_max
    if found is None or (found.stable and found.peak <= S_max):
        return design
    at = f"as sampled at {k.rate_hz:.4g} Hz with a delay of {k.delay_us:.4g} µs"
    if not found.stable:
        return replace(design, standing=Standing.REFUSED, reason=f"the loop is unstable {at}")
    if design.standing is not Standing.KEPT:
        return design  # it is no better already
    over = missed_by(found.peak, S_max)
    return replace(design, standing=Standing.MISSED, reason=f"{at} the peak of S is {over}")


def as_sampled(
    plant: ScaledPlant, controller: StateSpace, rate_hz: float, delay_us: float
) -> AsSampled:
    """A controller by Tustin's rule on a plant: stability, ω_b and ‖S‖∞, hold and delay exact."""
    loop = Loop(plant.plant_si(), controller, Sampling(rate_hz, delay_us))
    f = sampled_figures(loop.closed.S)
    near = plant.grid * plant.omega_0 / HZ
    hz = frequency_grid(1e-4 * rate_hz, 0.499 * rate_hz, POINTS, near)
    gain = sigma_max(loop.sensitivity(HZ * hz))
    return AsSampled(f.stable, f.bandwidth / HZ, f.sensitivity_peak, hz, gain)


def standing_html(
    design: ExploredDesign, curves: Curves | None, sampled: AsSampled | None,
    beside: tuple[str, float] | None = None,
) -> str:  # fmt: skip
    """The verdict, ω_b and the figures, what it survives, how it was chosen and on which plant.

    `beside`: another design's name and its ω_b in Hz, which the bandwidth is compared with.
    """
    known = beside is not None and np.isfinite(beside[1])
    return template("extensions/explorer/assets/standing.html", number=number, HZ=HZ).render(
        design=design, beside=beside if known else None, curves=curves, sampled=sampled,
    )  # fmt: skip


def move_words(curves: Curves | None, own: bool = False) -> str:
    """Describe the figure of the move; `own`: it is that of the case."""
    if curves is None or curves.unstable:
        return ""
    if own:
        return "that of [move], with feedforward up to snap"
    return f"the default one of robustness, {curves.move.words}"


def machine_html(design: ExploredDesign, start: Sequence[float], reference: float) -> str:
    """Draw the machine beside that of the start, masses and springs, or its modes."""
    plant = plant_of(design.problem)
    if plant.drawing is not None:
        drawn = plant.drawing({"this design": design.theta, "the start": start}).drawing
        if isinstance(drawn, Lines):  # the first row alone: it is drawn while one drags
            drawn = replace(drawn, rows=drawn.rows[:1], heights=drawn.heights[:1])
        return f'<div class="drawn">{block_html(drawn, "machine")}</div>'
    return block_html(lumped_machine(design.elements.system, design.modal, reference), "machine")


def surface_modes_html(problem: CoDesignProblem, theta: Sequence[float]) -> str:
    """The first flexible modes on the plant's surface; empty for a plant that has none."""
    plant = plant_of(problem)
    if plant.shapes is None:
        return ""
    pairs = zip(problem.names, problem.units, theta, strict=True)
    shown = ", ".join(f"{name} = {with_unit(value, unit, 4)}" for name, unit, value in pairs)
    modes = block_html(Modes(plant.shapes(theta, SHOWN_MODES)))
    return f"<p>modes of the last θ solved: {escape(shown)}</p>{modes}"


# Name of a figure -> its heading, and whether its axes are logarithmic.
FIGURES: dict[str, tuple[str, bool, bool]] = {
    "S": ("Sensitivity S", True, True),
    "L": ("Loop L = GK", True, True),
    "phase": ("Phase of L", True, False),
    "nyquist": ("Nyquist plot of L = GK", False, False),
    "KS": ("Control sensitivity KS", True, True),
    "T": ("Complementary sensitivity T", True, True),
    "K": ("Controller K", True, True),
    "G": ("Plant G", True, True),
    "poles": ("Poles", True, False),
    "step": ("Step of the reference", False, False),
    "move": ("Error of a move", False, False),
}
OVER_HZ = ("S", "L", "phase", "KS", "T", "K", "G")  # these share their axis
SLOWEST = 0.1  # of the least frequency shown: where slower poles are drawn
EMPTY = Panel("", "")
UNSTABLE = Area(np.array([1e-9, 1e12, 1e12, 1e-9]), np.array([-9.0, -9.0, 0.0, 0.0]))
# Standing -> colour and dashes of a design's curves; no dashes: each as its panel has it.
STYLES = {
    Standing.KEPT: (BLUE, ""), Standing.MISSED: (AMBER, ""), Standing.NEAR: (GREY, ":"),
    Standing.REFUSED: (GREY, "--"),
}  # fmt: skip


@dataclass(frozen=True)
class Drawn:
    """A design, and the panels that show it by the name of their figure; none without curves."""

    design: ExploredDesign
    panels: Mapping[str, Panel]


def draw_design(
    design: ExploredDesign,
    c: Curves | None,
    sampled: AsSampled | None,
    notched: Notched | None = None,
) -> Drawn:
    """The panels of a design (no curves: it has no controller), with the loop as sampled and the
    one with a notch where they are wanted."""
    if c is None:
        return Drawn(design, {})
    certified, view = design.standing is not Standing.REFUSED, c.view
    S, KS, T = gain_panels([view], bounds=certified)
    if sampled is not None:
        late = Curve(sampled.hz, sampled.gain, "as sampled", PURPLE, "-.", width=1.6)
        S = replace(S, curves=(*S.curves, late))
    L, phase = loop_panels(view, stable=not c.unstable)
    G, K = size_panels(view)
    panels = {"S": S, "KS": KS, "T": T, "L": L, "phase": phase, "K": K, "G": G}
    if not certified:  # there is no ω_b
        panels = {name: replace(panel, levels=tuple(v for v in panel.levels if not v.vertical),
                                marks=tuple(m for m in panel.marks if not m.text.startswith("ω_b")))
                  for name, panel in panels.items()}  # fmt: skip
    loci = list(loci_of(view.open[0]).T)
    panels |= {
        "nyquist": nyquist_panel(view.hz, loci, view.bounded.S_max, others=BLUE),
        "poles": _draw_poles(c),
        "step": _draw_over_time(c.step_time, c.step, "y after a step of r", Level(1.0, "")),
        "move": _draw_over_time(c.move.time, 1e6 * c.move.error, spoken("error (µm)"),
                                Level(1e3 * c.move.duration, "end of the move", True)),
    }  # fmt: skip
    return Drawn(design, panels if notched is None else notched.on(panels))


def _draw_over_time(time: np.ndarray, values: np.ndarray, label: str, level: Level) -> Panel:
    return Panel("time (ms)", label, (Curve(1e3 * time, values),), levels=(level,))


def _draw_poles(c: Curves) -> Panel:
    """Draw the poles of the plant, of K and of the loop: frequency and damping."""
    curves = []
    drawn_designs = (("plant", GREY, "o"), ("controller", GREEN, "^"), ("closed loop", BLUE, "x"))
    for roots, (label, colour, marker) in zip(c.poles, drawn_designs, strict=True):
        hz, damping = frequency_and_damping(roots)
        hz = np.maximum(hz, SLOWEST * c.view.ends[0])  # an integrator's has no place there
        curves.append(Curve(hz, damping, label, colour, "", marker))
    return Panel("|pole| (Hz)", "damping ratio", tuple(curves), log_x=True, y_range=(-0.08, 1.08),
                 forbidden=(UNSTABLE,))  # fmt: skip
