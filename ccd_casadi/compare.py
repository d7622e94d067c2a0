"""`python -m ccd_casadi.compare CASE.toml`: every method side by side on one case."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.case import HZ, load_case, problem_of
from ccd_casadi.case_sections import Case
from ccd_casadi.case_toml import case_to_toml
from ccd_casadi.cluster import pool
from ccd_casadi.command_line import ExitCode, add_scheduler, parser, run, run_folder
from ccd_casadi.conclusions import conclusions
from ccd_casadi.derivatives import Sensitivities
from ccd_casadi.inner import active_constraints
from ccd_casadi.parallel import Pool
from ccd_casadi.plant import hardware_cost
from ccd_casadi.problem import CoDesignProblem, box, plant_of
from ccd_casadi.progress import Progress
from ccd_casadi.published import PUBLISHED
from ccd_casadi.results import clean, figures_dict, versions, write_json
from ccd_casadi.samples import SampleStore
from ccd_casadi.sampling import TraceEntry, Truth
from ccd_casadi.sequential import HardwareDesign, design_hardware, first_resonance
from ccd_casadi.solve import FORMULATIONS, PATIENCE, Solution, solve
from ccd_casadi.steepest_descent import Descent, Gradient, steepest_descent
from surrogates import latin_hypercube


@dataclass(frozen=True)
class Method:
    """One method's entry: its JSON figures, its path over θ, and J against syntheses spent."""

    name: str
    figures: dict[str, Any]
    path: tuple[tuple[float, ...], ...]
    trace: tuple[TraceEntry, ...]
    solution: Solution | None = None
    descent: Descent | None = None


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
    """Run every method, each with a store and a count of its own."""
    began = perf_counter()
    methods = [
        _formulation(case, problem, folder, workers, name, seed, quiet) for name in FORMULATIONS
    ]
    descents = _descents(case, problem, workers, seed, quiet)
    for gradient in Gradient:
        methods.append(_best_descent(problem, descents, gradient))
    for name, starts in (("sequential", 0), ("sequential_global", 8)):
        methods.append(_sequential(case, problem, folder, workers, name, starts, seed))
    return Comparison(case, problem, tuple(methods), tuple(descents), perf_counter() - began)


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
        truth = Truth(problem, store, workers, quiet=quiet)
        solution = solve(case, truth, name, seed)
        trace = tuple(truth.trace)
    figures = solution.result | {"seconds": perf_counter() - began}
    path = tuple(iterate.theta for iterate in solution.outcome.iterates)
    if solution.verified is not None:
        path = (*path, solution.verified.theta)
        figures["first_resonance_hz"] = _resonance(problem, solution.verified.theta)
    return Method(name, figures, path, trace, solution=solution)


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
        for gradient in Gradient
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
        figures = {"status": "infeasible", "reason": best.stop.value, "syntheses": best.syntheses}
        return Method(name, clean(figures | extra), (), (), descent=best)
    theta = best.iterates[-1].theta
    figures = _figures(problem, theta, best.design, best.syntheses, best.seconds) | extra
    trace = tuple(
        TraceEntry(item.syntheses, item.theta, item.bandwidth, item.objective)
        for item in best.iterates
    )
    path = tuple(item.theta for item in best.iterates)
    return Method(name, clean(figures), path, trace, descent=best)


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
        truth = Truth(problem, store, workers)
        sample = truth.bandwidths(np.array(hardware.theta))[0]
        trace = tuple(truth.trace)
        spent = truth.syntheses
        if not sample.feasible:
            figures = {"status": "infeasible", "reason": sample.shortfall, "syntheses": spent}
            return Method(name, figures, (hardware.theta,), trace)
        x = np.array([*sample.theta, np.log(sample.omega_S), np.log(sample.omega_T)])
        design = truth.design(x)
    figures = _figures(problem, hardware.theta, design, spent, perf_counter() - began)
    figures |= {"resonance_met": hardware.met, "active": list(sample.active)}
    return Method(name, clean(figures), (hardware.theta,), trace)


