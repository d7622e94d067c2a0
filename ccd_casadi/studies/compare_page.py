"""report.html of a comparison: the methods, their cost, paths and loops, the paper beside."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.cases.schema import case_to_toml
from ccd_casadi.codesign.verdict import State
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import CYCLE, axis_label
from ccd_casadi.inner_problem.kinds import design_view
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.reporting.concerns import lines_of, worst_state
from ccd_casadi.reporting.facts import theta_axes
from ccd_casadi.reporting.gain_figures import figure_gains
from ccd_casadi.reporting.landscape import bandwidth_process, landscape_data, read_truths
from ccd_casadi.reporting.solve_page import stage_chapters
from ccd_casadi.studies.comparison import LABELS, Comparison, Method, stable_words
from ccd_casadi.studies.steepest_descent import baseline_of
from ccd_casadi.support.text import HZ, number


def comparison_page(folder: Path, comparison: Comparison, answer: dict[str, Any]) -> c.Page:
    """Make report.html of a comparison; the folder's samples are read.

    Parameters
    ----------
    folder : Path
    comparison : Comparison
    answer : dict
        compare.json.

    Returns
    -------
    Page
    """
    problem, found = comparison.problem, answer["conclusions"]
    best = found["best"]
    chapters = [c.Chapter("The methods", _methods(problem, answer))]
    if more := found["sentences"][2:]:  # the head has the first two
        chapters.append(c.Chapter("What it shows", tuple(map(c.Words, more))))
    chapters.append(c.Chapter("Cost", (cost_figure(comparison.methods),)))
    if len(problem.names) == 2:
        chapters.append(c.Chapter("Paths over the landscape", (_paths(folder, comparison, best),)))
    if best is not None:
        loops = _loops(comparison, best)
        chapters.append(c.Chapter("Sensitivity, baseline and co-design", (loops,)))
        thetas = {
            name: comparison.method(name).figures.get("theta") for name in ("sequential", best)
        }
        stages = {LABELS[name]: tuple(theta.values()) for name, theta in thetas.items() if theta}
        chapters += stage_chapters(problem, stages)
    chapters += [
        c.Chapter(
            f"Verdict: {LABELS[method.name]}", (c.Verdict(lines_of(method.figures)),), folded=True
        )
        for method in comparison.methods
        if lines_of(method.figures)
    ]
    versions = ", ".join(f"{name} {version}" for name, version in answer["versions"].items())
    with_seed = c.Words(f"{versions}; seed {answer['seed']}.")
    source = c.Source(case_to_toml(comparison.case))
    chapters.append(c.Chapter("The case", (with_seed, source), folded=True))
    ours = [method.figures for method in comparison.methods if method.solution]
    verified = all(figures["status"] == "verified" for figures in ours)
    warned = any(worst_state(figures) is not State.PASSED for figures in ours)
    head = c.Head(
        f"Comparison: {comparison.case.path.name}",
        "bad" if not verified else "warn" if warned else "good",
        "verified" if verified else "not verified",
        "With warnings: see the verdicts below." if verified and warned else "",
        f"{len(comparison.methods)} methods, {number(comparison.seconds, 3)} s in all",
        " ".join(found["sentences"][1:2]), decision=found["sentences"][0],
    )  # fmt: skip
    return c.Page(head, tuple(chapters), index="")


def _methods(problem: CoDesignProblem, answer: dict[str, Any]) -> tuple[c.Table, c.Words]:
    """All methods in one table, the paper's figures below them."""
    factors = {name: factor for name, _, factor in theta_axes(problem)}
    names = [axis_label(name, unit) for name, unit, _ in theta_axes(problem)]
    cost = f"cost f ({problem.cost_unit})" if problem.cost_unit else "cost f"
    head = (
        "method", *names, cost, "ω_b (Hz)", "J", "f₁ (Hz)", "‖S‖∞", "syntheses", "global check",
        "s", "certified", "stable for resonances", "survives",
    )  # fmt: skip
    rows: list[tuple[Any, ...]] = []
    for name, figures in answer["methods"].items():
        if figures.get("objective") is None:
            empty = ("–",) * (len(head) - 2)
            rows.append((LABELS[name], *empty, figures["status"]))
            continue
        spent = figures["syntheses_to_optimum"]
        own = (str(spent), str(figures["syntheses"] - spent or "–"), number(figures["seconds"], 2),
               "yes" if figures["certificate"]["passed"] else "no", stable_words(figures),
               figures["verdict"]["survives"]["state"])  # fmt: skip
        rows.append((LABELS[name], *_row(figures, factors), *own))
    for name, label in (("sequential", "paper: sequential"), ("nested_ccd", "paper: nested CCD")):
        if name in answer["published"]:
            rows.append((label, *_row(answer["published"][name], factors), *["–"] * 6))
    words = (
        "Each formulation of ours ends with a polish and a KKT certificate on the true problem. "
        "Syntheses count those until the optimum was found; the next column has those of the "
        "global check over the box. A descent's are those of its best run; compare.json has all."
    )
    if not baseline_of(problem).swept:
        words = (
            "Each formulation ends with a polish and a KKT certificate on the true problem. A "
            "synthesis is a search from the warm starts, or a multi-start search. The descent and "
            "the sequential designs use the best formulation's warm starts. Sections have no "
            "weights, so the descent with K held fixed and the landscape over the weights' "
            "frequencies are left out."
        )
    return c.Table(head, tuple(rows)), c.Words(words)


