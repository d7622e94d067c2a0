"""What the explorer shows of a design: the panels that pages show, and four of its own."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.analysis.loop_view import frequency_and_damping
from ccd_casadi.drawing.content import Area, Curve, Level, Panel
from ccd_casadi.drawing.svg import AMBER, BLUE, GREEN, GREY, PURPLE
from ccd_casadi.explorer.curves import AsSampled, Curves
from ccd_casadi.explorer.designs import Look, Standing
from ccd_casadi.reporting.bode import loop_panels, size_panels
from ccd_casadi.reporting.loops import gain_panels
from ccd_casadi.reporting.nyquist import loci_of, nyquist_panel

# Name of a figure -> its heading, and whether its axes are logarithmic.
FIGURES: dict[str, tuple[str, bool, bool]] = {
    "S": ("Sensitivity S", True, True),
    "nyquist": ("Nyquist plot of L = GK", False, False),
    "L": ("Loop L = GK", True, True),
    "phase": ("Phase of L", True, False),
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
LOOKS = {
    Standing.KEPT: (BLUE, ""), Standing.MISSED: (AMBER, ""), Standing.NEAR: (GREY, ":"),
    Standing.REFUSED: (GREY, "--"),
}  # fmt: skip


@dataclass(frozen=True)
class Drawn:
    """A design, and the panels that show it by the name of their figure; none without curves."""

    look: Look
    panels: Mapping[str, Panel]


def drawn(look: Look, c: Curves | None, sampled: AsSampled | None) -> Drawn:
    """The panels of a design (no curves: it has no controller), with the loop as sampled if it was
    asked."""
    if c is None:
        return Drawn(look, {})
    certified, view = look.standing is not Standing.REFUSED, c.view
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
        "poles": _poles(c),
        "step": _over_time(c.step_time, c.step, "y after a step of r", Level(1.0, "")),
        "move": _over_time(c.move.time, 1e6 * c.move.error, "error (µm)",
                           Level(1e3 * c.move.duration, "end of the move", True)),
    }  # fmt: skip
    return Drawn(look, panels)


def _over_time(time: np.ndarray, values: np.ndarray, label: str, level: Level) -> Panel:
    return Panel("time (ms)", label, (Curve(1e3 * time, values),), levels=(level,))


def _poles(c: Curves) -> Panel:
    """Of the plant, of K and of the loop: frequency and damping."""
    curves = []
    looks = (("plant", GREY, "o"), ("controller", GREEN, "^"), ("closed loop", BLUE, "x"))
    for roots, (label, colour, marker) in zip(c.poles, looks, strict=True):
        hz, damping = frequency_and_damping(roots)
        hz = np.maximum(hz, SLOWEST * c.view.ends[0])  # an integrator's has no place there
        curves.append(Curve(hz, damping, label, colour, "", marker))
    return Panel("|pole| (Hz)", "damping ratio", tuple(curves), log_x=True, y_range=(-0.08, 1.08),
                 forbidden=(UNSTABLE,))  # fmt: skip
