"""The sequential design, and an estimate of what co-design gains over it.

Sequential: the hardware of least cost f(θ) whose first resonance meets a rule of thumb, then its
best controller. Co-design is estimated by Bayesian optimisation of J = w₁ f(θ) + w₂ ω_b*(θ) with
few true inner problems. Frequencies are in rad/s unless a name ends in _hz.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter, process_time
from typing import Any

import numpy as np
from scipy.special import ndtr

from ccd_casadi.cases.case import Case
from ccd_casadi.codesign.nested import fit_bandwidth
from ccd_casadi.codesign.outer_problem import OuterFailure, outer_program, solve_program
from ccd_casadi.codesign.run import outer_of
from ccd_casadi.codesign.stored_searches import multistart_at, value_with_design
from ccd_casadi.codesign.verdict import State
from ccd_casadi.codesign.working_set import with_scenarios
from ccd_casadi.inner_problem.objective import (
    ConstraintOptions,
    constraint_sizes,
    objective,
    objective_of,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.reporting.facts import cost_words, theta_words
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.studies.comparison import design_hardware, first_resonance
from ccd_casadi.studies.steepest_descent import baseline_of
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ, number
from surrogates import design, to_casadi


@dataclass(frozen=True)
class WorthOptions:
    """Numbers of the estimate of what co-design gains.

    Attributes
    ----------
    slow : float
        Processor time in s of one evaluation of the plant, above which it counts as slow (finite
        elements).
    points, points_slow : int
        True inner problems over the box per parameter at first; of a slow plant.
    same_start : float
        Of a slow plant the case's start is not evaluated if it is this close to the sequential
        hardware, in shares of the box.
    rounds : int
        Rounds of surrogate, IPOPT and truth at most.
    settled, settled_slow : float
        The rounds end at a δ below this share of the bandwidth; of a slow plant.
    same_design : float
        Share of the box within which two designs are one.
    candidates : int
        Points in each box around the best θ at which the expected improvement is evaluated.
    box_sizes : tuple of float
        Half widths of these boxes, as shares of the box of θ.
    least_gain : float
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
    candidates: int = 256
    box_sizes: tuple[float, ...] = (1.0, 0.3, 0.1, 0.03)
    least_gain: float = 1.0


@dataclass(frozen=True)
class Outlook:
    """The best design so far, and what the surrogate expects of better ones.

    Attributes
    ----------
    best : InnerSample
        Of the least J.
    delta : float
        δ, the gain that further rounds may bring, as bandwidth at equal hardware cost, rad/s:
        twice the largest expected improvement, and the last error of prediction.
    theta : array (n,)
        The next true design: the surrogate's optimum, or where it has been evaluated already, the
        point of the largest expected improvement.
    predicted : float
        Bandwidth that the surrogate predicts at its optimum, rad/s; NaN at the other kind of point.
    costs, values : array (2,)
        Least and largest f, and bandwidth in rad/s, of designs whose J is within δ of the best.
    """

    best: InnerSample
    delta: float
    theta: Array
    predicted: float
    costs: Array
    values: Array


