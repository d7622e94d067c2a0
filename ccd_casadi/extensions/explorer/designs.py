"""The designs that the explorer shows.

A controller of fixed structure takes seconds to design, the judge of a known one on the corners of
its plant set a part of one: while one drags, the last controller is judged at the new θ, and it
says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.codesign.verdict import VerdictOptions
from ccd_casadi.extensions.explorer.knobs import Knobs
from ccd_casadi.fixed_structure.certificate import SetCertificate
from ccd_casadi.inner_problem.objective import violations
from ccd_casadi.inner_problem.problem import (
    CoDesignProblem,
    best_choice,
    design_choices,
    free_modal,
    plant_of,
    scaled_system,
)
from ccd_casadi.inner_problem.searched_problem import state_of, with_state
from ccd_casadi.inner_problem.structured_plant_set import structure_of
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.inner_problem.structured_robustness import certify_corners
from ccd_casadi.inner_problem.structured_search import prepare_search, with_range
from ccd_casadi.inner_problem.sweep import InnerResult, active_constraints, missed_bounds
from ccd_casadi.kernels.certified_design import failed_row
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import ModalPlant
from ccd_casadi.plants.plant import Mechanics, hardware_cost, mechanics
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.sampling.store import Sample
from ccd_casadi.sampling.unit_kinds import units_of
from ccd_casadi.sampling.units import hashes_of, sample_key
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.terminal import Log
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import recertified_in_si
from ccd_casadi.synthesis.synthesis import (
    Certificate,
    DesignFigures,
    Outcome,
    figures_from_row,
    synthesise,
)
from ccd_casadi.synthesis.weights import Weights


class How(StrEnum):
    """The way in which the controller was chosen."""

    PRESENT = "one synthesis at the present weights"
    SEARCHED = "full inner search: the largest bandwidth at this θ"
    STRUCTURED = "fixed structure, designed at this θ"
    HELD = "fixed structure, the controller designed last, judged at this θ"


class Standing(StrEnum):
    """The standing of a design, from the best to the worst."""

    KEPT = "certified, keeps its bounds"
    MISSED = "certified, misses a bound"
    NEAR = "not certified yet: the plant is approximated"
    REFUSED = "not certified"


@dataclass(frozen=True)
class Elements:
    """The plant's matrices at θ, what they are, and their stated `error`, of a frequency, relative.

    The model's own have none.
    """

    system: Mechanics
    error: float = 0.0
    words: str = "exact"

    @property
    def exact(self) -> bool:
        """Whether they are the model's own."""
        return self.error == 0.0


# Stated error of the frequencies up to which matrices pass for the model's own: what every verdict
# asks a loop to survive.
OWN = VerdictOptions().least_shift


@dataclass(frozen=True)
class ExploredDesign:
    """A design that was looked at: where, on which plant, what it is worth.

    `figures` (rad/s) are NaN past the point where a synthesis failed; `reason` says in words why
    a design is not KEPT. `standing` is the worst of all that was judged: the synthesis, how far the
    plant is the model's own, and the sampled loop where one is asked for. `controller` in SI, None
    where a synthesis ended before there was one. `problem` has its design plant chosen, `weights`
    the frequencies that were used. `kappa`: of a fixed structure.
    """

    knobs: Knobs
    problem: CoDesignProblem
    elements: Elements
    modal: ModalPlant
    plant: ScaledPlant
    weights: Weights
    figures: DesignFigures
    controller: StateSpace | None
    how: How
    standing: Standing
    reason: str
    cost: float
    active: tuple[str, ...]
    seconds: float
    result: InnerResult | None = None
    kappa: Array | None = None

    @property
    def theta(self) -> tuple[float, ...]:
        """The θ of the sliders."""
        return self.knobs.theta

    @property
    def bandwidth_hz(self) -> float:
        """ω_b of the certified loop; NaN where there is none."""
        return self.figures.bandwidth / HZ if self.standing is not Standing.REFUSED else np.nan

    @property
    def objective(self) -> float:
        """J = w1 f(θ) + w2 ω_b; NaN where ω_b is that of another θ's plant."""
        if self.standing is Standing.NEAR:
            return np.nan
        return self.problem.w1 * self.cost + self.problem.w2 * HZ * self.bandwidth_hz


