"""The run report: one self-contained `report.html` about a finished run."""

from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.cases.sections import Case
from ccd_casadi.cases.toml_writer import case_to_toml
from ccd_casadi.codesign.surrogate_quality import recommendation
from ccd_casadi.codesign.verified_mixed import VerifiedDesign
from ccd_casadi.codesign.verified_sections import VerifiedSections
from ccd_casadi.deployment.channels import split
from ccd_casadi.inner_problem.design_loops import design_loops
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant
from ccd_casadi.reporting.bode import caption_bode, figure_bode, table_bode
from ccd_casadi.reporting.budget_section import budget_section
from ccd_casadi.reporting.facts import binding, design_facts, theta_table, theta_words
from ccd_casadi.reporting.glance import glance
from ccd_casadi.reporting.history import (
    caption_history,
    figure_history,
    history_data,
    table_history,
)
from ccd_casadi.reporting.index import write_index
from ccd_casadi.reporting.inner_sweep import caption_sweep, sweep_data, table_sweep
from ccd_casadi.reporting.landscape import (
    caption_disagreement,
    caption_landscape,
    landscape_data,
    tables_landscape,
)
from ccd_casadi.reporting.limits import limit_sentences, table_limits
from ccd_casadi.reporting.loops import gains_html, view_of
from ccd_casadi.reporting.maps import ThetaPath, figure_landscape, figure_sweep
from ccd_casadi.reporting.mode_shapes import SHOWN, mode_shape_figure
from ccd_casadi.reporting.moves import MovePanels, force_step_html, move_html, move_panels
from ccd_casadi.reporting.page import (
    Section,
    Table,
    escape,
    facts_html,
    figure_html,
    page,
    paragraph,
    preformatted,
    table_html,
)
from ccd_casadi.reporting.sections_page import (
    bandwidths_html,
    beside_html,
    binding_words,
    conclusion_of,
    controller_html,
    sections_facts,
)
from ccd_casadi.reporting.slices import (
    caption_slices,
    figure_slices,
    slices_data,
    tables_slices,
)
from ccd_casadi.reporting.start import start_section
from ccd_casadi.reporting.true_samples import Truths, read_truths
from ccd_casadi.reporting.trust import caption_trust, data_trust, figure_trust, table_trust
from ccd_casadi.reporting.verdict import run_header
from ccd_casadi.support.progress import Progress
from ccd_casadi.support.units import HZ
from ccd_casadi.support.worker_process import Ahead, WorkerLost
from surrogates.files import write_whole

if TYPE_CHECKING:  # solve imports this module
    from ccd_casadi.codesign.solution import Solution

ORDER = (
    "glance", "design", "controller", "beside", "start", "theta", "stage", "loop", "move", "force",
    "budget", "history", "trust", "sweep",
)  # fmt: skip
ELSEWHERE = ("theta", "trust")  # neither asks the plant: a process of its own solves none anew


def write_report(
    folder: Path,
    case: Case,
    problem: CoDesignProblem,
    solution: "Solution",
    *,
    quiet: bool = True,
    helper: Ahead | None = None,
) -> Path:
    """Write `folder`/report.html, atomically; reads the folder's samples.sqlite."""
    path = folder / "report.html"
    write_whole(path, report_html(folder, case, problem, solution, quiet=quiet, helper=helper))
    write_index(folder)
    return path


def report_html(
    folder: Path,
    case: Case,
    problem: CoDesignProblem,
    solution: "Solution",
    *,
    quiet: bool = True,
    helper: Ahead | None = None,
) -> str:
    """The report's text; the bar counts its sections. A `helper` draws about half of them."""
    result = solution.result
    # what `ccd new` makes is named by its folder
    named = case.path.absolute().parent.name if case.path.stem == "case" else case.path.stem
    title = f"Co-design of {named}"
    now = datetime.now().strftime("%Y-%m-%d %H:%M")
    head = run_header(
        title,
        result,
        f"{case.path.name} · {result['formulation']} formulation · {now}",
        conclusion_of(result),
    )
    work = (folder, case, problem, solution)
    parts = _parts(*work)
    drawn: dict[str, list[Section]] = {}
    with Progress(len(parts), "drawing the report", quiet) as bar:
        if helper is not None:
            helper.begin(drawn_elsewhere, work)
        for name, part in parts.items():
            if helper is None or name not in ELSEWHERE:
                drawn[name] = part()
                bar.advance()
        if helper is not None:
            try:
                drawn |= helper.result()
            except WorkerLost:  # then here
                drawn |= drawn_elsewhere(work)
            bar.advance(sum(name in parts for name in ELSEWHERE))
    sections = [section for name in parts for section in drawn[name]]
    return page(title, [*sections, _provenance(case, solution)], head)


