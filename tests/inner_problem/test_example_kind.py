"""How to add a kind of controller: a PID by a rule of thumb, co-designed as any other kind is.

Four classes: what the problem states, what is known of it at any θ, the outer problem over θ, and
the design that a run ends with; each with an entry in the table of its room. No other file changes.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from oracles.helpers import HZ, INNER, problem
from scipy import signal

from ccd_casadi.analysis.loop_view import Bounded
from ccd_casadi.codesign import outer as outer_room
from ccd_casadi.codesign.formulations import Direct
from ccd_casadi.codesign.nested import Nested
from ccd_casadi.codesign.outer import ThetaOuter
from ccd_casadi.codesign.outer_problem import FormulationResult, GlobalCheck
from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.codesign.result_entries import figures_dict
from ccd_casadi.codesign.run import OUTERS, solve
from ccd_casadi.codesign.verdict import Check, State, search_evidence
from ccd_casadi.codesign.verified import Verified
from ccd_casadi.inner_problem.controller_problem import ControllerProblem
from ccd_casadi.inner_problem.inner_kind import InnerKind
from ccd_casadi.inner_problem.kinds import KINDS
from ccd_casadi.inner_problem.objective import violations
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.sampling.unit_kinds import UNITS
from ccd_casadi.sampling.units import InnerUnits, Unit
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import DesignFigures
from ccd_casadi.synthesis.weights import Weights

STEP = 1e-5  # relative, of central differences


# 1. What the problem states: plain values.
@dataclass(frozen=True)
class RuleOfThumb(ControllerProblem):
    """A PID whose crossover is a share of the first flexible resonance."""

    share: float = 0.05

    def identity_with(self, weights: Weights, budget: object) -> dict[str, Any]:
        return {"rule_of_thumb": self.share}


def pid(plant: ScaledPlant, share: float) -> StateSpace:
    """K(s) = k (s + ω_c/10)(s + ω_c/3) / (s (s/(3 ω_c) + 1)²), |K G| = 1 at ω_c."""
    omega = share * float(plant.natural[plant.natural > 0.0].min())
    zeros, poles = [-omega / 10.0, -omega / 3.0], [0.0, -3.0 * omega, -3.0 * omega]
    G = plant.plant_si().response(np.array([omega]))[0]
    K = np.abs(signal.freqs_zpk(zeros, poles, 1.0, [omega])[1][0])
    return StateSpace(*signal.zpk2ss(zeros, poles, 1.0 / (K * abs(G[0, 0]))))


# 2. What is known of it at any θ.
class ByRule(InnerKind):
    slack = 1e-6
    as_designed = True

    def at(self, theta: Sequence[float]) -> tuple[StateSpace, DesignFigures]:
        """The controller and its figures on the model."""
        made = self.problem.controller
        assert isinstance(made, RuleOfThumb)
        plant, inner = scaled_plant(self.problem, theta), self.problem.inner
        K = pid(plant, made.share)
        weights = self.problem.weights
        return K, measure(plant, K, weights, omega_low=inner.omega_low)

    def value(self, theta: Sequence[float]) -> tuple[float, Array]:
        figures = self.at(theta)[1]
        if not (figures.certified and self.problem.inner.feasible(figures)):
            return np.nan, np.full(len(theta), np.nan)
        steps = STEP * np.diag(theta)
        ends = [[self.at(np.add(theta, s * h))[1].bandwidth for s in (-1, 1)] for h in steps]
        return figures.bandwidth, np.diff(ends).ravel() / (2.0 * np.diag(steps))

    def describe(self) -> tuple[str, str]:
        return "PID", "by a rule of thumb"

    def require_function(self) -> None:
        """It is one function of θ."""

    def gain_bounds(self, weights: Weights, gamma: float, bandwidth_hz: float) -> Bounded:
        raise AssertionError("no page is drawn here")


class RuleUnits(InnerUnits):
    """Its samples for the store."""

    def solve(
        self, problem: CoDesignProblem, problem_key: str, key: str, theta: tuple[float, ...],
        workers: object = None,
    ) -> Unit:  # fmt: skip
        value, slope = KINDS[RuleOfThumb](problem).value(theta)
        feasible = bool(np.isfinite(value))
        payload = {
            "bandwidth": value if feasible else None,
            "gradient": slope.tolist() if feasible else None,
            "kappa": [], "active": [], "shortfall": "" if feasible else "a bound is not kept",
            "violation": None, "syntheses": 1,
        }  # fmt: skip
        return [], payload


# 3. The design that a run ends with.
@dataclass(frozen=True, kw_only=True)
class VerifiedRule(Verified):
    design: DesignFigures
    made: StateSpace

    kkt_level = 1e-3

    @property
    def controller(self) -> StateSpace:
        return self.made

    @property
    def active(self) -> tuple[str, ...]:
        return self.kkt.active

    def figures(self) -> dict[str, Any]:
        return figures_dict(self.design)

    def evidence(self, predicted: float) -> dict[str, Any]:
        return {"surrogate_bandwidth_hz": predicted / HZ}

    def certified_line(self) -> Check:
        state = State.PASSED if self.feasible else State.FAILED
        return Check("certified", state, (Reason.JUDGED_ON_MODEL(),), {})

    def better(self) -> Finding:
        return Reason.QUOTED(words="a better rule of thumb is known")

    def search_findings(
        self, outcome: FormulationResult, global_check: GlobalCheck | None
    ) -> tuple[tuple[Finding, ...], Mapping[str, Any]]:
        return search_evidence(1, 1, global_check)


# 4. The outer problem.
class RuleOuter(ThetaOuter):
    kkt_level = VerifiedRule.kkt_level

    def verify(self, end: outer_room.PolishedDesign, rounds: int) -> VerifiedRule:
        theta = tuple(map(float, self.theta_of(end.x)))
        K, figures = ByRule(self.problem).at(theta)
        feasible = self.problem.inner.feasible(figures) and not violations(self.problem, theta)
        return VerifiedRule(
            problem=self.problem, theta=theta, value=end.value, objective=end.objective,
            hardware_cost=hardware_cost(plant_of(self.problem), theta), kkt=end.kkt,
            inner_gap=end.gap, feasible=feasible, survival=None, damping=None, made=K,
            design=figures,
        )  # fmt: skip


@pytest.fixture
def case() -> Iterator[CoDesignProblem]:
    """The two masses with this kind, which only these tests know."""
    tables: list[tuple[dict, Any]] = [(KINDS, ByRule), (UNITS, RuleUnits), (OUTERS, RuleOuter)]
    for table, entry in tables:
        table[RuleOfThumb] = entry
    yield problem(controller=RuleOfThumb(), inner=replace(INNER, S_max=2.5, S_low=0.3), w1=0.05)
    for table, _ in tables:
        del table[RuleOfThumb]


@pytest.mark.parametrize("formulation", [Nested(points=6), Direct(starts=2)])
def test_a_kind_of_ones_own_is_co_designed(case: CoDesignProblem, formulation: Any) -> None:
    """J is w1 f + w2 ω_b of its own controller, and no θ of a grid has less."""
    found = solve(case, formulation)
    assert found.result["status"] == "verified", found.result["reason"]
    assert found.verified is not None
    J, theta = found.result["objective"], found.verified.theta

    def objective(point: Sequence[float]) -> float:
        figures = ByRule(case).at(point)[1]
        cost = case.w1 * hardware_cost(plant_of(case), point)
        kept = figures.certified and case.inner.feasible(figures)
        return cost + case.w2 * figures.bandwidth if kept else np.inf

    assert pytest.approx(objective(theta), rel=1e-9) == J
    axes = [np.linspace(low, high, 7) for low, high in zip(case.lower, case.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    assert min(map(objective, grid)) >= J - 1e-6 * abs(J)
    assert sorted(found.result["theta"]) == ["m1", "m2"]