def elements_at(problem: CoDesignProblem, theta: Sequence[float]) -> Elements:
    """The model's own matrices at θ; without derivatives where these cost extra.

    Raises PlantError where the model is no plant there.
    """
    plant = plant_of(problem)
    return Elements(mechanics(plant, theta) if plant.values is None else plant.values(theta))


def present(
    problem: CoDesignProblem, knobs: Knobs, elements: Elements, point: tuple[float, float]
) -> ExploredDesign:
    """One certified synthesis at θ and `point` = (ω_S, ω_T) in rad/s, clipped to the ranges."""
    began = perf_counter()
    inner = problem.inner
    point = (float(np.clip(point[0], *inner.omega_S)), float(np.clip(point[1], *inner.omega_T)))
    choices = design_choices(problem)
    drawn_designs = [
        _design(choice, knobs, elements, point, How.PRESENT, began) for choice in choices
    ]
    return min(
        drawn_designs,
        key=lambda design: float(np.nan_to_num(design.figures.sensitivity_peak, nan=np.inf)),
    )


def search_inner(problem: CoDesignProblem, knobs: Knobs, elements: Elements) -> ExploredDesign:
    """The inner problem at θ, as the command `inner` solves it, and the controller there.

    Where no design is feasible: the one nearest to it, if any was certified.
    """
    began = perf_counter()
    choice, found = best_choice(problem, knobs.theta, elements.system)
    if found.optimum is not None:
        figures = found.optimum.figures
        point = (figures.omega_S, figures.omega_T)
        design = _design(choice, knobs, elements, point, How.SEARCHED, began)
        return replace(design, result=found)
    certified = [row for row in found.rows if row.certified]
    row = min(certified or found.rows, key=choice.inner.excess)
    design = _design(choice, knobs, elements, (row.omega_S, row.omega_T), How.SEARCHED, began)
    standing = Standing.MISSED if design.standing is Standing.KEPT else design.standing
    return replace(design, standing=standing, reason=found.shortfall, result=found)


def _design(
    problem: CoDesignProblem,
    knobs: Knobs,
    elements: Elements,
    point: tuple[float, float],
    how: How,
    began: float,
) -> ExploredDesign:
    design = without_controller(problem, knobs, elements, how)
    weights, inner, plant = problem.weights.at(*point), problem.inner, design.plant
    made = synthesise(plant, weights, omega_low=inner.omega_low, gamma_backoff=inner.gamma_backoff)
    made = recertified_in_si(plant, made, inner.omega_low)
    standing, reason = judge_figures(problem, made.figures, violations(problem, knobs.theta))
    if elements.error > OWN and standing is not Standing.REFUSED:
        standing, reason = Standing.NEAR, ""
    finite = all(np.isfinite(getattr(made.controller, part)).all() for part in "ABCD")
    return replace(
        design, weights=weights, figures=made.figures,
        controller=made.controller if finite and made.controller.A.size else None,
        standing=standing, reason=reason,
        active=active_constraints(inner, made.figures) if standing is Standing.KEPT else (),
        seconds=perf_counter() - began,
    )  # fmt: skip


def without_controller(
    problem: CoDesignProblem, knobs: Knobs, elements: Elements, how: How, words: str = ""
) -> ExploredDesign:
    """A place without a controller, and why."""
    return ExploredDesign(
        knobs=knobs,
        problem=problem,
        elements=elements,
        modal=free_modal(problem, elements.system),
        plant=scaled_system(problem, elements.system),
        weights=problem.weights,
        figures=figures_from_row(failed_row(), problem.weights.at(0.0, 0.0), 1.0),
        controller=None,
        how=how,
        standing=Standing.REFUSED,
        reason=words,
        cost=hardware_cost(plant_of(problem), knobs.theta),
        active=(),
        seconds=0.0,
    )


