"""The paper's own method: nested steepest descent on a swept inner problem, for each kind of
controller."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.cases.case import Case, load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.final_judgement import judge_survival
from ccd_casadi.codesign.outer_mixed import set_findings
from ccd_casadi.codesign.result_entries import figures_dict
from ccd_casadi.codesign.structured_entries import active_of, box_findings, design_dict
from ccd_casadi.codesign.survival import loops_of
from ccd_casadi.codesign.verdict import Check, survives
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.inner_problem.controller_problem import ControllerProblem, MixedSensitivityProblem
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.objective import final_design, hardware_at, objective
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant, true_design
from ccd_casadi.inner_problem.structured_bandwidth import require_bandwidth, structured_value
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.inner_problem.sweep import active_constraints, evaluate
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.synthesis import DesignFigures, sweep

STATUS = {True: "verified", False: "not_verified"}
AnyDesign = Any  # Sensitivities or SectionsDesign: what a baseline gives and takes back


class Gradient(StrEnum):
    """The derivative dω_b/dθ that the descent follows."""

    FIXED = "fixed"
    TOTAL = "total"


@dataclass(frozen=True)
class BaselineDesign:
    """The best design at a θ: ω_b (rad/s), what J counts, that one's slope, (ω_S, ω_T) or NaN."""

    design: AnyDesign
    bandwidth: float
    value: float
    slope: Array
    frequencies: tuple[float, float] = (np.nan, np.nan)


class Baseline(ABC):
    """One kind of controller, for a problem; `swept` over weights' frequencies."""

    gradients: tuple[Gradient, ...]
    swept: bool

    def __init__(self, problem: CoDesignProblem) -> None:
        self.problem = problem

    @abstractmethod
    def answer(
        self, theta: Array, gradient: Gradient, around: tuple[float, float] | None
    ) -> tuple[BaselineDesign | None, int]:
        """The best design at θ, near (ω_S, ω_T) where these are given, and the syntheses spent."""

    @abstractmethod
    def design_of(self, sample: InnerSample) -> AnyDesign:
        """The design of a sample of ω_b*(θ)."""

    @abstractmethod
    def figures(self, theta: tuple[float, ...], design: AnyDesign) -> dict[str, Any]:
        """A design under the contract's keys, with its status and what is active."""

    @abstractmethod
    def judge(
        self, theta: tuple[float, ...], design: AnyDesign, workers: Pool
    ) -> tuple[StateSpace, Check]:
        """Judge the design: its controller (SI), and the line of the verdict of a run on what that
        survives."""


class MixedBaseline(Baseline):
    """The paper's own: a sweep of (ω_S, ω_T)."""

    gradients = tuple(Gradient)
    swept = True

    def answer(
        self, theta: Array, gradient: Gradient, around: tuple[float, float] | None
    ) -> tuple[BaselineDesign | None, int]:
        design, spent = _sweep(self.problem, theta, around)
        if design is None:
            return None, spent
        figures = design.figures
        slope = design.fixed_controller if gradient is Gradient.FIXED else design.to_theta[0]
        omega, at = figures.bandwidth, (figures.omega_S, figures.omega_T)
        return BaselineDesign(design, omega, omega, np.asarray(slope, float), at), spent

    def design_of(self, sample: InnerSample) -> Sensitivities:
        return true_design(self.problem, sample.theta, sample.omega_S, sample.omega_T)

    def figures(self, theta: tuple[float, ...], design: AnyDesign) -> dict[str, Any]:
        found, inner = design.figures, self.problem.inner
        active = list(active_constraints(inner, found))
        return figures_dict(found) | {"status": STATUS[inner.feasible(found)], "active": active}

    def judge(
        self, theta: tuple[float, ...], design: AnyDesign, workers: Pool
    ) -> tuple[StateSpace, Check]:
        at = (design.figures.omega_S, design.figures.omega_T)
        K = final_design(self.problem, theta, at).controller
        found, robust = judge_survival(
            self.problem, loops_of(self.problem, theta, K), design.figures
        )
        own = {} if robust is None else set_findings(robust)
        return K, survives(found, S_max=self.problem.inner.S_max, **own)