def _figures(
    problem: CoDesignProblem,
    theta: tuple[float, ...],
    design: Sensitivities,
    syntheses: int,
    seconds: float,
) -> dict[str, Any]:
    """The contract's keys for a design that no formulation made."""
    cost = hardware_cost(plant_of(problem), theta)
    figures = design.figures
    feasible = problem.inner.feasible(figures)
    return {
        **figures_dict(figures),
        "status": "verified" if feasible else "not_verified",
        "theta": dict(zip(problem.names, theta, strict=True)),
        "hardware_cost": cost,
        "objective": problem.w1 * cost + problem.w2 * figures.bandwidth,
        "active": list(active_constraints(problem.inner, figures)),
        "first_resonance_hz": _resonance(problem, theta),
        "surrogate_bandwidth_hz": None,
        "verification_error": None,
        "syntheses": syntheses,
        "seconds": seconds,
        "versions": versions(),
    }


def _resonance(problem: CoDesignProblem, theta: tuple[float, ...]) -> float:
    return first_resonance(problem, np.array(theta))[0] / HZ


def comparison_dict(comparison: Comparison, seed: int) -> dict[str, Any]:
    """compare.json."""
    model = comparison.problem.source.model or ""
    return clean(
        {
            "case": str(comparison.case.path),
            "methods": {method.name: method.figures for method in comparison.methods},
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
            "published": PUBLISHED.get(model, {}),
            "conclusions": conclusions(comparison.problem, _entries(comparison)),
            "seconds": comparison.seconds,
            "seed": seed,
            "versions": versions(),
        }
    )


def _entries(comparison: Comparison) -> dict[str, dict[str, Any]]:
    return {method.name: method.figures for method in comparison.methods}


def table(comparison: Comparison) -> str:
    """The methods in a few columns for the terminal."""
    lines = [f"{'method':24}{'J':>11}{'Hz':>9}{'cost':>10}{'syntheses':>11}{'s':>8}  status"]
    for method in comparison.methods:
        f = method.figures
        if f.get("objective") is None:
            lines.append(f"{method.name:24}{'':49}  {f['status']}: {f.get('reason', '')}")
            continue
        lines.append(
            f"{method.name:24}{f['objective']:11.4f}{f['bandwidth_hz']:9.3f}"
            f"{f['hardware_cost']:10.4g}{f['syntheses']:11d}{f['seconds']:8.1f}  {f['status']}"
        )
    return "\n".join(lines)


def command(options: argparse.Namespace) -> ExitCode:
    """The command itself."""
    case = load_case(options.case)
    problem = problem_of(case)
    plant_of(problem)
    out = options.out or options.case.with_name(options.case.stem + "_compare")
    folder = run_folder(options.case, out)
    with pool(options.scheduler, options.workers, PATIENCE) as workers:
        comparison = compare(case, problem, folder, workers, seed=options.seed, quiet=options.quiet)
    (folder / "case.toml").write_text(case_to_toml(case))
    answer = comparison_dict(comparison, options.seed)
    write_json(folder / "compare.json", answer)
    from ccd_casadi.compare_report import write_comparison_report  # matplotlib is slow to import

    write_comparison_report(folder, comparison, answer)
    if not options.quiet:
        print(table(comparison))
        print("\n".join(answer["conclusions"]["sentences"]))
        print(f"run folder    {folder}")
    statuses = {method.figures["status"] for method in comparison.methods if method.solution}
    if statuses == {"infeasible"}:
        return ExitCode.INFEASIBLE
    return ExitCode.DONE if statuses == {"verified"} else ExitCode.NOT_VERIFIED


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    arguments = parser("ccd_casadi.compare", "Every method on one case.")
    add_scheduler(arguments)
    return run(command, arguments, argv)


if __name__ == "__main__":
    raise SystemExit(main())