def ready() -> None:
    """Import what drawing takes, before there is anything to draw."""
    import matplotlib.backends.backend_svg
    import matplotlib.figure  # noqa: F401


def drawn_elsewhere(
    work: tuple[Path, Case, CoDesignProblem, "Solution"],
) -> dict[str, list[Section]]:
    """The sections `ELSEWHERE`, which take about half of the time."""
    return {name: part() for name, part in _parts(*work).items() if name in ELSEWHERE}


def _parts(
    folder: Path, case: Case, problem: CoDesignProblem, solution: "Solution"
) -> dict[str, Callable[[], list[Section]]]:
    """What draws the sections, in their order."""
    verified, result = solution.verified, solution.result
    if verified is None:
        return {}
    theta, K, own = verified.theta, verified.controller, verified.problem
    hz = verified.bandwidth / HZ
    view = cache(partial(view_of, verified))

    @cache
    def move() -> MovePanels:
        return move_panels(own, theta, K, design_loops(own, theta, K), hz)

    parts = {
        "glance": lambda: [glance(own, theta, view(), move())],
        "design": lambda: [_design(problem, result)],
        "move": lambda: [Section("A move", move_html(move()))],
        "force": lambda: [
            Section("A step of force", force_step_html(design_loops(own, theta, K), hz))
        ],
        "stage": lambda: stage_sections(problem, {"start": problem.start, "optimum": theta}),
        "budget": lambda: budget_section(own, theta, K),
    }
    if isinstance(verified, VerifiedSections):
        parts |= {
            "controller": lambda: [Section("The controller", controller_html(result))],
            "beside": lambda: [Section("Full order beside it", beside_html(problem, result))],
            "loop": lambda: [Section(
                "Closed loop on every plant", bandwidths_html(verified) + gains_html(view())
            )],
        }
    elif isinstance(verified, VerifiedDesign):
        truths = read_truths(folder / "samples.sqlite", problem)
        parts |= {
            "start": lambda: start_section(problem, verified),
            "theta": lambda: [_theta(problem, solution, verified, truths)],
            "loop": lambda: _loop(verified, view()),
            "history": lambda: [_history(case, problem, solution, verified)],
            "trust": lambda: _trust(solution),
            "sweep": lambda: [_sweep(problem, solution, verified, truths)],
        }
    return {name: parts[name] for name in ORDER if name in parts}


def _design(problem: CoDesignProblem, result: dict[str, Any]) -> Section:
    words, facts = (binding_words, sections_facts) if "proof" in result else (binding, design_facts)
    binds = words(problem, result)
    items = "".join(f"<li>{escape(words)}</li>" for words in binds)
    what = f"<ul>{items}</ul>" if binds else paragraph("Nothing binds: an interior optimum.")
    body = (
        table_html(theta_table(problem, result))
        + facts_html(facts(problem, result))
        + f"\n<h3>What binds</h3>\n{what}"
        + "".join(paragraph(f"Note: {words}.") for words in result.get("notes", ()))
    )
    return Section("The design", body)


def _theta(
    problem: CoDesignProblem, solution: "Solution", verified: "VerifiedDesign", truths: Truths
) -> Section:
    outcome = solution.outcome
    processes, iterates = outcome.surrogates, outcome.iterates
    best = float(solution.result["bandwidth_hz"])
    missed = solution.quality[0].missed if solution.quality else None
    extra = caption_disagreement(problem, processes, truths, verified.theta, missed)
    if len(problem.names) == 2:
        radius = iterates[-1].radius if iterates else 1.0
        land = landscape_data(problem, processes, truths, radius, verified.theta)
        path = np.array([item.theta for item in iterates]).reshape(-1, 2)
        paths = [ThetaPath("iterates", path, numbered=True)] if len(path) else []
        svg = figure_landscape(land, paths, (verified.theta[0], verified.theta[1]))
        error_hz = 0.0 if missed is None else abs(missed.error)
        lifted = len(processes) > 1
        caption = caption_landscape(land, best, lifted=lifted, error_hz=error_hz) + extra
        tables = tables_landscape(land)
        return Section("Bandwidth over the hardware", figure_html(svg, caption, *tables))
    slices = slices_data(problem, processes, truths, verified.theta)
    if not any(len(s.near) or np.isfinite(s.bandwidth_hz).any() for s in slices):
        words = "There is no surrogate, and no design near the optimum to show in its place."
        return Section("Bandwidth over the hardware", paragraph(words))
    svg = figure_slices(slices, best)
    caption = caption_slices(slices, best, lifted=len(processes) > 1) + extra
    return Section("Bandwidth over the hardware", figure_html(svg, caption, *tables_slices(slices)))