class StructuredBaseline(Baseline):
    """Climbs from the warm starts; climbs and multi-start searches are what it spends."""

    gradients = (Gradient.TOTAL,)
    swept = False

    def answer(
        self, theta: Array, gradient: Gradient, around: tuple[float, float] | None
    ) -> tuple[BaselineDesign | None, int]:
        value = structured_value(self.problem, theta.tolist())
        if not value.feasible:
            return None, value.syntheses
        slope = np.array(value.gradient)
        return BaselineDesign(value.design, value.bandwidth, value.value, slope), value.syntheses

    def design_of(self, sample: InnerSample) -> SectionsDesign:
        return structured_value(self.problem, sample.theta).design

    def figures(self, theta: tuple[float, ...], design: AnyDesign) -> dict[str, Any]:
        entries = design_dict(self.problem, theta, design)
        return entries | {"status": STATUS[design.certified], "active": active_of(design)}

    def judge(
        self, theta: tuple[float, ...], design: AnyDesign, workers: Pool
    ) -> tuple[StateSpace, Check]:
        K, on_box = design.controller, DesignOnBox(self.problem, theta, design)
        worst = on_box.worst()[0]
        wide, checked, proof = on_box.judge(worst, workers)
        found = judge_survival(self.problem, loops_of(self.problem, theta, K), design)[0]
        drawn = None if proof.conclusive else on_box.fresh_yield(workers)[0]
        along = found is not None and found.within(*kind_of(self.problem).common_shifts())
        own = box_findings(wide, checked, proof, worst, drawn, along=along)
        return K, survives(found, S_max=self.problem.inner.S_max, **own)


def case_to_compare(path: Path, command: str) -> tuple[Case, CoDesignProblem]:
    """Read a case whose methods can be compared: it counts the bandwidth, and lists no values.

    Parameters
    ----------
    path : Path
    command : str
        Named in the message.

    Returns
    -------
    Case, CoDesignProblem

    Raises
    ------
    UserError
        It is another case.
    """
    case = load_case(path)
    problem = problem_of(case)
    require_bandwidth(problem, command)
    for name, _ in problem.listed:
        words = f"{command} needs a range; give fixed, as the case.toml of a finished solve does"
        raise UserError(f"{path}: theta.{name}.values: {words}")
    plant_of(problem)
    return case, problem


def baseline_of(problem: CoDesignProblem) -> Baseline:
    """Make the baseline's inner problem, by the kind of controller.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    Baseline
    """
    return BASELINES[type(problem.controller)](problem)


BASELINES: dict[type[ControllerProblem], type[Baseline]] = {
    MixedSensitivityProblem: MixedBaseline,
    StructuredProblem: StructuredBaseline,
}


def _sweep(
    problem: CoDesignProblem,
    theta: Array,
    around: tuple[float, float] | None,
    *,
    points: tuple[int, int] = (7, 7),
    factor: float = 1.25,
) -> tuple[Sensitivities | None, int]:
    """The best feasible design of a sweep, and the syntheses that it took.

    Around (ω_S, ω_T) the sweep has `points` from ω/factor to factor ω.
    """
    inner = problem.inner
    local = inner
    if around is not None:
        ranges = [
            (max(low, centre / factor), min(high, centre * factor))
            for (low, high), centre in zip((inner.omega_S, inner.omega_T), around, strict=True)
        ]
        local = replace(inner, omega_S=ranges[0], omega_T=ranges[1], sweep_points=points)
    plant = scaled_plant(problem, tuple(theta))
    rows = sweep(plant, problem.weights, *local.axes(), **inner.synthesis_options)
    feasible: list[DesignFigures] = [row for row in rows if inner.feasible(row)]
    if not feasible:
        if around is None:
            return None, len(rows)
        wide, used = _sweep(problem, theta, None)
        return wide, used + len(rows)
    best = max(feasible, key=lambda row: row.bandwidth)
    # The derivative at the swept optimum is no new synthesis: the paper has K at hand too.
    return evaluate(plant, problem.weights, inner, (best.omega_S, best.omega_T)), len(rows)