def judge_figures(
    problem: CoDesignProblem, figures: DesignFigures, broken: Sequence[str] = ()
) -> tuple[Standing, str]:
    """Judge a design by its figures, with the reason; `broken`: constraints on θ."""
    if not figures.certified:
        return Standing.REFUSED, figures.outcome.value
    missed = missed_bounds(problem.inner, figures)
    missed += [f"the constraint {name} on θ is not met" for name in broken]
    return (Standing.MISSED, "; ".join(missed)) if missed else (Standing.KEPT, "")


Unit = tuple[str, str, tuple[float, ...], dict[str, Any]]


@dataclass(frozen=True)
class Designed:
    """A controller at a θ: κ in SI (None: none was found), the problem with its warm starts and
    set.

    `rows` and `unit` go into the store under the hash of that problem.
    """

    problem: CoDesignProblem
    knobs: Knobs
    kappa: Array | None
    words: str
    rows: tuple[Sample, ...]
    unit: Unit


def with_warm_starts_of(problem: CoDesignProblem, known: CoDesignProblem | None) -> CoDesignProblem:
    """The problem with the warm starts, plant set and channels of one that was designed before."""
    if known is None:
        return problem
    mine, theirs, state = structured_of(problem), structured_of(known), state_of(known)
    if mine.uncertainty != theirs.uncertainty:
        state = replace(state, scenarios=())
    taken = replace(mine, channels=theirs.channels, frequencies=theirs.frequencies)
    return with_state(replace(problem, controller=taken, start=known.start), **vars(state))


def design_controller(task: tuple[CoDesignProblem, Knobs], log: Log) -> Designed:
    """The best certified controller at θ from the problem's warm starts, or from many starts."""
    problem, knobs = task
    if not state_of(problem).warm_starts:
        problem = prepare_search(replace(problem, start=knobs.theta), log=log)[0]
    problem = with_range(problem)
    designs, inner = hashes_of(problem)
    own = sample_key(inner, knobs.theta)
    rows, payload = units_of(problem).solve(problem, designs, own, knobs.theta)
    kappa = np.array(payload["kappa"]) if payload["kappa"] else None
    return Designed(
        problem, knobs, kappa, payload["shortfall"], tuple(rows), (own, inner, knobs.theta, payload)
    )


def judge_design(problem: CoDesignProblem, knobs: Knobs, kappa: Array, how: How) -> ExploredDesign:
    """A known controller at θ, judged on the model and the corners of its plant set."""
    began = perf_counter()
    controller = structure_of(problem).state_space(kappa)
    found = certify_corners(problem, knobs.theta, controller)
    elements = elements_at(problem, knobs.theta)
    broken = violations(problem, knobs.theta)
    standing, reason = _standing(found)
    if standing is Standing.KEPT and broken:
        standing, reason = Standing.MISSED, f"the constraint {broken[0]} on θ is not met"
    design = without_controller(problem, knobs, elements, how, reason)
    return replace(
        design, figures=_figures(found, design.figures), controller=controller, standing=standing,
        kappa=kappa, seconds=perf_counter() - began,
    )  # fmt: skip


def _standing(found: SetCertificate) -> tuple[Standing, str]:
    if found.passed:
        return Standing.KEPT, ""
    stable = all(plant.stable for plant in found.plants)
    return Standing.MISSED if stable and found.bandwidth > 0.0 else Standing.REFUSED, found.words


def _figures(found: SetCertificate, none: DesignFigures) -> DesignFigures:
    """The worst of the set; ω_S and ω_T are 0, and the norm is the largest share of a bound."""
    stable = all(plant.stable for plant in found.plants)
    highest = max(found.plants, key=lambda plant: float(np.nan_to_num(plant.S_peak, nan=np.inf)))
    worst = max(found.worst.values(), default=float("nan"))
    pole = max(plant.stability for plant in found.plants)
    return replace(
        none,
        outcome=Outcome.CERTIFIED if found.passed else Outcome.NOT_ROBUST,
        gamma=worst,
        bandwidth=found.bandwidth,
        sensitivity_peak=highest.S_peak,
        sensitivity_peak_frequency=highest.S_peak_frequency,
        sensitivity_low=max(plant.S_low for plant in found.plants),
        certificate=Certificate(stable, pole, worst, 1.0, found.passed),
    )