def _row(figures: Mapping[str, Any], factors: Mapping[str, float]) -> tuple[str, ...]:
    """θ, then what is known of the design; dashes for the rest."""
    theta = figures.get("theta", {})
    shown = {"hardware_cost": 5, "bandwidth_hz": 5, "objective": 6, "first_resonance_hz": 5,
             "sensitivity_peak": 5}  # fmt: skip
    return (
        *(number(factors[key] * theta[key], 4) if key in theta else "–" for key in factors),
        *(number(figures.get(key), digits) for key, digits in shown.items()),
    )


def _paths(folder: Path, comparison: Comparison, best: str | None) -> c.Figure:
    """The landscape from the nested surrogate, the way of each iterative method over it."""
    problem, process = comparison.problem, None
    nested = comparison.method("nested").solution
    if nested is not None:
        process = bandwidth_process(nested.outcome.surrogates)
        if nested.verified is not None:  # its samples may be of its own warm starts
            problem = nested.verified.problem
    truths = read_truths(folder / "samples_nested.sqlite", problem)
    land = landscape_data(problem, process, truths)
    optimum = None
    if best is not None:
        theta = comparison.method(best).figures["theta"]
        optimum = (theta[problem.names[0]], theta[problem.names[1]])
    caption = (
        "Colours: ω_b*(θ) predicted by the nested formulation's surrogate; dots: its true samples "
        "in the same colours."
    )
    return c.Figure(replace(land, paths=theta_paths(comparison.methods), optimum=optimum), caption)


def _loops(comparison: Comparison, best: str) -> c.Figure:
    """σ_max(S) of the sequential baseline against the best co-design (the paper's figure 11)."""
    loops = [
        design_view(
            comparison.problem, tuple(method.figures["theta"].values()), method.controller,
            bandwidth_hz=method.figures["bandwidth_hz"], label=LABELS[method.name],
        )
        for method in (comparison.method(best), comparison.method("sequential"))
        if method.controller is not None
    ]  # fmt: skip
    words = "; ".join(
        f"{loop.label}: ω_b = {loop.bandwidth_hz:.2f} Hz, ‖S‖∞ = {loop.sizes[0].max():.3f}"
        for loop in loops
    )
    caption = f"Largest singular values of the closed loop. {words}."
    return c.Figure(figure_gains(loops, bounds=False), caption)


def best_so_far(method: Method) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Syntheses spent, least J and its bandwidth (Hz) after each feasible design of a run."""
    found, best = [], np.inf
    for entry in method.trace:
        if np.isfinite(entry.objective) and entry.objective < best:
            best = entry.objective
            found.append((entry.syntheses, best, entry.bandwidth / HZ))
    if found:
        spent_in_all = method.figures.get("syntheses", 0)  # what the last improvement took not
        found.append((max(method.trace[-1].syntheses, spent_in_all), *found[-1][1:]))
    spent, objective, bandwidth = np.array(found, float).reshape(-1, 3).T
    return spent, objective, bandwidth


def cost_figure(methods: Sequence[Method]) -> c.Figure:
    """Least J and its bandwidth against true syntheses, every method on the same axes."""
    curves_J, curves_b = [], []
    for i, method in enumerate(methods):
        spent, objective, bandwidth = best_so_far(method)
        if not spent.size:
            continue
        label, colour = LABELS[method.name], CYCLE[i % len(CYCLE)]
        marker = "o" if spent.size < 3 else ""
        curves_J.append(c.Curve(*_steps(spent, objective), label, colour, marker=marker))
        curves_b.append(c.Curve(*_steps(spent, bandwidth), "", colour, marker=marker))
    x = "true syntheses spent (–)"
    rows = (
        (c.Panel(x, "least J so far (–)", tuple(curves_J), log_x=True),),
        (c.Panel(x, "its bandwidth (Hz)", tuple(curves_b), log_x=True),),
    )
    title = "Objective and bandwidth against the number of true syntheses"
    lines = c.Lines(rows, title, (3.6, 2.6))
    return c.Figure(lines, "Further left is cheaper, lower is better.", (_cost_table(methods),))


def _steps(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A staircase: a value holds until the next one is found."""
    return np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]


def _cost_table(methods: Sequence[Method]) -> c.Table:
    """Every improvement of every method."""
    rows = (
        (LABELS[method.name], int(spent), float(objective), float(bandwidth))
        for method in methods
        for spent, objective, bandwidth in zip(*best_so_far(method), strict=True)
    )
    return c.Table(("method", "syntheses", "least J", "bandwidth (Hz)"), tuple(rows))


def theta_paths(methods: Sequence[Method]) -> tuple[c.ThetaPath, ...]:
    """The way over the two parameters of each method that is no formulation, in the colour that it
    has in the figure of the cost."""
    return tuple(
        c.ThetaPath(LABELS[method.name], np.array(method.path), CYCLE[i % len(CYCLE)])
        for i, method in enumerate(methods)
        if method.path and method.solution is None
    )