class Stop(StrEnum):
    """The reason why a descent ended."""

    SMALL_STEP = "no step improves J any more"
    STATIONARY = "the projected gradient vanishes"
    ITERATIONS = "it reached its limit of iterations"
    INFEASIBLE = "no design meets the bounds at the start"
    NO_GRADIENT = "the controller there is not optimal enough to have a gradient"


@dataclass(frozen=True)
class DescentIterate:
    """One accepted point: θ, swept optimum (rad/s), J, ∂J/∂θ in the unit box, α, cost so far.

    ω_S and ω_T are NaN where the controller is of fixed structure.
    """

    theta: tuple[float, ...]
    omega_S: float
    omega_T: float
    bandwidth: float
    objective: float
    gradient: tuple[float, ...]
    step: float
    syntheses: int


@dataclass(frozen=True)
class Descent:
    """A whole descent: its history, its last design, and why it ended."""

    gradient: Gradient
    start: tuple[float, ...]
    first_step: float
    iterates: tuple[DescentIterate, ...]
    design: AnyDesign | None
    stop: Stop
    syntheses: int
    seconds: float

    @property
    def objective(self) -> float:
        """J at the end; infinite where no feasible start was found."""
        return self.iterates[-1].objective if self.iterates else np.inf


def steepest_descent(
    problem: CoDesignProblem,
    start: Sequence[float],
    gradient: Gradient = Gradient.FIXED,
    first_step: float = 0.05,
    max_iterations: int = 100,
    smallest_step: float = 1e-3,
) -> Descent:
    """Descend from `start`; steps are shares of the box of θ. Sections have a total gradient."""
    lower, upper = np.array(problem.lower), np.array(problem.upper)
    width = upper - lower
    began, baseline, theta = perf_counter(), baseline_of(problem), np.array(start, float)
    step, history, stop = first_step, list[DescentIterate](), Stop.ITERATIONS
    answer, spent = baseline.answer(theta, gradient, None)
    for _ in range(max_iterations):
        if answer is None:
            stop = Stop.INFEASIBLE
            break
        g = hardware_at(problem, theta).cost_gradient + problem.w2 * answer.slope * width
        J = objective(problem, theta, answer.value)
        places, slope = tuple(theta.tolist()), tuple(g.tolist())
        history.append(
            DescentIterate(places, *answer.frequencies, answer.bandwidth, J, slope, step, spent)
        )
        if not np.isfinite(g).all():
            stop = Stop.NO_GRADIENT
            break
        blocked = ((theta <= lower) & (g > 0.0)) | ((theta >= upper) & (g < 0.0))
        direction = np.where(blocked, 0.0, -g)
        size = float(np.abs(direction).max())
        if size <= 1e-9 * max(float(np.abs(g).max()), 1e-300):
            stop = Stop.STATIONARY
            break
        while step >= smallest_step:
            trial = np.clip(theta + step * direction / size * width, lower, upper)
            found, used = baseline.answer(trial, gradient, answer.frequencies)
            spent += used
            if found is not None and objective(problem, trial, found.value) < J:
                theta, answer = trial, found
                break
            step *= 0.5
        else:
            stop = Stop.SMALL_STEP
            break
    design = None if answer is None else answer.design
    seconds = perf_counter() - began
    return Descent(gradient, tuple(start), first_step, tuple(history), design, stop, spent, seconds)


def run_entry(descent: Descent) -> dict[str, Any]:
    """Write how a descent began, and how it ended."""
    return {
        "gradient": descent.gradient.value,
        "start": descent.start,
        "first_step": descent.first_step,
        "stop": descent.stop.value,
        "iterations": len(descent.iterates),
    }
