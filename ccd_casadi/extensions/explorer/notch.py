"""A notch that is tried by hand in the loop that is drawn: judged on the model, not designed."""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView, phase_deg
from ccd_casadi.drawing.content import Curve, Panel
from ccd_casadi.drawing.svg import PURPLE
from ccd_casadi.lti.loop import tustin
from ccd_casadi.lti.state_space import StateSpace, sigma_max
from ccd_casadi.reporting.nyquist import loci_of
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, number
from ccd_casadi.synthesis.closed_loop import ClassicalMargins, least_margins


@dataclass(frozen=True)
class NotchOptions:
    """Ranges of the notch's sliders.

    Attributes
    ----------
    deepest, none : float
        Least gain at its frequency, and the gain from which on it is no notch.
    damping : tuple of float
        Least, first and largest damping ratio of its poles: half its width over its frequency.
    beside : float
        How far its flanks are looked at, in widths.
    """

    deepest: float = 0.01
    none: float = 0.99
    damping: tuple[float, float, float] = (0.02, 0.3, 2.0)
    beside: float = 3.0


@dataclass(frozen=True)
class Notch:
    """(s² + 2ζdωs + ω²) / (s² + 2ζωs + ω²): the gain `depth` d at `hz`, 1 far from it."""

    hz: float
    depth: float
    damping: float

    def behind(self, controller: StateSpace) -> StateSpace:
        """The controller with this notch at each of its outputs."""
        omega, count = HZ * self.hz, len(controller.C)
        wide = 2.0 * self.damping * omega
        one = StateSpace(
            np.array([[0.0, omega], [-omega, -wide]]), np.array([[0.0], [1.0]]),
            np.array([[0.0, (self.depth - 1.0) * wide]]), np.eye(1),
        )  # fmt: skip
        if controller.period:
            one = tustin(one, controller.period)
        A, B, C, D = (
            np.asarray(np.kron(np.eye(count), part), float) for part in (one.A, one.B, one.C, one.D)
        )
        return controller.series(StateSpace(A, B, C, D, period=one.period))


@dataclass(frozen=True)
class Notched:
    """The loop that is drawn, with a notch: recomputed from controller and plant.

    Attributes
    ----------
    notch : Notch
    stable : bool
        By the poles of the closed loop, hold and delay exact.
    hz : (k,) array
        The page's frequencies, and those around the notch, Hz.
    open : (k, p, p) array
        L.
    gain : (k,) array
        σ_max(S).
    margins : ClassicalMargins
        The least.
    """

    notch: Notch
    stable: bool
    hz: Array
    open: np.ndarray
    gain: Array
    margins: ClassicalMargins

    @property
    def bandwidth_hz(self) -> float:
        """Where σ_max(S) first crosses -3 dB, between two frequencies; NaN where it does not."""
        above = np.flatnonzero(self.gain >= 2**-0.5)
        if not above.size or above[0] == 0:
            return np.nan
        i = slice(above[0] - 1, above[0] + 1)
        return float(np.exp(np.interp(-0.5 * np.log(2.0), *np.log((self.gain[i], self.hz[i])))))

    def words(self, S_max: float) -> str:
        """What the notch makes of the loop."""
        n, m, top = self.notch, self.margins, int(self.gain.argmax())
        said = f"notch at {number(n.hz, 4)} Hz, to {number(n.depth, 2)} of the gain: "
        if not self.stable:
            return f"{said}the loop is UNSTABLE"
        over = "" if self.gain[top] <= S_max else f", beyond S_max {S_max:g}"
        return (
            f"{said}stable for gain × {number(m.gain_down, 3)} to {number(m.gain_up, 3)}; phase "
            f"margin {number(m.phase_deg, 3)}°, delay margin {number(1e6 * m.delay, 3)} µs; ω_b = "
            f"{number(self.bandwidth_hz, 4)} Hz; |S| at most {number(float(self.gain[top]), 4)} at "
            f"{number(float(self.hz[top]), 4)} Hz{over}. Tried on the model, not certified."
        )

    def on(self, panels: dict[str, Panel]) -> dict[str, Panel]:
        """The panels of a design, with this loop dash-dotted."""
        loci = loci_of(self.open, np.inf).T
        drawn = {
            "S": [Curve(self.hz, self.gain)],
            "L": [Curve(self.hz, np.abs(row)) for row in loci],
            "phase": [Curve(self.hz, row) for row in phase_deg(loci.T).T],
            "nyquist": [Curve(row.real, row.imag) for row in loci_of(self.open).T],
        }
        return panels | {
            name: replace(panels[name], curves=(*panels[name].curves, *(
                replace(curve, label="with the notch" * (i == 0), colour=PURPLE, line="-.")
                for i, curve in enumerate(curves))))
            for name, curves in drawn.items()
        }  # fmt: skip


def notched(view: LoopView, notch: Notch, options: NotchOptions = NotchOptions()) -> Notched:
    """Judge a loop with a notch behind its controller.

    Parameters
    ----------
    view : LoopView
        The loop without it, on the page's frequencies.
    notch : Notch
    options : NotchOptions
        How far around it is looked.

    Returns
    -------
    Notched
    """
    loop = replace(view.loop, controller=notch.behind(view.loop.controller))
    reach = np.exp(options.beside * notch.damping * np.linspace(-1.0, 1.0, 41))
    hz = np.unique(np.concatenate([view.hz, notch.hz * reach]))
    hz = hz[(hz >= view.hz[0]) & (hz <= view.hz[-1])]
    G, K = loop.responses(HZ * hz)
    gain = sigma_max(loop.sensitivity(HZ * hz))
    return Notched(notch, loop.stable, hz, G @ K, gain, least_margins(loop.responses, HZ * hz))