def stage_sections(
    problem: CoDesignProblem, thetas: Mapping[str, Sequence[float]]
) -> list[Section]:
    """The plant's drawing and its mode shapes at the last of `thetas`, where it has them."""
    plant, found = plant_of(problem), []
    if plant.drawing is not None and thetas:
        drawn = plant.drawing(thetas)
        figure = figure_html(drawn.svg, drawn.caption, Table(drawn.head, drawn.rows))
        found.append(Section("The stage, before and after", figure))
    if plant.shapes is not None and thetas:
        name, theta = list(thetas.items())[-1]
        figure = mode_shape_figure(plant.shapes(theta, SHOWN))
        found.append(Section(f"Mode shapes: {name}", figure))
    return found


def _loop(verified: VerifiedDesign, loop: LoopView) -> list[Section]:
    limits = "\n".join(paragraph(words) for words in limit_sentences(loop))
    channels = split(scaled_plant(verified.problem, verified.theta), verified.controller)
    bode = figure_html(figure_bode(loop, channels), caption_bode(loop, channels), table_bode(loop))
    return [
        Section("Closed loop: S, KS and T against their bounds", gains_html(loop)),
        Section("What limits the bandwidth", limits + table_html(table_limits(loop))),
        Section("Plant and controller", bode),
    ]


def _history(
    case: Case, problem: CoDesignProblem, solution: "Solution", verified: "VerifiedDesign"
) -> Section:
    heading = "Prediction against truth"
    outcome, result = solution.outcome, solution.result
    if not outcome.iterates:
        words = (
            "There are no rounds to show: "
            + ("IPOPT worked on the true quantities, nothing was predicted."
               if result["formulation"] == "direct" else (result["reason"] or "none was run."))
        )  # fmt: skip
        return Section(heading, paragraph(words))
    history = history_data(
        outcome.iterates,
        theta=verified.theta,
        predicted_hz=result["surrogate_bandwidth_hz"],
        true_hz=result["bandwidth_hz"],
        objective=result["objective"],
        w2=problem.w2,
        tolerance=case.outer.tolerance,
    )
    caption = caption_history(history, lifted=len(outcome.surrogates) > 1)
    table = table_history(history, problem.names)
    return Section(heading, figure_html(figure_history(history), caption, table))


def _trust(solution: "Solution") -> list[Section]:
    """Nothing where nothing was predicted."""
    qualities = solution.quality
    if not qualities:
        return []
    words = paragraph(recommendation(qualities))
    figure = figure_html(figure_trust(qualities), caption_trust(qualities), *data_trust(qualities))
    return [
        Section(
            "Can the surrogate be trusted?", words + table_html(table_trust(qualities)) + figure
        )
    ]


def _sweep(
    problem: CoDesignProblem, solution: "Solution", verified: "VerifiedDesign", truths: Truths
) -> Section:
    heading = "The inner problem at the optimum"
    result = solution.result
    optimum = (result["omega_S_hz"], result["omega_T_hz"], result["bandwidth_hz"])
    processes = solution.outcome.surrogates
    sweep = sweep_data(problem, processes, truths, verified.theta, optimum)
    if sweep is None:
        words = f"Too few syntheses at {theta_words(result)} to draw the inner problem there."
        return Section(heading, paragraph(words))
    bounds = {name: bound for name, (_, bound) in problem.inner.bounds.items()}
    caption = caption_sweep(sweep, bounds)
    return Section(heading, figure_html(figure_sweep(sweep), caption, table_sweep(sweep)))


def _provenance(case: Case, solution: "Solution") -> Section:
    result = solution.result
    rows = [("seed", str(result["seed"])), *result["versions"].items()]
    versions = table_html(Table(("what", "version"), tuple((a, str(b)) for a, b in rows)))
    body = (
        f"<h3>Seed and versions</h3>\n{versions}\n"
        f"<h3>The resolved case file</h3>\n{preformatted(case_to_toml(case))}"
    )
    return Section("Provenance", body, own_page=True)
