"""Every method side by side on one case: the formulations, the descents, the sequential design."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.cases.sections import Case
from ccd_casadi.codesign import FORMULATIONS
from ccd_casadi.codesign.design_entries import figures_dict
from ccd_casadi.codesign.formulations import formulation_of
from ccd_casadi.codesign.run import co_design
from ccd_casadi.codesign.sections_entries import active_of, design_dict
from ccd_casadi.codesign.solution import Solution
from ccd_casadi.codesign.verified_sections import VerifiedSections
from ccd_casadi.fixed_structure import SectionsDesign
from ccd_casadi.inner_problem.objective import objective
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.sections_bandwidth import sections_value
from ccd_casadi.inner_problem.sweep import active_constraints
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.sampling.sampler import Sampler, TraceEntry
from ccd_casadi.sampling.spent import spent_entry
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.studies.conclusions import conclusions
from ccd_casadi.studies.published import PUBLISHED
from ccd_casadi.studies.sequential import HardwareDesign, design_hardware, first_resonance
from ccd_casadi.studies.steepest_descent import Descent, Gradient, steepest_descent
from ccd_casadi.support.json_files import clean
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.progress import Progress
from ccd_casadi.support.units import HZ
from ccd_casadi.support.versions import versions
from ccd_casadi.synthesis.derivatives import Sensitivities
from surrogates import latin_hypercube


@dataclass(frozen=True)
class Method:
    """One method's entry: its JSON figures, its path over θ, and J against syntheses spent.

    `sections` is the design of a fixed structure, of whatever method.
    """

    name: str
    figures: dict[str, Any]
    path: tuple[tuple[float, ...], ...]
    trace: tuple[TraceEntry, ...]
    solution: Solution | None = None
    descent: Descent | None = None
    sections: SectionsDesign | None = None


@dataclass(frozen=True)
class Comparison:
    """All methods on one case, and the descents behind the best of each gradient."""

    case: Case
    problem: CoDesignProblem
    methods: tuple[Method, ...]
    descents: tuple[Descent, ...]
    seconds: float

    def method(self, name: str) -> Method:
        """The method of that name."""
        return next(method for method in self.methods if method.name == name)


def compare(
    case: Case, problem: CoDesignProblem, folder: Path, workers: Pool, *, seed: int, quiet: bool
) -> Comparison:
    """Run every method, each with a store and a count of its own.

    With a controller of fixed structure the descents and the sequential designs climb from the
    anchors of the best formulation, and its race is not counted as theirs; the descent with K held
    fixed sweeps weights, which sections do not have, and is left out.
    """
    began = perf_counter()
    methods = [
        _formulation(case, problem, folder, workers, name, seed, quiet) for name in FORMULATIONS
    ]
    problem = _chosen(problem, methods)
    descents = _descents(case, problem, workers, seed, quiet)
    for gradient in gradients_of(problem):
        methods.append(_best_descent(problem, descents, gradient))
    for name, starts in (("sequential", 0), ("sequential_global", 8)):
        methods.append(_sequential(case, problem, folder, workers, name, starts, seed))
    return Comparison(case, problem, tuple(methods), tuple(descents), perf_counter() - began)


def gradients_of(problem: CoDesignProblem) -> tuple[Gradient, ...]:
    """The gradients that a descent can follow."""
    return tuple(Gradient) if problem.sections is None else (Gradient.TOTAL,)


def _chosen(problem: CoDesignProblem, methods: Sequence[Method]) -> CoDesignProblem:
    """The problem with the design plant of the best formulation, where the case leaves it open.

    With sections: with the anchors and the plant set of the best.
    """
    ends = [m for m in methods if m.solution is not None and m.solution.verified is not None]
    if ends and problem.sections is not None:
        best = min(ends, key=lambda m: m.figures["objective"])
        assert best.solution is not None
        assert best.solution.verified is not None
        return best.solution.verified.problem
    solved = [m for m in methods if m.solution is not None and m.solution.problem is not None]
    if problem.robust is None or problem.robust.design_shift is not None or not solved:
        return problem
    best = min(solved, key=lambda m: m.figures.get("objective", np.inf))
    assert best.solution is not None
    return best.solution.problem or problem


def _formulation(
    case: Case,
    problem: CoDesignProblem,
    folder: Path,
    workers: Pool,
    name: str,
    seed: int,
    quiet: bool,
) -> Method:
    began = perf_counter()
    with SampleStore(folder / f"samples_{name}.sqlite") as store:
        sampler = Sampler(problem, store, workers, quiet=quiet)
        solution = co_design(sampler, formulation_of(case, name), seed)
        trace = tuple(sampler.trace)
    figures = solution.result | {"seconds": perf_counter() - began}
    path = tuple(iterate.theta for iterate in solution.outcome.iterates)
    if solution.verified is not None:
        path = (*path, solution.verified.theta)
        figures["first_resonance_hz"] = _resonance(problem, solution.verified.theta)
    end = solution.verified
    made = end.design if isinstance(end, VerifiedSections) else None
    return Method(name, figures, path, trace, solution=solution, sections=made)


def _descents(
    case: Case, problem: CoDesignProblem, workers: Pool, seed: int, quiet: bool
) -> list[Descent]:
    """Both gradients from every start with every first step."""
    base = case.baseline
    lower, upper = box(problem)
    starts = [problem.start]
    if base.starts > 1:
        spread = latin_hypercube(lower, upper, base.starts - 1, seed)
        starts += [tuple(float(v) for v in theta) for theta in spread]
    tasks = [
        (problem, start, gradient, step, base.max_iterations)
        for gradient in gradients_of(problem)
        for start in starts
        for step in base.steps
    ]
    found = []
    with Progress(len(tasks), "steepest descent", quiet=quiet) as progress:
        for descent in workers.map_unordered(_descend, tasks):
            found.append(descent)
            progress.advance()
    return sorted(found, key=lambda d: (d.gradient, d.start, d.first_step))


def _descend(
    task: tuple[CoDesignProblem, tuple[float, ...], Gradient, float, int],
) -> Descent:
    problem, start, gradient, step, iterations = task
    began = perf_counter()
    descent = steepest_descent(
        problem, start, gradient=gradient, first_step=step, max_iterations=iterations
    )
    return Descent(**{**vars(descent), "seconds": perf_counter() - began})


def _best_descent(
    problem: CoDesignProblem, descents: Sequence[Descent], gradient: Gradient
) -> Method:
    """The descent of that gradient with the best J, fewest syntheses among equals."""
    runs = [descent for descent in descents if descent.gradient is gradient]
    best = min(runs, key=lambda d: (round(d.objective, 9), d.syntheses))
    name = "steepest_descent" if gradient is Gradient.FIXED else "steepest_descent_total"
    extra = {
        "gradient": gradient.value,
        "start": best.start,
        "first_step": best.first_step,
        "stop": best.stop.value,
        "iterations": len(best.iterates),
        "runs": len(runs),
        "syntheses_of_all_runs": sum(run.syntheses for run in runs),
        "history": [asdict(iterate) for iterate in best.iterates],
    }
    if best.design is None:
        figures = {"status": "infeasible", "reason": best.stop.value}
        figures |= spent_entry({"descent": best.syntheses})
        return Method(name, clean(figures | extra), (), (), descent=best)
    theta = best.iterates[-1].theta
    spent = {"descent": best.syntheses}
    figures = _figures(problem, theta, best.design, spent, best.seconds) | extra
    trace = tuple(
        TraceEntry(item.syntheses, item.theta, item.bandwidth, item.objective)
        for item in best.iterates
    )
    path = tuple(item.theta for item in best.iterates)
    made = best.design if isinstance(best.design, SectionsDesign) else None
    return Method(name, clean(figures), path, trace, descent=best, sections=made)


def _sequential(
    case: Case,
    problem: CoDesignProblem,
    folder: Path,
    workers: Pool,
    name: str,
    starts: int,
    seed: int,
) -> Method:
    began = perf_counter()
    resonance = HZ * case.baseline.first_resonance_hz
    hardware: HardwareDesign = design_hardware(
        problem, resonance, starts=starts, seed=seed, workers=workers
    )
    with SampleStore(folder / f"samples_{name}.sqlite") as store:
        sampler = Sampler(problem, store, workers)
        sample = sampler.bandwidths(np.array(hardware.theta))[0]
        trace = tuple(sampler.trace)
        spent = sampler.spent.by_purpose
        if not sample.feasible:
            figures = {"status": "infeasible", "reason": sample.shortfall, **spent_entry(spent)}
            return Method(name, figures, (hardware.theta,), trace)
        design: Sensitivities | SectionsDesign
        if problem.sections is None:
            x = np.array([*sample.theta, np.log(sample.omega_S), np.log(sample.omega_T)])
            design = sampler.truth.at(x)
        else:
            design = sections_value(problem, sample.theta).design
    figures = _figures(problem, hardware.theta, design, spent, perf_counter() - began)
    figures |= {"resonance_met": hardware.met, "active": list(sample.active)}
    made = design if isinstance(design, SectionsDesign) else None
    return Method(name, clean(figures), (hardware.theta,), trace, sections=made)


def _figures(
    problem: CoDesignProblem,
    theta: tuple[float, ...],
    design: Sensitivities | SectionsDesign,
    spent: dict[str, int],
    seconds: float,
) -> dict[str, Any]:
    """The contract's keys for a design that no formulation made."""
    cost = hardware_cost(plant_of(problem), theta)
    if isinstance(design, SectionsDesign):
        own = design_dict(problem, theta, design)
        feasible, bandwidth = design.certified, design.bandwidth
        active = active_of(design)
    else:
        figures = design.figures
        own, feasible = figures_dict(figures), problem.inner.feasible(figures)
        bandwidth, active = figures.bandwidth, list(active_constraints(problem.inner, figures))
    return {
        **own,
        "status": "verified" if feasible else "not_verified",
        "theta": dict(zip(problem.names, theta, strict=True)),
        "hardware_cost": cost,
        "objective": objective(problem, theta, bandwidth),
        "active": active,
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
    """compare.json."""
    model = comparison.problem.source.model or ""
    entries = {method.name: method.figures for method in comparison.methods}
    return clean(
        {
            "case": str(comparison.case.path),
            "methods": entries,
            "traces": {
                method.name: [asdict(entry) for entry in method.trace]
                for method in comparison.methods
            },
            "descents": [
                {
                    "gradient": descent.gradient.value,
                    "start": descent.start,
                    "first_step": descent.first_step,
                    "objective": descent.objective,
                    "theta": descent.iterates[-1].theta if descent.iterates else None,
                    "stop": descent.stop.value,
                    "iterations": len(descent.iterates),
                    "syntheses": descent.syntheses,
                }
                for descent in comparison.descents
            ],
            "published": {} if comparison.problem.sections else PUBLISHED.get(model, {}),
            "conclusions": conclusions(comparison.problem, entries),
            "seconds": comparison.seconds,
            "seed": seed,
            "versions": versions(),
        }
    )
