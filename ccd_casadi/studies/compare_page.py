"""What a comparison says: conclusions, compare.json, and report.html with the paper beside."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.cases.case import case_to_toml
from ccd_casadi.codesign.verdict import State
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import CYCLE, axis_label
from ccd_casadi.inner_problem.kinds import design_view
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.reporting.concerns import lines_of, worst_state
from ccd_casadi.reporting.decision import decide
from ccd_casadi.reporting.facts import cost_label, theta_axes
from ccd_casadi.reporting.gain_figures import figure_gains
from ccd_casadi.reporting.landscape import bandwidth_process, landscape_data, read_truths
from ccd_casadi.reporting.solve_page import stage_chapters
from ccd_casadi.studies.comparison import Comparison, Method
from ccd_casadi.studies.steepest_descent import baseline_of, run_entry
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.text import HZ, number, package_text, plural, versions

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
    """Describe for which errors of resonances a loop is stable, in %; what is not known is a
    dash."""
    shift = figures.get("verdict", {}).get("survives", {}).get("stable_shift")
    return "–" if not shift else f"{100.0 * shift[0]:+.2g} to {100.0 * shift[1]:+.2g} %"


def _beside(figures: dict[str, Any]) -> str:
    """The global check over the box that every formulation ends with, and no descent."""
    beside = figures["syntheses"] - figures["syntheses_to_optimum"]
    return f", and {beside} in the global check over the box" if beside else ""


def _descent(
    problem: CoDesignProblem, run: dict[str, Any], best: dict[str, Any], name: str, equal: float
) -> tuple[dict[str, Any], list[str]]:
    """Describe how far a descent ends from the best, and what stopped it."""
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
        f"S{LABELS[name][1:]} (best of {plural(run['runs'], 'run')}) ends at J = "
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
        run_entry(run)
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
    cost = cost_label(problem, "cost f")
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
