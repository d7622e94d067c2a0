"""Every method side by side on one case, what follows from their figures, and what the paper
publishes."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign import FORMULATIONS
from ccd_casadi.codesign.formulations import formulation_of
from ccd_casadi.codesign.run import co_design
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem.objective import objective
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.reporting.decision import decide
from ccd_casadi.sampling.inner_samples import spent_entry
from ccd_casadi.sampling.sampler import Sampler, TraceEntry
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.studies.sequential_hardware import HardwareDesign, design_hardware, first_resonance
from ccd_casadi.studies.steepest_descent import (
    AnyDesign,
    Descent,
    Gradient,
    baseline_of,
    steepest_descent,
)
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.terminal import Progress
from ccd_casadi.support.text import HZ, counted, package_text, versions
from ccd_casadi.support.worker_process import one_blas_thread
from surrogates import latin_hypercube

PUBLISHED: dict[str, dict[str, Any]] = json.loads(package_text("studies/published.json"))


LABELS = {
    "nested": "nested",
    "lifted": "lifted",
    "direct": "direct",
    "steepest_descent": "steepest descent, K fixed",
    "steepest_descent_total": "steepest descent, total gradient",
    "sequential": "sequential, next to the start",
    "sequential_global": "sequential, globally cheapest",
}


def conclusions(
    problem: CoDesignProblem, methods: dict[str, dict[str, Any]], *, equal: float = 1e-6
) -> dict[str, Any]:
    """Figures and sentences; entries without a feasible design are left out of the ranking.

    Two J are equal where they differ by less than `equal` (relative).
    """
    solved = {name: f for name, f in methods.items() if f.get("objective") is not None}
    if not solved:
        return {"best": None, "sentences": ["No method found a feasible design."]}
    ranked = sorted(solved, key=lambda name: solved[name]["objective"])
    best = solved[ranked[0]]["objective"]
    near = [n for n in ranked if solved[n]["objective"] <= best + equal * abs(best)]
    cheapest = min(near, key=lambda name: solved[name]["syntheses_to_optimum"])
    answer: dict[str, Any] = {"best": cheapest, "best_objective": best, "equally_good": near}
    sentences = [
        f"The best J is {best:.4f}, reached by {', '.join(near)}; the cheapest of these is "
        f"{cheapest} with {solved[cheapest]['syntheses_to_optimum']} true syntheses to the optimum"
        f"{_beside(solved[cheapest])}."
    ]
    for name in ("steepest_descent", "steepest_descent_total"):
        if name in solved:
            found, words = _descent(problem, solved[name], solved[cheapest], name, equal)
            answer[name] = found
            sentences += words
    against = [name for name in ranked if name in ("sequential", "sequential_global")]
    for i, name in enumerate(against):  # the best of them stands first: it is the answer
        answer[name], sentence = _sequential_words(solved[name], solved[cheapest], name)
        sentences.insert(len(sentences) if i else 0, sentence)
    if said := decision(solved[cheapest]):
        sentences[0] = f"{said} That is the best design, of {LABELS[cheapest]}. {sentences[0]}"
    return answer | {"sentences": sentences}


def decision(figures: dict[str, Any]) -> str:
    """Whether to build a design: of a baseline, which has no other line, by what it survives."""
    found = decide(figures)
    if "certified" not in figures.get("verdict", {}) and found.builds:
        return "Solve the case before you build this: a baseline has no whole verdict."
    return found.words


def stable_words(figures: dict[str, Any]) -> str:
    """For resonances how far off a loop is stable, in %; what is not known is a dash."""
    shift = figures.get("verdict", {}).get("survives", {}).get("stable_shift")
    return "–" if not shift else f"{100.0 * shift[0]:+.2g} to {100.0 * shift[1]:+.2g} %"


def _beside(figures: dict[str, Any]) -> str:
    """The global check over the box that every formulation ends with, and no descent."""
    beside = figures["syntheses"] - figures["syntheses_to_optimum"]
    return f", and {beside} in the global check over the box" if beside else ""


def _descent(
    problem: CoDesignProblem, run: dict[str, Any], best: dict[str, Any], name: str, equal: float
) -> tuple[dict[str, Any], list[str]]:
    """How far a descent ends from the best, and what stopped it."""
    gap = run["objective"] - best["objective"]
    ratio = run["syntheses"] / best["syntheses_to_optimum"]
    ends = zip(run["theta"].values(), best["theta"].values(), *box(problem), strict=True)
    moved = max(abs(a - b) / (high - low) for a, b, low, high in ends)
    found = {
        "objective_gap": gap,
        "synthesis_ratio": ratio,
        "distance_to_best": moved,
        "stop": run["stop"],
        "last_gradient": run["history"][-1]["gradient"],
    }
    above = f"{gap:.3g} above" if gap > 0.0 else "the same" if gap == 0.0 else f"{-gap:.3g} below"
    many = f"{ratio:.0f} times as many" if ratio >= 1.5 else f"{ratio:.2g} times as many"
    took = "1 synthesis" if run["syntheses"] == 1 else f"{run['syntheses']} syntheses"
    many = "as many" if run["syntheses"] == best["syntheses_to_optimum"] else many
    words = [
        f"S{LABELS[name][1:]} (best of {counted(run['runs'], 'run')}) ends at J = "
        f"{run['objective']:.4f}, {above}, after {took}, "
        f"{many}; all its runs together took {run['syntheses_of_all_runs']}."
    ]
    if gap > equal * abs(best["objective"]):
        words.append(
            f"It stopped at {100 * moved:.2g} % of the box from the best design, because "
            f"{run['stop']}."
        )
    return found, words


def _sequential_words(
    run: dict[str, Any], best: dict[str, Any], name: str
) -> tuple[dict[str, Any], str]:
    cost = 100.0 * (best["hardware_cost"] / run["hardware_cost"] - 1.0)
    speed = 100.0 * (best["bandwidth_hz"] / run["bandwidth_hz"] - 1.0)
    found = {"hardware_cost_percent": cost, "bandwidth_percent": speed}
    words = (
        f"Against the {LABELS[name].replace(',', ' design,')} (hardware cost "
        f"{run['hardware_cost']:.5g}, {run['bandwidth_hz']:.2f} Hz) co-design "
        f"changes the hardware cost by {cost:+.1f} % and the bandwidth by {speed:+.1f} %."
    )
    return found, words


@dataclass(frozen=True)
class Method:
    """One method's entry: its JSON figures, its path over θ, and J against syntheses spent.

    `controller` (SI) is that of its design; None where it found none.
    """

    name: str
    figures: dict[str, Any]
    path: tuple[tuple[float, ...], ...]
    trace: tuple[TraceEntry, ...]
    solution: Solution | None = None
    controller: StateSpace | None = None


@dataclass(frozen=True)
class _Setting:
    """What every method is given: stores go to `folder`."""

    case: Case
    problem: CoDesignProblem
    folder: Path
    workers: Pool
    seed: int
    quiet: bool

    def store(self, name: str) -> SampleStore:
        return SampleStore(self.folder / f"samples_{name}.sqlite")


@dataclass(frozen=True)
class Comparison:
    """All methods on one case.

    Attributes
    ----------
    case : Case
    problem : CoDesignProblem
    methods : tuple of Method
    descents : tuple of Descent
        Of which the best of each gradient is among the methods.
    seconds : float
    """

    case: Case
    problem: CoDesignProblem
    methods: tuple[Method, ...]
    descents: tuple[Descent, ...]
    seconds: float

    def method(self, name: str) -> Method:
        """The method of that name."""
        return next(method for method in self.methods if method.name == name)


@one_blas_thread
def compare(
    case: Case, problem: CoDesignProblem, folder: Path, workers: Pool, *, seed: int, quiet: bool
) -> Comparison:
    """Run every method, each with its own store and count.

    With a controller of fixed structure the descents and the sequential designs climb from the
    warm starts of the best formulation, and its search is not counted as theirs; the descent with K
    held fixed sweeps weights, which sections do not have, and is left out.

    Parameters
    ----------
    case, problem : Case, CoDesignProblem
        What is solved.
    folder, workers, seed, quiet : path, Pool, int, bool
        Of the stores; processes; of every random choice; whether without progress on stderr.

    Returns
    -------
    Comparison
    """
    began = perf_counter()
    given = _Setting(case, problem, folder, workers, seed, quiet)
    methods = [_formulation(given, name) for name in FORMULATIONS]
    problem = _chosen(problem, methods)
    given = replace(given, problem=problem)
    descents = _descents(given)
    methods += [_best_descent(problem, descents, each, workers)
                for each in baseline_of(problem).gradients]  # fmt: skip
    methods += [_sequential(given, "sequential", 0), _sequential(given, "sequential_global", 8)]
    return Comparison(case, problem, tuple(methods), tuple(descents), perf_counter() - began)


def _chosen(problem: CoDesignProblem, methods: Sequence[Method]) -> CoDesignProblem:
    """The problem with the design plant of the best formulation, where the case leaves it open.

    And with what its search has added: warm starts and plants of a fixed structure.
    """
    ends = [
        (method.figures["objective"], method.solution.verified.problem)
        for method in methods
        if method.solution is not None and method.solution.verified is not None
    ]
    return min(ends, key=lambda end: end[0])[1] if ends else problem


def _formulation(given: _Setting, name: str) -> Method:
    began = perf_counter()
    with given.store(name) as store:
        sampler = Sampler(given.problem, store, given.workers, quiet=given.quiet)
        solution = co_design(sampler, formulation_of(given.case, name), given.seed)
        trace = tuple(sampler.trace)
    figures = solution.result | {"seconds": perf_counter() - began}
    path = tuple(iterate.theta for iterate in solution.outcome.iterates)
    if solution.verified is not None:
        path = (*path, solution.verified.theta)
        figures["first_resonance_hz"] = _resonance(given.problem, solution.verified.theta)
    made = None if solution.verified is None else solution.verified.controller
    return Method(name, figures, path, trace, solution=solution, controller=made)


def _descents(given: _Setting) -> list[Descent]:
    """Both gradients from every start with every first step."""
    base, problem = given.case.baseline, given.problem
    lower, upper = box(problem)
    starts = [problem.start]
    if base.starts > 1:
        spread = latin_hypercube(lower, upper, base.starts - 1, given.seed)
        starts += [tuple(float(v) for v in theta) for theta in spread]
    tasks = {
        (gradient, start, step): (problem, start, gradient, step, base.max_iterations)
        for gradient in baseline_of(problem).gradients
        for start in starts
        for step in base.steps
    }
    bar = Progress(len(tasks), "steepest descent", quiet=given.quiet)
    return [run for _, run in sorted(bar.over(results(given.workers, steepest_descent, tasks)))]


def _best_descent(
    problem: CoDesignProblem, descents: Sequence[Descent], gradient: Gradient, workers: Pool
) -> Method:
    """The descent of that gradient with the best J, fewest syntheses among equals."""
    runs = [descent for descent in descents if descent.gradient is gradient]
    best = min(runs, key=lambda d: (round(d.objective, 9), d.syntheses))
    name = "steepest_descent" if gradient is Gradient.FIXED else "steepest_descent_total"
    extra = _run_dict(best) | {
        "runs": len(runs),
        "syntheses_of_all_runs": sum(run.syntheses for run in runs),
        "history": [asdict(iterate) for iterate in best.iterates],
    }
    spent = {"descent": best.syntheses}
    if best.design is None:
        figures = {"status": "infeasible", "reason": best.stop.value, **spent_entry(spent)}
        return Method(name, json_values(figures | extra), (), ())
    theta = best.iterates[-1].theta
    made, figures = _figures(problem, theta, best.design, spent, best.seconds, workers)
    figures |= extra
    trace = tuple(
        TraceEntry(item.syntheses, item.theta, item.bandwidth, item.objective)
        for item in best.iterates
    )
    path = tuple(item.theta for item in best.iterates)
    return Method(name, json_values(figures), path, trace, controller=made)


def _run_dict(descent: Descent) -> dict[str, Any]:
    """How a descent began, and how it ended."""
    return {
        "gradient": descent.gradient.value,
        "start": descent.start,
        "first_step": descent.first_step,
        "stop": descent.stop.value,
        "iterations": len(descent.iterates),
    }


def _sequential(given: _Setting, name: str, starts: int) -> Method:
    began, problem = perf_counter(), given.problem
    resonance = HZ * given.case.baseline.first_resonance_hz
    hardware: HardwareDesign = design_hardware(
        problem, resonance, starts=starts, seed=given.seed, workers=given.workers
    )
    with given.store(name) as store:
        sampler = Sampler(problem, store, given.workers)
        sample = sampler.values(np.array(hardware.theta))[0]
        trace = tuple(sampler.trace)
        spent = sampler.spent.by_purpose
        if not sample.feasible:
            figures = {"status": "infeasible", "reason": sample.shortfall, **spent_entry(spent)}
            return Method(name, figures, (hardware.theta,), trace)
    design = baseline_of(problem).design_of(sample)
    seconds = perf_counter() - began
    made, figures = _figures(problem, hardware.theta, design, spent, seconds, given.workers)
    figures |= {"resonance_met": hardware.met, "active": list(sample.active)}
    return Method(name, json_values(figures), (hardware.theta,), trace, controller=made)


def _figures(
    problem: CoDesignProblem,
    theta: tuple[float, ...],
    design: AnyDesign,
    spent: dict[str, int],
    seconds: float,
    workers: Pool,
) -> tuple[StateSpace, dict[str, Any]]:
    """The controller of a design that no formulation made, and the contract's keys for it, with
    what it survives: it may look better than a run's by not having been asked."""
    baseline = baseline_of(problem)
    own = baseline.figures(theta, design)
    made, line = baseline.judged(theta, design, workers)
    return made, {
        **own,
        "verdict": {"survives": line.entry},
        "theta": dict(zip(problem.names, theta, strict=True)),
        "hardware_cost": hardware_cost(plant_of(problem), theta),
        "objective": objective(problem, theta, HZ * own["bandwidth_hz"]),
        "first_resonance_hz": _resonance(problem, theta),
        "surrogate_bandwidth_hz": None,
        "verification_error": None,
        **spent_entry(spent),
        "seconds": seconds,
        "versions": versions(),
    }


def _resonance(problem: CoDesignProblem, theta: tuple[float, ...]) -> float:
    return first_resonance(problem, np.array(theta))[0] / HZ


def comparison_dict(comparison: Comparison, seed: int) -> dict[str, Any]:
    """Make the content of compare.json.

    Parameters
    ----------
    comparison : Comparison
    seed : int

    Returns
    -------
    dict
        Plain JSON values.
    """
    problem, methods = comparison.problem, comparison.methods
    entries = {method.name: method.figures for method in methods}
    descents = [
        _run_dict(run)
        | {"objective": run.objective, "syntheses": run.syntheses}
        | {"theta": run.iterates[-1].theta if run.iterates else None}
        for run in comparison.descents
    ]
    published = PUBLISHED.get(problem.source.model or "", {})
    return json_values({
        "case": str(comparison.case.path),
        "methods": entries,
        "traces": {method.name: [asdict(entry) for entry in method.trace] for method in methods},
        "descents": descents,
        "published": published if baseline_of(problem).swept else {},
        "conclusions": conclusions(problem, entries),
        "seconds": comparison.seconds,
        "seed": seed,
        "versions": versions(),
    })  # fmt: skip
