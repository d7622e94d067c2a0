"""Controllers of fixed structure in the explorer: designed behind it, judged while one drags.

A design takes seconds, the judge of a known controller on the corners of its plant set a part of
one: while one drags, the last controller is judged at the new θ, and it says so.
"""

from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.explorer.designs import How, Knobs, Look, Standing, elements_at, without_controller
from ccd_casadi.fixed_structure import SetCertificate
from ccd_casadi.inner_problem.objective import violated
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import structure_of, structured_of
from ccd_casadi.inner_problem.structured_robustness import certify_corners
from ccd_casadi.inner_problem.structured_search import prepared, with_range
from ccd_casadi.sampling.sample_keys import hashes_of, sample_key
from ccd_casadi.sampling.store import Sample
from ccd_casadi.sampling.units import structured_unit
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.terminal import Tell
from ccd_casadi.synthesis.synthesis import Certificate, DesignFigures, Outcome

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


def anchored(problem: CoDesignProblem, known: CoDesignProblem | None) -> CoDesignProblem:
    """The problem with the warm starts, plant set and channels of one that was designed before."""
    if known is None:
        return problem
    mine, theirs = structured_of(problem), structured_of(known)
    scenarios = theirs.scenarios if mine.uncertainty == theirs.uncertainty else ()
    taken = replace(
        mine, warm_starts=theirs.warm_starts, scenarios=scenarios, channels=theirs.channels,
        frequencies=theirs.frequencies, seed=theirs.seed,
    )  # fmt: skip
    return replace(problem, controller=taken, start=known.start)


def designed(task: tuple[CoDesignProblem, Knobs], tell: Tell) -> Designed:
    """The best certified controller at θ from the problem's warm starts, or from many starts."""
    problem, knobs = task
    if not structured_of(problem).warm_starts:
        problem = prepared(replace(problem, start=knobs.theta), tell=tell)[0]
    problem = with_range(problem)
    designs, inner = hashes_of(problem)
    own = sample_key(inner, knobs.theta)
    rows, payload = structured_unit(problem, designs, own, knobs.theta)
    kappa = np.array(payload["kappa"]) if payload["kappa"] else None
    return Designed(
        problem, knobs, kappa, payload["shortfall"], tuple(rows), (own, inner, knobs.theta, payload)
    )


def judged_look(problem: CoDesignProblem, knobs: Knobs, kappa: Array, how: How) -> Look:
    """A known controller at θ, judged on the model and the corners of its plant set."""
    began = perf_counter()
    controller = structure_of(problem).state_space(kappa)
    found = certify_corners(problem, knobs.theta, controller)
    elements = elements_at(problem, knobs.theta)
    broken = violated(problem, knobs.theta)
    standing, reason = _standing(found)
    if standing is Standing.KEPT and broken:
        standing, reason = Standing.MISSED, f"the constraint {broken[0]} on θ is not met"
    look = without_controller(problem, knobs, elements, how, reason)
    return replace(
        look, figures=_figures(found, look.figures), controller=controller, standing=standing,
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
