"""What is set by hand: what the sliders say of case and problem, and a notch that is tried.

The notch is judged on the model in the loop that is drawn, not designed.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView, phase_deg
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.controller_kinds import with_structure
from ccd_casadi.cases.controller_tables import LoopTable
from ccd_casadi.cases.tables import Case
from ccd_casadi.drawing.content import Curve, Panel
from ccd_casadi.drawing.svg import PURPLE
from ccd_casadi.inner_problem.problem import CoDesignProblem, refuse_ports
from ccd_casadi.lti.loop import tustin
from ccd_casadi.lti.state_space import StateSpace, sigma_max
from ccd_casadi.reporting.nyquist import loci_of
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ, number
from ccd_casadi.synthesis.closed_loop import ClassicalMargins, least_margins


@dataclass(frozen=True)
class Knobs:
    """θ in the case's order and units (SI), S_max, the weights' ranges in Hz, what may differ.

    `resonance_shift`: of [robust], a share. With `sampled` the loop runs at `rate_hz` with a delay
    of `delay_us` from measurement to force.
    """

    theta: tuple[float, ...]
    S_max: float
    omega_S_hz: tuple[float, float]
    omega_T_hz: tuple[float, float]
    structure: str = "h_infinity"
    resonance_shift: float = 0.0
    sampled: bool = False
    rate_hz: float = 10000.0  # where the case gives none
    delay_us: float = 0.0

    @property
    def structured(self) -> bool:
        """Whether the controller has a fixed structure, whose loop may be sampled."""
        return self.structure == "sections"


def knobs_of(case: Case) -> Knobs:
    """The sliders where a case puts them, θ at its start."""
    rate = case.loop.rate_hz
    return Knobs(
        theta=tuple(parameter.start for parameter in case.theta),
        S_max=case.inner.S_max,
        omega_S_hz=case.inner.omega_S_hz,
        omega_T_hz=case.inner.omega_T_hz,
        structure=case.controller.structure,
        resonance_shift=case.robust.resonance_shift,
        sampled=rate is not None,
        rate_hz=Knobs.rate_hz if rate is None else rate,
        delay_us=case.loop.delay_us,
    )


def case_at(case: Case, knobs: Knobs) -> Case:
    """The case with θ's start, S_max, ranges, uncertainty, loop and structure of the sliders.

    Hold and delay are in a case only with sections: there they take part in the design.
    """
    if knobs.structure != case.controller.structure:
        case = with_structure(case, knobs.structure)
    parameters = zip(case.theta, knobs.theta, strict=True)
    loop = LoopTable()
    if knobs.structured and knobs.sampled:
        loop = LoopTable(knobs.rate_hz, knobs.delay_us)
    return replace(
        case,
        theta=tuple(replace(parameter, start=value) for parameter, value in parameters),
        inner=replace(
            case.inner, S_max=knobs.S_max, omega_S_hz=knobs.omega_S_hz, omega_T_hz=knobs.omega_T_hz
        ),
        robust=replace(case.robust, resonance_shift=knobs.resonance_shift),
        loop=loop,
    )


class Problems:
    """The problem at each setting of the sliders, as `problem_of` makes it of `case_at`.

    What it looks at anew is kept for each structure and uncertainty: a plant of the user's own is
    diagnosed over its box there.
    """

    def __init__(self, case: Case) -> None:
        self.case = case
        self._made: dict[tuple[Any, ...], CoDesignProblem] = {}

    def at(self, knobs: Knobs) -> CoDesignProblem:
        """Raises UserError where the plant does not fit the structure."""
        loop = (knobs.sampled, knobs.rate_hz, knobs.delay_us)
        key = (knobs.structure, knobs.resonance_shift, *(loop if knobs.structured else ()))
        if key not in self._made:
            made = problem_of(case_at(self.case, knobs))
            refuse_ports(made, "explore")
            self._made[key] = made
        found = self._made[key]
        S, T = ((HZ * low, HZ * high) for low, high in (knobs.omega_S_hz, knobs.omega_T_hz))
        return replace(
            found,
            start=knobs.theta,
            weights=found.weights.at(S[0], T[0]),
            inner=replace(found.inner, S_max=knobs.S_max, omega_S=S, omega_T=T),
        )


@dataclass(frozen=True)
class NotchOptions:
    """Ranges of the notch's sliders."""

    deepest: float = 0.01  # least gain at its frequency
    none: float = 0.99  # gain from which on it is no notch
    damping: tuple[float, float, float] = (0.02, 0.3, 2.0)  # least, first, largest: half its width
    beside: float = 3.0  # how far its flanks are looked at, in widths


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
    """The loop that is drawn, with a notch: recomputed from controller and plant."""

    notch: Notch
    stable: bool  # by the poles of the closed loop, hold and delay exact
    hz: Array  # (k,) the page's frequencies, and those around the notch, Hz
    open: np.ndarray  # (k, p, p) L
    gain: Array  # (k,) σ_max(S)
    margins: ClassicalMargins  # the least

    @property
    def bandwidth_hz(self) -> float:
        """The frequency at which σ_max(S) first crosses -3 dB, between two frequencies; NaN where
        it does not."""
        above = np.flatnonzero(self.gain >= 2**-0.5)
        if not above.size or above[0] == 0:
            return np.nan
        i = slice(above[0] - 1, above[0] + 1)
        return float(np.exp(np.interp(-0.5 * np.log(2.0), *np.log((self.gain[i], self.hz[i])))))

    def words(self, S_max: float) -> str:
        """Describe the loop with the notch."""
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


def judge_notched(view: LoopView, notch: Notch, options: NotchOptions = NotchOptions()) -> Notched:
    """Judge a loop with a notch behind its controller; `view`: without it, on the page's
    frequencies.
    """
    loop = replace(view.loop, controller=notch.behind(view.loop.controller))
    reach = np.exp(options.beside * notch.damping * np.linspace(-1.0, 1.0, 41))
    hz = np.unique(np.concatenate([view.hz, notch.hz * reach]))
    hz = hz[(hz >= view.hz[0]) & (hz <= view.hz[-1])]
    G, K = loop.responses(HZ * hz)
    gain = sigma_max(loop.sensitivity(HZ * hz))
    return Notched(notch, loop.stable, hz, G @ K, gain, least_margins(loop.responses, HZ * hz))
