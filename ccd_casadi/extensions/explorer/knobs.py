"""What the sliders say of case and problem."""

from dataclasses import dataclass, replace
from typing import Any

from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.controller_kinds import with_structure
from ccd_casadi.cases.controller_tables import LoopTable
from ccd_casadi.cases.tables import Case
from ccd_casadi.inner_problem.problem import CoDesignProblem, refuse_ports
from ccd_casadi.support.text import HZ


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
