"""The sequential baseline, and what co-design gains over it, from a few true designs."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from time import perf_counter, process_time
from typing import Any

import casadi as ca
import numpy as np
from scipy.special import ndtr

from ccd_casadi.cases.case import Case
from ccd_casadi.codesign.nested import fit_bandwidth
from ccd_casadi.codesign.outer_problem import (
    NonlinearProgram,
    OuterFailure,
    outer_program,
    solve_program,
)
from ccd_casadi.codesign.run import outer_of
from ccd_casadi.codesign.stored_searches import multistart_at, value_with_design
from ccd_casadi.codesign.verdict import State
from ccd_casadi.codesign.working_set import with_scenarios
from ccd_casadi.inner_problem.objective import (
    ConstraintOptions,
    constraint_sizes,
    objective,
    objective_of,
    violated,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.plants.plant import Evaluate, hardware_cost, mechanics
from ccd_casadi.reporting.facts import cost_words, theta_words
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.studies.steepest_descent import baseline_of
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.text import HZ, number
from surrogates import design, to_casadi


@dataclass(frozen=True)
class HardwareOptions:
    """Numbers of the sequential hardware design on cheap models of the plant.

    Attributes
    ----------
    rounds : int
        Solves at most, each on a model that is made of the θ known so far.
    agreed : float
        Relative difference of ω_1 between model and plant that ends them.
    known : int
        θ that a model is made of.
    """

    rounds: int = 8
    agreed: float = 1e-6
    known: int = 3


@dataclass(frozen=True)
class HardwareDesign:
    """The hardware that the rule of thumb gives; resonance in rad/s; `met` False: none meets it."""

    theta: tuple[float, ...]
    hardware_cost: float
    first_resonance: float
    met: bool


def first_resonance(
    problem: CoDesignProblem, theta: Array, evaluate: Evaluate | None = None
) -> tuple[float, Array]:
    """ω_1 of the first flexible mode, rad/s, and its gradient to θ; NaN where all is rigid."""
    system = (evaluate or partial(mechanics, plant_of(problem)))(tuple(theta))
    modal = modal_plant(system, problem.suspension.free)
    flexible = np.flatnonzero(~modal.rigid)
    if flexible.size == 0:
        return np.nan, np.full(len(theta), np.nan)
    i = int(flexible[0])
    omega = float(modal.natural[i])
    slope = modal.dK[:, i, i] - omega**2 * modal.dM[:, i, i]
    return omega, slope / (2.0 * omega)


def design_hardware(
    problem: CoDesignProblem,
    resonance: float,
    *,
    starts: int = 8,
    seed: int = 0,
    workers: Pool | None = None,
    options: HardwareOptions = HardwareOptions(),
) -> HardwareDesign:
    """The least hardware cost with ω_1 >= `resonance` (rad/s), by IPOPT.

    From the case's start and `starts` more: with none, the local solution next to the start,
    which need not be the least one (for the two masses it is the paper's equal-mass design).
    """
    points = [problem.start]
    if starts > 0:
        points += map(tuple, design("sobol", *box(problem), starts, seed).tolist())
    tasks = {start: (problem, resonance, start, options) for start in points}
    found = [design for _, design in sorted(results(workers, _from_start, tasks))]
    nearest = max(found, key=lambda item: item.first_resonance)
    meeting = (item for item in found if item.met)
    return min(meeting, key=lambda item: item.hardware_cost, default=nearest)


def _from_start(
    problem: CoDesignProblem, resonance: float, start: tuple[float, ...], options: HardwareOptions
) -> HardwareDesign:
    plant = plant_of(problem)
    known: tuple[tuple[float, ...], ...] = (start,)
    for _ in range(options.rounds):
        evaluate = None if plant.nearby is None else plant.nearby(known)
        point, predicted = _least_cost(problem, resonance, known[-1], evaluate)
        omega = predicted if evaluate is None else first_resonance(problem, point)[0]
        theta = tuple(float(v) for v in point)
        if abs(predicted / omega - 1.0) <= options.agreed or np.isnan(omega):
            break
        known = (*known[1 - options.known :], theta)
    met = bool(omega >= resonance * (1.0 - options.agreed)) and not violated(problem, point)
    return HardwareDesign(theta, hardware_cost(plant, point), omega, met)


def _least_cost(
    problem: CoDesignProblem, resonance: float, start: tuple[float, ...], evaluate: Evaluate | None
) -> tuple[Array, float]:
    """θ of the least cost near a start, and ω_1 there, by one way to evaluate the plant."""
    plant = plant_of(problem)
    theta = ca.MX.sym("theta", len(start))
    cost, lam = plant.hardware(theta)
    at = lru_cache(maxsize=None)(lambda point: first_resonance(problem, np.array(point), evaluate))
    callback = VectorCallback(
        "first_resonance", len(start), 1,
        lambda x: np.array([np.log(at(tuple(x))[0] / resonance)]),
        lambda x: at(tuple(x))[1][None] / at(tuple(x))[0],
    )  # fmt: skip
    program = NonlinearProgram(
        x=theta,
        f=cost / (abs(hardware_cost(plant, start)) or 1.0),
        g=ca.vertcat(-callback(theta), lam / ca.DM(constraint_sizes(problem))),
        box=box(problem),
        exact_hessian=False,
    )
    try:
        point = solve_program(program, np.array([start])).best.x
    except OuterFailure:
        point = np.array(start)
    return point, at(tuple(point))[0]


@dataclass(frozen=True)
class WorthOptions:
    """Numbers of the estimate of what co-design gains.

    Attributes
    ----------
    slow : float
        Processor time in s of a plant at a θ from which it is slow (finite elements).
    points, points_slow : int
        True inner problems over the box for each parameter; of a slow plant.
    same_start : float
        Share of the box within which the start of a slow plant is left out, as it is near the
        sequential hardware.
    rounds : int
        Rounds of surrogate, IPOPT and truth at most.
    settled, settled_slow : float
        δ as a share of the bandwidth below which no further round is needed; of a slow plant.
    same_design : float
        Share of the box within which two designs are one.
    cloud : int
        Points in each box around the best θ.
    boxes : tuple of float
        Sizes of these boxes, as shares of the box of θ.
    hardly : float
        Gain in % of the bandwidth below which co-design is hardly worth it.
    """

    slow: float = 0.3
    points: int = 8
    points_slow: int = 1
    same_start: float = 0.05
    rounds: int = 12
    settled: float = 1e-4
    settled_slow: float = 1.5e-3
    same_design: float = 1e-3
    cloud: int = 256
    boxes: tuple[float, ...] = (1.0, 0.3, 0.1, 0.03)
    hardly: float = 1.0


@dataclass(frozen=True)
class Outlook:
    """The best design so far, and what the surrogate expects beyond it.

    `left`: δ as bandwidth at equal hardware cost; `theta`: the next true design, the surrogate's
    optimum with its bandwidth `predicted`, or that of the largest EI (NaN); `costs`, `values`: the
    least and the largest f and v of designs within δ of the best. Bandwidths are in rad/s.
    """

    best: InnerSample
    left: float
    theta: Array
    predicted: float
    costs: Array
    values: Array


def worth(
    case: Case, sampler: Sampler, seed: int = 0, *, options: WorthOptions = WorthOptions()
) -> dict[str, Any]:
    """Estimate what co-design gains over the sequential design.

    The sequential design is followed by rounds of surrogate and truth, until the next one is
    expected to gain little. No clock ends them.

    Parameters
    ----------
    case : Case
    sampler : Sampler
        Of its problem.
    seed : int
    options : WorthOptions

    Returns
    -------
    dict
        The content of worth.json.

    Raises
    ------
    UserError
        Too few designs are certified to learn from, or none is feasible.
    """
    began, rule = perf_counter(), HZ * case.baseline.first_resonance_hz
    lower, upper = box(sampler.problem)
    looks = design("sobol", lower, upper, options.points * len(lower), seed)
    spent = process_time()
    first_resonance(sampler.problem, looks[0])  # the plant keeps it for the global check
    slow = process_time() - spent > options.slow
    hardware = design_hardware(
        sampler.problem, rule, starts=0 if slow else 8, seed=seed, workers=sampler.workers
    )
    outer = outer_of(sampler).prepared(seed)
    sampler, problem = outer.sampler, outer.problem
    apart = np.abs(np.subtract(hardware.theta, problem.start) / (upper - lower)).max()
    first = (
        [hardware.theta] if slow and apart < options.same_start else [hardware.theta, problem.start]
    )
    known = sampler.values(np.array(first), "first designs")
    few = looks[: options.points_slow * len(lower)]
    known += sampler.values(few if slow else looks, "global check")
    missed, searched = 0.0, set[tuple[float, ...]]()
    for rounds_left in reversed(range(options.rounds + 1)):
        known = sampler.latest(known)
        ahead = outlook(problem, known, missed, seed, options=options)
        share = options.settled_slow if slow else options.settled
        settled = ahead.left <= share * ahead.best.bandwidth
        if settled or not rounds_left:
            ends = {end.theta: end for end in (known[0], ahead.best) if end.kappa}
            found = {at: multistart_at(sampler, ends[at]) for at in ends if at not in searched}
            better = [at for at in found if found[at].feasible and found[at].value > ends[at].value]
            for at in better:
                sampler.value_from(at, found[at].design.kappa.tolist())
            if not (better and rounds_left):
                if unsure := search_error(sampler, ahead.best):
                    ahead = outlook(problem, known, missed + unsure, seed, options=options)
                break
            missed, searched = 0.0, searched | ends.keys()
            continue
        known += sampler.values(ahead.theta, "the best expected")
        missed = float(np.fmax(0.0, abs(known[-1].value - ahead.predicted)))
    if not np.isfinite(objective_of(problem, ahead.best)):
        raise UserError(f"no feasible design was found: {known[0].shortfall}")
    entries: list[dict[str, Any]] = [
        {
            "theta": dict(zip(problem.names, sample.theta, strict=True)),
            "units": dict(zip(problem.names, problem.units, strict=True)),
            "hardware_cost": hardware_cost(plant_of(problem), sample.theta),
            "cost_unit": problem.cost_unit,
            "bandwidth_hz": sample.bandwidth / HZ,
        }
        for sample in (known[0], ahead.best)
    ]
    baseline = baseline_of(sampler.problem)
    for entry, sample in zip(entries, (known[0], ahead.best), strict=True):
        if sample.feasible:
            own = baseline.design_of(sample)
            entry["survives"] = baseline.judged(sample.theta, own, sampler.workers)[1].entry
    old, bandwidth = entries[0]["hardware_cost"], known[0].bandwidth
    gain = objective(problem, known[0].theta, bandwidth) - objective_of(problem, ahead.best)
    return {
        "sequential": entries[0],
        "co_design": entries[1],
        "hardware_cost_percent": 100.0 * (entries[1]["hardware_cost"] / old - 1.0),
        "bandwidth_percent": 100.0 * (ahead.best.bandwidth / bandwidth - 1.0),
        "gain_percent": 100.0 * gain / abs(problem.w2) / bandwidth,  # at equal hardware cost
        "uncertainty_percent": 100.0 * ahead.left / bandwidth,
        "full_solve_hardware_cost_percent": (100.0 * (ahead.costs / old - 1.0)).tolist(),
        "full_solve_bandwidth_percent": (100.0 * (ahead.values / bandwidth - 1.0)).tolist(),
        "first_resonance_hz": hardware.first_resonance / HZ,
        "resonance_met": hardware.met,
        "settled": settled,
        "syntheses": sampler.syntheses,
        "seconds": perf_counter() - began,
    }


def outlook(
    problem: CoDesignProblem,
    known: list[InnerSample],
    missed: float,
    seed: int,
    *,
    options: WorthOptions = WorthOptions(),
) -> Outlook:
    """By the surrogate of all that is known, which `missed` the last true design (rad/s)."""
    learnt = [each for each in known if each.feasible]
    if len(learnt) <= len(problem.names):
        raise UserError(f"only {len(learnt)} of {len(known)} designs certified; widen the bounds")
    best = min(known, key=lambda sample: objective_of(problem, sample))
    process = fit_bandwidth(problem, learnt, seed, gradients=True)
    lower, upper = box(problem)
    program = outer_program(problem, to_casadi(process, std=False))
    starts = np.vstack([best.theta, design("sobol", lower, upper, 8, seed)])
    try:
        expected = solve_program(program, starts).best.x
    except OuterFailure:  # the surrogate expects a feasible design nowhere
        expected = np.array(best.theta)
    spread = design("sobol", lower - upper, upper - lower, options.cloud, seed)
    cloud = best.theta + np.vstack([reach * spread for reach in options.boxes])
    cloud = np.clip(np.vstack([expected, best.theta, cloud]), lower, upper)
    costs, constraints = (np.array(value) for value in plant_of(problem).hardware(cloud.T))
    met = ConstraintOptions.met * constraint_sizes(problem)[:, None]
    allowed = (constraints <= met).all(axis=0)
    steps = (cloud[:, None] - [each.theta for each in known]) / (upper - lower)
    new = np.abs(steps).max(axis=2).min(axis=1) > options.same_design
    mean, deviation = process.predict(cloud, return_std=True)
    J = problem.w1 * costs[0] + problem.w2 * mean
    s, gap = abs(problem.w2) * deviation, objective_of(problem, best) - J
    z = gap / s
    gains = gap * ndtr(z) + s * np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    gains = np.where(allowed & new, np.fmax(gains, 0.0), 0.0)  # f may be NaN at a θ
    left = 2.0 * float(gains.max()) / abs(problem.w2) + missed
    as_good = allowed & (gap >= -left * abs(problem.w2))
    as_good[1] = True  # the best itself
    ends = [np.quantile(each[as_good], (0.0, 1.0)) for each in (costs[0], mean)]
    ends[1] += (-left, left)
    if new[0]:
        return Outlook(best, left, expected, float(mean[0]), *ends)
    return Outlook(best, left, cloud[gains.argmax()], np.nan, *ends)


def search_error(sampler: Sampler, best: InnerSample) -> float:
    """By how much a full solve may end with another bandwidth at this θ (rad/s): by what the worst
    plants found in the box cost, and, where one search alone found the best controller, by the
    distance to the next local optimum."""
    if not best.kappa:
        return 0.0
    ends = multistart_at(sampler, best).design.local_optima[:2]
    alone = len(ends) == 2 and ends[0].count == 1
    apart = ends[0].bandwidth - ends[1].bandwidth if alone else 0.0
    design = value_with_design(sampler, best).design
    if plants := DesignOnBox(sampler.problem, best.theta, design).worst()[1]:
        wider = with_scenarios(sampler, plants).value_from(best.theta, best.kappa)
        apart += best.value - float(np.nan_to_num(wider.value))
    return apart


def worth_words(found: Mapping[str, Any], *, options: WorthOptions = WorthOptions()) -> list[str]:
    """Write the decision, what a full solve may add, both designs and their cost.

    Parameters
    ----------
    found : mapping
        The content of worth.json.
    options : WorthOptions

    Returns
    -------
    list of str
        Lines; the decision first.
    """
    lines = ["answer        Co-design is needed: the sequential hardware has no controller."]
    if np.isfinite(found["bandwidth_percent"]):
        hardly = found["gain_percent"] + found["uncertainty_percent"] < options.hardly
        cost, bandwidth = (
            " to ".join(dict.fromkeys(f"{v:+z.1f}" for v in found[f"full_solve_{key}_percent"]))
            for key in ("hardware_cost", "bandwidth")
        )
        weak = found["co_design"].get("survives", {"state": State.UNKNOWN, "words": "not known"})
        answer = f"Co-design is {'hardly ' * hardly}worth it"
        if weak["state"] != State.PASSED:
            answer += f", but its design is not to be built as it is (survives {weak['state']})"
        settled = "" if found["settled"] else f"; {options.rounds} rounds did not settle it"
        lines = [
            f"answer        {answer}: "
            f"hardware cost {found['hardware_cost_percent']:+z.1f} %, "
            f"bandwidth {found['bandwidth_percent']:+z.1f} % "
            "against the sequential design. Both designs are certified.",
            f"full solve    hardware cost {cost} %, bandwidth {bandwidth} % expected: an estimate, "
            f"no bound{settled}",
        ]
    for label, each in (("sequential", found["sequential"]), ("co-design", found["co_design"])):
        hz = f"{number(each['bandwidth_hz'])} Hz"
        lines.append(f"{label:14s}{theta_words(each)}: {cost_words(each)}, {hz}")
        if line := each.get("survives"):
            lines.append(f"              survives {line['state']}: {line['words']}")
    met = "met" if found["resonance_met"] else "not met anywhere in the box"
    rule = f"first resonance {number(found['first_resonance_hz'], 4)} Hz, the rule is {met}"
    return [*lines, f"hardware      {rule}", f"cost          {found['syntheses']} syntheses"]
