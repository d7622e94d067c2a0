"""The run report: `report.html` about a finished run."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.analysis.loop_channels import scalar_channels
from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.cases.case import case_to_toml
from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.gaussian_processes import recommendation
from ccd_casadi.codesign.outer_mixed import VerifiedDesign
from ccd_casadi.drawing import content as c
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant
from ccd_casadi.reporting.facts import (
    binding,
    conclusion,
    facts,
    margins_table,
    requirements_table,
    run_name,
    theta_table,
)
from ccd_casadi.reporting.gain_figures import gains, run_view, view_of
from ccd_casadi.reporting.landscape import (
    Truths,
    bandwidth_process,
    caption_disagreement,
    caption_landscape,
    history_blocks,
    landscape_data,
    read_truths,
    slices_figure,
    table_trust,
    trust_figure,
)
from ccd_casadi.reporting.limit_figures import (
    bandwidths_table,
    binding_words,
    budget_chapter,
    controller_blocks,
    limit_blocks,
    limits_blocks,
    start_chapter,
)
from ccd_casadi.reporting.machine import SHOWN, glance, mode_shape_figure
from ccd_casadi.reporting.moves import cycle_chapter, force_step, move_blocks_of
from ccd_casadi.reporting.nyquist import bode
from ccd_casadi.reporting.run_verdict import publish, run_head
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import Progress

if TYPE_CHECKING:  # solve imports this module
    from ccd_casadi.cases.run_folder import FinishedRun
    from ccd_casadi.codesign.verified import Solution

ORDER = (
    "glance", "design", "controller", "limits", "start", "theta", "stage", "loop", "move", "motor",
    "force", "budget", "history", "trust",
)  # fmt: skip


Part = Callable[[], list[c.Chapter]]


def write_report(
    folder: Path, case: Case, problem: CoDesignProblem, solution: "Solution",
    workers: Pool | None = None,
) -> Path:  # fmt: skip
    """Write `folder`/report.html, atomically; the folder's samples.sqlite is read.

    Parameters
    ----------
    folder : Path
    case : Case
    problem : CoDesignProblem
    solution : Solution
    workers : Pool, optional
        They draw a chapter each.

    Returns
    -------
    Path
    """
    path = folder / "report.html"
    publish(folder, path, solve_page(folder, case, problem, solution), workers)
    return path


def solve_page(folder: Path, case: Case, problem: CoDesignProblem, solution: "Solution") -> c.Page:
    """Make the page of the report; the bar counts its sections."""
    parts = _parts(folder, case, problem, solution)
    chapters: list[c.Chapter] = []
    with Progress(len(parts), "drawing the report") as bar:
        for part in parts:
            chapters += part()
            bar.advance()
    return c.Page(solve_head(case, solution.result), (*chapters, provenance(case, solution.result)))


def page_of_run(run: "FinishedRun") -> c.Page:
    """Make the report of a run that kept none, as far as its folder holds it: the design alone.

    Parameters
    ----------
    run : FinishedRun

    Returns
    -------
    Page
    """
    parts = design_parts(run.problem, run.problem, run.theta, run_view(run), run.result)
    chapters = []
    for name in (name for name in ORDER if name in parts):
        with suppress(KeyError):  # a result.json of an earlier version knows less
            chapters += parts[name]()
    words = (
        "Drawn from case.toml, controller.json and result.json alone: how the design was found was "
        "not kept."
    )
    head = solve_head(run.case, run.result)
    note = c.Chapter("About this page", (c.Words(words),))
    return c.Page(head, (*chapters, note, provenance(run.case, run.result)))


def solve_head(case: Case, result: Mapping[str, Any]) -> c.Head:
    """Make the head of the report, as of now."""
    now = datetime.now().strftime("%Y-%m-%d %H:%M")
    meta = f"{case.path.name} · {result['formulation']} formulation · {now}"
    return run_head(f"Co-design of {run_name(case.path)}", result, meta, conclusion(result))


def _parts(folder: Path, case: Case, problem: CoDesignProblem, solution: "Solution") -> list[Part]:
    """List what makes the sections, in their order."""
    verified, result = solution.verified, solution.result
    if verified is None:
        return []
    own, theta, view = verified.problem, verified.theta, view_of(verified)
    parts = design_parts(problem, own, theta, view, result)
    if "proof" in result:  # of a fixed structure
        from ccd_casadi.codesign.verified_structured import VerifiedStructured

        assert isinstance(verified, VerifiedStructured)
        table = bandwidths_table(verified)
        beside = margins_table(result, len(view.loops))
        parts["loop"] = lambda: _loop(own, theta, view, table, *beside)
    elif isinstance(verified, VerifiedDesign):
        truths = read_truths(folder / "samples.sqlite", problem)
        parts |= {
            "start": lambda: start_chapter(problem, verified),
            "theta": lambda: [_theta(problem, solution, verified, truths)],
            "history": lambda: [_history(case, problem, solution, verified)],
            "trust": lambda: _trust(solution),
        }
    return [parts[name] for name in ORDER if name in parts]


def design_parts(
    problem: CoDesignProblem, own: CoDesignProblem, theta: Sequence[float], view: LoopView,
    result: Mapping[str, Any],
) -> dict[str, Part]:  # fmt: skip
    """The chapters about a design by itself; `own`: the problem with its design plant chosen."""
    move = cache(lambda: move_blocks_of(own, theta, view))
    parts: dict[str, Part] = {
        "glance": lambda: [_required_first(result, glance(own, theta, view, move()[0]))],
        "design": lambda: [design_chapter(problem, result)],
        "move": lambda: [c.Chapter("A move", move(), folded=True)],
        "motor": lambda: cycle_chapter(own, theta, result),
        "force": lambda: [
            c.Chapter("A step of force", (force_step(own, theta, view),), folded=True)
        ],
        "stage": lambda: stage_chapters(problem, {"start": problem.start, "optimum": theta}),
        "budget": lambda: budget_chapter(own, theta, view.loop.controller),
        "loop": lambda: _loop(own, theta, view, *margins_table(result, len(view.loops))),
    }
    if "proof" in result:
        parts["controller"] = lambda: [c.Chapter("The controller", controller_blocks(result))]
    if "costs" in result:
        limits = "What limits the bandwidth"
        parts["limits"] = lambda: [c.Chapter(limits, limits_blocks(problem, result))]
    return parts


def _required_first(result: Mapping[str, Any], chapter: c.Chapter) -> c.Chapter:
    """A chapter that begins with the requirements, where the result lists them."""
    table = (requirements_table(result),) if result.get("requirements") else ()
    return replace(chapter, body=(*table, *chapter.body))


def design_chapter(problem: CoDesignProblem, result: Mapping[str, Any]) -> c.Chapter:
    """Make the chapter of the design from result.json."""
    if "proof" in result:
        rows, bound = facts("structured", problem, result), binding_words(problem, result)
    else:
        rows, bound = facts("design", problem, result), binding(problem, result)
    body = (
        theta_table(problem, result),
        c.Heading("What binds"),
        c.Bullets(tuple(bound)) if bound else c.Words("Nothing binds: an interior optimum."),
        *(c.Words(f"Note: {words}.") for words in result.get("notes", ())),
        c.FoldedBlocks("All figures of the design", (c.Facts(tuple(rows)),)),
    )
    return c.Chapter("The design", body)


def _theta(
    problem: CoDesignProblem, solution: "Solution", verified: "VerifiedDesign", truths: Truths
) -> c.Chapter:
    iterates = solution.outcome.iterates
    process = bandwidth_process(solution.outcome.surrogates)
    best = float(solution.result["bandwidth_hz"])
    extra = caption_disagreement(process, truths)
    if len(problem.names) == 2:
        radius = iterates[-1].radius if iterates else 1.0
        land = landscape_data(problem, process, truths, radius, verified.theta)
        path = np.array([item.theta for item in iterates]).reshape(-1, 2)
        paths = (c.ThetaPath("iterates", path),) if len(path) else ()
        land = replace(land, paths=paths, optimum=(verified.theta[0], verified.theta[1]))
        figure = c.Figure(land, caption_landscape(land, best) + extra)
        return c.Chapter("Bandwidth over the hardware", (figure,), folded=True)
    slices = slices_figure(problem, process, truths, verified.theta, best, extra)
    words = "There is no surrogate, and no design near the optimum to show in its place."
    return c.Chapter("Bandwidth over the hardware", (slices or c.Words(words),), folded=True)


def stage_chapters(
    problem: CoDesignProblem, thetas: Mapping[str, Sequence[float]]
) -> list[c.Chapter]:
    """Make the chapters of a plant's drawing and of its mode shapes at the last θ.

    Parameters
    ----------
    problem : CoDesignProblem
    thetas : mapping
        Name of a design -> θ (n,), SI.

    Returns
    -------
    list of Chapter
        Empty where the plant has neither.
    """
    plant, found = plant_of(problem), []
    if plant.drawing is not None and thetas:
        found.append(c.Chapter("The stage, before and after", (plant.drawing(thetas),)))
    if plant.shapes is not None and thetas:
        name, theta = list(thetas.items())[-1]
        figure = mode_shape_figure(plant.shapes(theta, SHOWN))
        found.append(c.Chapter(f"Mode shapes: {name}", (figure,), folded=True))
    return found


def _loop(
    problem: CoDesignProblem, theta: Sequence[float], loop: LoopView, *more: c.Table
) -> list[c.Chapter]:
    channels = scalar_channels(scaled_plant(problem, theta), loop.loop.controller)
    plots = c.Chapter("Loop, plant and controller", (bode(loop, channels),), folded=True)
    if loop.bounded.required:  # of a fixed structure
        return [c.Chapter("Closed loop on every plant", (*more, gains(loop))), plots]
    return [
        c.Chapter("Closed loop: S, KS and T against their bounds", (*more, gains(loop))),
        c.Chapter("What limits the bandwidth", limit_blocks(loop)),
        plots,
    ]


def _history(
    case: Case, problem: CoDesignProblem, solution: "Solution", verified: "VerifiedDesign"
) -> c.Chapter:
    heading = "Prediction against truth"
    outcome, result = solution.outcome, solution.result
    if not outcome.iterates:
        direct = result["formulation"] == "direct"
        why = "every step used true values" if direct else result["reason"] or "none was run"
        return c.Chapter(heading, (c.Words(f"There are no rounds to show: {why}."),), folded=True)
    blocks = history_blocks(
        outcome.iterates, problem, result, verified.theta, case.outer.tolerance,
        lifted=len(outcome.surrogates) > 1,
    )  # fmt: skip
    return c.Chapter(heading, blocks, folded=True)


def _trust(solution: "Solution") -> list[c.Chapter]:
    """Nothing where nothing was predicted."""
    qualities = solution.quality
    if not qualities:
        return []
    body = (c.Words(recommendation(qualities)), table_trust(qualities), trust_figure(qualities))
    return [c.Chapter("Can the surrogate be trusted?", body, folded=True)]


def provenance(case: Case, result: Mapping[str, Any]) -> c.Chapter:
    """Seed, versions, and the case file."""
    rows = [("seed", str(result["seed"])), *result["versions"].items()]
    body = (
        c.Heading("Seed and versions"),
        c.Table(("what", "version"), tuple((a, str(b)) for a, b in rows)),
        c.Heading("The case with its defaults"),
        c.Source(case_to_toml(case).replace(f"{case.path.resolve().parent}/", "")),
    )
    return c.Chapter("Provenance", body, own_page=True, folded=True)
