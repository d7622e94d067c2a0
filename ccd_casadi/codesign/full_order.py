"""What mixed sensitivity of full order reaches where a fixed structure was designed.

Three questions at the same θ, with the same S_max and S_low: what does the structure cost (the full
order beside it, on the model and on the set), what does robustness cost (each of them on the model
alone), what do hold and delay. And a bound that no controller escapes: with the paper's weights

    ‖[W_S S; W_KS KS; W_T T]‖∞ >= γ_opt   for every stabilising K, of whatever structure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure import Bounds, SectionsDesign, certify
from ccd_casadi.inner_problem.controller_problem import MixedSensitivityProblem, RobustSet
from ccd_casadi.inner_problem.problem import (
    CoDesignProblem,
    design_choices,
    scaled_plant,
    true_inner,
)
from ccd_casadi.inner_problem.sections_bandwidth import sections_value
from ccd_casadi.inner_problem.sections_plant_set import (
    bounds_of,
    plants_of,
    sections_of_problem,
    uncertain_plant,
)
from ccd_casadi.inner_problem.sections_problem import SectionsProblem
from ccd_casadi.inner_problem.sections_search import joined
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import UNBOUNDED, synthesise
from ccd_casadi.synthesis.weights import Weights

SHIFTS = 5  # plants over the resonance shift of a robust synthesis, as a case has them by default


@dataclass(frozen=True)
class FullOrder:
    """The fastest mixed-sensitivity design at θ, rad/s (NaN: none found; `words` by which search).

    On the set that the sections hold on the judge finds it unstable on `unstable` of `plants`
    plants, where it is not with `over`, the worst figure over each bound of the sections.
    """

    bandwidth: float
    order: int
    words: str
    plants: int
    unstable: int
    over: dict[str, float]


@dataclass(frozen=True)
class Beside:
    """Full order beside sections at one θ; bandwidths in rad/s, NaN where none was found.

    `on_model` is designed on the model, `on_set` for stability and S_max on the set (None where
    there is no set but the model). `sections_on_model` and `sections_continuous` are the ends of
    climbs from the design, on the model alone and on the set without hold and delay. `stacked_norm`
    is the design's, with the weights of `on_model`, whose `gamma_opt` is the least of any
    controller's; both of the continuous loop on the model, NaN where that is not stable.
    """

    on_model: FullOrder
    on_set: FullOrder | None
    sections_on_model: float
    sections_continuous: float
    stacked_norm: float
    gamma_opt: float


def full_order_beside(
    problem: CoDesignProblem, theta: Sequence[float], made: SectionsDesign
) -> Beside:
    """What mixed sensitivity reaches at θ beside a certified design of fixed structure."""
    sections, kappa = sections_of_problem(problem), made.kappa
    plain = replace(problem, controller=MixedSensitivityProblem(), robust=None)
    plants, bounds = plants_of(problem, theta), bounds_of(problem)
    on_model, weights, gamma_opt = _fastest([plain], theta, plants, bounds)
    norm = float("nan")
    if weights is not None and made.controller is not None:
        norm = stacked_norm(scaled_plant(plain, theta), made.controller, weights)
    robust = _robust_set(sections)
    on_set = None
    if robust is not None:
        choices = design_choices(replace(plain, robust=robust))
        on_set = _fastest(choices, theta, plants, bounds)[0]
    elif len(plants) > 1:
        words = "none: mixed sensitivity here knows resonance shifts and damping only"
        on_set = FullOrder(np.nan, 0, words, len(plants), 0, {})
    model = tuple(map(float, uncertain_plant(problem, theta).nominal))
    alone = replace(sections, members=((0, model),))
    still = replace(sections, sampling=None)
    return Beside(
        on_model=on_model,
        on_set=on_set,
        sections_on_model=_climbed(problem, alone, kappa, theta),
        sections_continuous=_climbed(problem, still, kappa, theta),
        stacked_norm=norm,
        gamma_opt=gamma_opt,
    )


def stacked_norm(plant: ScaledPlant, controller: StateSpace, weights: Weights) -> float:
    """‖[W_S S; W_KS KS; W_T T]‖∞ of a continuous loop; NaN where it is not stable."""
    found = measure(plant, controller, weights, gamma=UNBOUNDED, omega_low=weights.omega_T)
    return found.certificate.norm if found.certificate.stable else float("nan")


def _robust_set(sections: SectionsProblem) -> RobustSet | None:
    """Shifts and damping of the box, as mixed sensitivity takes them; None: there are none."""
    u = sections.uncertainty
    damping = tuple(factor for factor in u.damping if factor != 1.0)
    if u.resonance_shift == 0.0 and not damping:
        return None
    shifts = SHIFTS if u.resonance_shift else 1
    return RobustSet(u.resonance_shift, shifts, damping, None if u.resonance_shift else 0.0)


def _fastest(
    problems: Sequence[CoDesignProblem],
    theta: Sequence[float],
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
) -> tuple[FullOrder, Weights | None, float]:
    """The fastest design of these problems, its weights and its γ_opt."""
    answers = [(problem, true_inner(problem, theta)) for problem in problems]
    solved = [(p, a.optimum.figures) for p, a in answers if a.optimum is not None]
    tried = sum(answer.syntheses for _, answer in answers)
    search = f"a search of {tried} syntheses over the weights' frequencies"
    if len(problems) > 1:
        search += f", on {len(problems)} design plants"
    if not solved:
        words = f"none found by {search}: {answers[0][1].shortfall}"
        return FullOrder(np.nan, 0, words, len(plants), 0, {}), None, float("nan")
    problem, figures = max(solved, key=lambda item: item[1].bandwidth)
    inner, weights = problem.inner, problem.weights.at(figures.omega_S, figures.omega_T)
    design = synthesise(
        scaled_plant(problem, theta), weights, omega_low=inner.omega_low,
        gamma_backoff=inner.gamma_backoff,
    )  # fmt: skip
    judged = certify(plants, design.controller, bounds, None, integrator=False)
    stable = [plant for plant in judged.plants if plant.stable]
    over: dict[str, float] = {}
    for plant in stable:
        for name, ratio in (bounds.shares(plant) | bounds.channel_shares(plant.channels)).items():
            over[name] = max(over.get(name, 0.0), ratio)
    found = FullOrder(
        figures.bandwidth, len(design.controller.A), f"by {search}", len(plants),
        len(plants) - len(stable), over,
    )  # fmt: skip
    return found, weights, figures.gamma_opt


def _climbed(
    problem: CoDesignProblem, sections: SectionsProblem, kappa: Array, theta: Sequence[float]
) -> float:
    """ω_b in rad/s where the climbs from the design and the anchors end on another set or loop."""
    sections = replace(sections, minimise="bandwidth")
    asked = joined(replace(problem, controller=sections), kappa, ())
    value = sections_value(asked, theta)
    return value.bandwidth if value.feasible else float("nan")