def worth(
    case: Case, sampler: Sampler, seed: int = 0, *, options: WorthOptions = WorthOptions()
) -> dict[str, Any]:
    """Estimate what co-design gains over the sequential design.

    The sequential design and a Sobol set are evaluated first. Each round fits a surrogate and
    evaluates the θ that it proposes, until δ is small. Then a multi-start search at both designs
    checks their controllers, and the rounds resume where it finds a better one. No time limit ends
    them.

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
    began, resonance = perf_counter(), HZ * case.baseline.first_resonance_hz
    lower, upper = box(sampler.problem)
    sobol = design("sobol", lower, upper, options.points * len(lower), seed)
    cpu_start = process_time()
    first_resonance(sampler.problem, sobol[0])  # cached by the plant: it is evaluated below again
    slow = process_time() - cpu_start > options.slow
    hardware = design_hardware(
        sampler.problem, resonance, starts=0 if slow else 8, seed=seed, workers=sampler.workers
    )
    outer = outer_of(sampler).prepare(seed)
    sampler, problem = outer.sampler, outer.problem
    distance = np.abs(np.subtract(hardware.theta, problem.start) / (upper - lower)).max()
    first = [hardware.theta]
    if not (slow and distance < options.same_start):
        first.append(problem.start)
    samples = sampler.values(np.array(first), "first designs")
    sobol = sobol[: options.points_slow * len(lower)] if slow else sobol
    samples += sampler.values(sobol, "global check")
    tolerance = options.settled_slow if slow else options.settled
    prediction_error, searched = 0.0, set[tuple[float, ...]]()
    for rounds_left in reversed(range(options.rounds + 1)):
        samples = sampler.latest(samples)  # searches improve the controllers of earlier ones
        ahead = outlook(problem, samples, prediction_error, seed, options=options)
        settled = ahead.delta <= tolerance * ahead.best.bandwidth
        if settled or not rounds_left:
            ends = {end.theta: end for end in (samples[0], ahead.best) if end.kappa}
            new = {at: multistart_at(sampler, ends[at]) for at in ends if at not in searched}
            better = [at for at in new if new[at].feasible and new[at].value > ends[at].value]
            for at in better:
                sampler.value_from(at, new[at].design.kappa.tolist())
            if not (better and rounds_left):
                if error := search_error(sampler, ahead.best):
                    ahead = outlook(
                        problem, samples, prediction_error + error, seed, options=options
                    )
                break
            prediction_error, searched = 0.0, searched | ends.keys()
            continue
        samples += sampler.values(ahead.theta, "the best expected")
        prediction_error = float(np.fmax(0.0, abs(samples[-1].value - ahead.predicted)))
    sequential, best = samples[0], ahead.best
    if not np.isfinite(objective_of(problem, best)):
        raise UserError(f"no feasible design was found: {sequential.shortfall}")
    entries: list[dict[str, Any]] = [
        {
            "theta": dict(zip(problem.names, sample.theta, strict=True)),
            "units": dict(zip(problem.names, problem.units, strict=True)),
            "hardware_cost": hardware_cost(plant_of(problem), sample.theta),
            "cost_unit": problem.cost_unit,
            "bandwidth_hz": sample.bandwidth / HZ,
        }
        for sample in (sequential, best)
    ]
    baseline = baseline_of(sampler.problem)
    for entry, sample in zip(entries, (sequential, best), strict=True):
        if sample.feasible:
            controller = baseline.design_of(sample)
            entry["survives"] = baseline.judge(sample.theta, controller, sampler.workers)[1].entry
    cost, bandwidth = entries[0]["hardware_cost"], sequential.bandwidth
    gain = objective(problem, sequential.theta, bandwidth) - objective_of(problem, best)
    return {
        "sequential": entries[0],
        "co_design": entries[1],
        "hardware_cost_percent": 100.0 * (entries[1]["hardware_cost"] / cost - 1.0),
        "bandwidth_percent": 100.0 * (best.bandwidth / bandwidth - 1.0),
        "gain_percent": 100.0 * gain / abs(problem.w2) / bandwidth,  # at equal hardware cost
        "uncertainty_percent": 100.0 * ahead.delta / bandwidth,
        "full_solve_hardware_cost_percent": (100.0 * (ahead.costs / cost - 1.0)).tolist(),
        "full_solve_bandwidth_percent": (100.0 * (ahead.values / bandwidth - 1.0)).tolist(),
        "first_resonance_hz": hardware.first_resonance / HZ,
        "resonance_met": hardware.met,
        "settled": settled,
        "syntheses": sampler.syntheses,
        "seconds": perf_counter() - began,
    }


def outlook(
    problem: CoDesignProblem,
    samples: list[InnerSample],
    prediction_error: float,
    seed: int,
    *,
    options: WorthOptions = WorthOptions(),
) -> Outlook:
    """The next true design by a Gaussian process m(θ) ± s(θ) of the bandwidth, and δ.

    With Δ = J_best - (w₁ f + w₂ m) and σ = |w₂| s, the expected improvement of J at θ is

        EI = Δ Φ(Δ/σ) + σ φ(Δ/σ),   δ = 2 max EI/|w₂| + prediction error,

    over candidates in boxes around the best θ that meet λ <= 0 and are not evaluated yet. `samples`
    are all true designs, the prediction error |truth - prediction| of the last of them, rad/s.
    """
    certified = [sample for sample in samples if sample.feasible]
    if len(certified) <= len(problem.names):
        raise UserError(
            f"only {len(certified)} of {len(samples)} designs certified; widen the bounds"
        )
    best = min(samples, key=lambda sample: objective_of(problem, sample))
    process = fit_bandwidth(problem, certified, seed, gradients=True)
    lower, upper = box(problem)
    program = outer_program(problem, to_casadi(process, std=False))
    starts = np.vstack([best.theta, design("sobol", lower, upper, 8, seed)])
    try:
        optimum = solve_program(program, starts).best.x
    except OuterFailure:  # the surrogate predicts a feasible design nowhere
        optimum = np.array(best.theta)
    offsets = design("sobol", lower - upper, upper - lower, options.candidates, seed)
    thetas = best.theta + np.vstack([size * offsets for size in options.box_sizes])
    thetas = np.clip(np.vstack([optimum, best.theta, thetas]), lower, upper)  # (k, n)
    costs, constraints = (np.array(value) for value in plant_of(problem).hardware(thetas.T))
    met = ConstraintOptions.met * constraint_sizes(problem)[:, None]
    allowed = (constraints <= met).all(axis=0)
    distances = np.abs((thetas[:, None] - [each.theta for each in samples]) / (upper - lower))
    new = distances.max(axis=2).min(axis=1) > options.same_design
    mean, deviation = process.predict(thetas, return_std=True)
    J = problem.w1 * costs[0] + problem.w2 * mean
    sigma, improvement = abs(problem.w2) * deviation, objective_of(problem, best) - J
    z = improvement / sigma
    EI = improvement * ndtr(z) + sigma * np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi)
    EI = np.where(allowed & new, np.fmax(EI, 0.0), 0.0)  # f may be NaN at a θ
    delta = 2.0 * float(EI.max()) / abs(problem.w2) + prediction_error
    within_delta = allowed & (improvement >= -delta * abs(problem.w2))
    within_delta[1] = True  # the best itself
    ranges = [np.quantile(each[within_delta], (0.0, 1.0)) for each in (costs[0], mean)]
    ranges[1] += (-delta, delta)
    if new[0]:
        return Outlook(best, delta, optimum, float(mean[0]), *ranges)
    return Outlook(best, delta, thetas[EI.argmax()], np.nan, *ranges)


def search_error(sampler: Sampler, best: InnerSample) -> float:
    """Estimate by how much a full solve may end with another bandwidth at the same θ (rad/s).

    The loss to the worst plants found in the box, and, where only one start of the multi-start
    search reached the best controller, its distance to the next local optimum: a better optimum may
    be missed as easily.
    """
    if not best.kappa:
        return 0.0
    optima = multistart_at(sampler, best).design.local_optima[:2]
    only_one_start = len(optima) == 2 and optima[0].count == 1
    error = optima[0].bandwidth - optima[1].bandwidth if only_one_start else 0.0
    design = value_with_design(sampler, best).design
    if plants := DesignOnBox(sampler.problem, best.theta, design).worst()[1]:
        robust = with_scenarios(sampler, plants).value_from(best.theta, best.kappa)
        error += best.value - float(np.nan_to_num(robust.value))
    return error


def worth_words(result: Mapping[str, Any], *, options: WorthOptions = WorthOptions()) -> list[str]:
    """Write the decision, what a full solve may add, both designs and their cost."""
    lines = ["answer        Co-design is needed: the sequential hardware has no controller."]
    if np.isfinite(result["bandwidth_percent"]):
        negligible = result["gain_percent"] + result["uncertainty_percent"] < options.least_gain
        cost, bandwidth = (
            " to ".join(dict.fromkeys(f"{v:+z.1f}" for v in result[f"full_solve_{key}_percent"]))
            for key in ("hardware_cost", "bandwidth")
        )
        survives = result["co_design"].get(
            "survives", {"state": State.UNKNOWN, "words": "not known"}
        )
        answer = f"Co-design is {'hardly ' * negligible}worth it"
        if survives["state"] != State.PASSED:
            answer += f", but its design is not to be built as it is (survives {survives['state']})"
        unsettled = "" if result["settled"] else f"; {options.rounds} rounds did not settle it"
        lines = [
            f"answer        {answer}: "
            f"hardware cost {result['hardware_cost_percent']:+z.1f} %, "
            f"bandwidth {result['bandwidth_percent']:+z.1f} % "
            "against the sequential design. Both designs are certified.",
            f"full solve    will probably end at hardware cost {cost} %, bandwidth {bandwidth} % "
            f"(an estimate){unsettled}",
        ]
    for label, each in (("sequential", result["sequential"]), ("co-design", result["co_design"])):
        hz = f"{number(each['bandwidth_hz'])} Hz"
        lines.append(f"{label:14s}{theta_words(each)}: {cost_words(each)}, {hz}")
        if line := each.get("survives"):
            lines.append(f"              survives {line['state']}: {line['words']}")
    met = "met" if result["resonance_met"] else "not met anywhere in the box"
    rule = f"first resonance {number(result['first_resonance_hz'], 4)} Hz, the rule is {met}"
    return [*lines, f"hardware      {rule}", f"cost          {result['syntheses']} syntheses"]
