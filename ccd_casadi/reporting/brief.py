"""The brief: one A4 page about a finished run for somebody who decides, and saw nothing else of it.

Decision, hardware and figures before and after, the requirements as bars, the machine, |S| of the
loop, what limits it, what happens if the model is wrong, and the risks. All figures are those of
`result.json`; nothing is designed.
"""

import math
import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from markupsafe import Markup

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.verdict import State
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.charts import panel_html
from ccd_casadi.drawing.paint import CSS, block_html, typeset
from ccd_casadi.inner_problem.controller_problem import FIGURES
from ccd_casadi.inner_problem.problem import CoDesignProblem, free_modal, plant_of
from ccd_casadi.plants.plant import hardware_cost, mechanics
from ccd_casadi.reporting.concerns import lines_of, percent_words, risks, what_if
from ccd_casadi.reporting.decision import Build, Decision, decide
from ccd_casadi.reporting.facts import (
    binding,
    change_words,
    cost_words,
    requirement_place,
    requirement_words,
    run_name,
    theta_words,
)
from ccd_casadi.reporting.gain_figures import S_panel, run_view
from ccd_casadi.reporting.limit_figures import binding_words
from ccd_casadi.reporting.machine import find_lumped, loci, lumped_svg
from ccd_casadi.reporting.nyquist import nyquist_panel
from ccd_casadi.support.text import HZ, display_unit, number, template, with_unit
from surrogates.files import write_whole

_change = partial(change_words, digits=1, none="unchanged")
NAME = "brief.html"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge")


@dataclass(frozen=True)
class BriefOptions:
    """Numbers of the brief."""

    limits: int = 3  # at most
    risks: int = 3  # at most
    requirements: int = 7  # at most, those with the least left
    shift: float = 0.03  # of all resonances, relative: "3 % lower"
    gain: float = 0.1  # of the whole plant, relative
    resonances: int = 3  # that are compared before and after
    height: float = 2.9  # of |S|, inches
    print_seconds: float = 60.0  # for a browser to write the PDF


@dataclass(frozen=True)
class BeforeAfter:
    """A row of the comparison, in words; `change` is empty where there is none to state."""

    name: str
    before: str
    after: str
    change: str


@dataclass(frozen=True)
class Bar:
    """A requirement: what share of it is used, 1 at its limit; nan where that is not known."""

    name: str
    required: str
    achieved: str
    used: float
    margin: str
    where: str
    evidence: str


def write_brief(run: FinishedRun, options: BriefOptions = BriefOptions()) -> list[Path]:
    """Write brief.html of a run, and brief.pdf where a Chromium is on the PATH to print it.

    Parameters
    ----------
    run : FinishedRun
    options : BriefOptions

    Returns
    -------
    list of Path
        What was written.
    """
    page = run.folder / NAME
    write_whole(page, brief_html(run, options))
    pdf = page.with_suffix(".pdf")
    return [page, *([pdf] if _print_page(page, pdf, options) else [])]


def brief_html(run: FinishedRun, options: BriefOptions = BriefOptions()) -> str:
    """The page as a document of its own, without scripts or requests."""
    result, problem = run.result, run.problem
    decided = decide(result)
    first = replace(decided, steps=())  # which end the page
    decision, also = first.words or "Not judged.", first.also
    clear = decided.build is Build.YES and not decided.condition
    colour = "bad" if decided.refuses else "good" if clear else "warn"
    view = run_view(run)
    panel = panel_html(S_panel(view), 2, options.height, "S", "|S| of the loop")
    names = ("the model", "the others") if view.scalar else ("an eigenvalue of L", "the others")
    locus = nyquist_panel(view.hz, loci(view), problem.inner.S_max, options.height, names)
    machine = machines(run)
    return template("drawing/assets/brief.html", typeset=typeset).render(
        css=Markup(CSS), name=run_name(run.case.path), decision=decision, colour=colour,
        lead=_lead(run), rows=list(before_and_after(run, options)),
        bars=nearest(list(bars(result)), options.requirements), machine=machine, S=Markup(panel),
        L=None if machine else Markup(panel_html(locus, 2, options.height, "L", "L of the loop")),
        limits=_limits(problem, result)[: options.limits],
        ifs=list(what_if(result, options.shift, options.gain)),
        risks=risks(result)[: options.risks],
        notes=(*([f"Also: {' '.join(also)}"] if also else []), _checks(result),
               f"Next: {_next(decided, result)}.", evidence(result), _reproduce(run)),
    )  # fmt: skip


def _lead(run: FinishedRun) -> str:
    """Describe what was chosen and what it reaches, in words that need no other page."""
    result = run.result
    count = result.get("judge", {}).get("plants", 1)
    plants = "on its model" if count == 1 else f"on every one of {count} plants checked of its set"
    theta = theta_words({k: v for k, v in result.items() if k != "varies"})
    varies = theta_words({**result, "theta": {}, "fixed": {}})
    over = f", {varies}" if varies else ""
    reached = f"The loop has a bandwidth of {number(result['bandwidth_hz'], 4)} Hz {plants}{over}"
    started = "This is the start's hardware: none better was found. " if _as_started(run) else ""
    return f"Chosen: {theta}. {started}{reached}; the hardware costs {cost_words(result, 4)}."


def before_and_after(run: FinishedRun, options: BriefOptions) -> Iterator[BeforeAfter]:
    """Hardware, cost, figure of the objective and first resonances at the start and the optimum."""
    result, problem = run.result, run.problem
    started = result.get("start") or {}
    for name, unit, before_value in zip(problem.names, problem.units, problem.start, strict=True):
        value = result["theta"][name]
        shown, factor = display_unit(unit, max(abs(value), abs(before_value)))
        before, after = (f"{number(factor * v)} {shown}".strip() for v in (before_value, value))
        yield BeforeAfter(name, before, after, _change(before_value, value))
    for name, value in result.get("fixed", {}).items():
        words = with_unit(value, problem.parameter_units[name], 5).strip()
        chosen = name in result.get("listed", {}).get("values", {})
        yield BeforeAfter(name, "from a list" if chosen else words, words, "")
    cost = hardware_cost(plant_of(problem), problem.start)  # of what a list holds now
    before = cost_words({**result, "hardware_cost": cost})
    yield BeforeAfter("hardware cost", before, cost_words(result),
                      _change(cost, result["hardware_cost"]))  # fmt: skip
    first, last = started.get("bandwidth_hz"), result["bandwidth_hz"]
    found = "not searched" if first is None else f"{number(first, 4)} Hz"
    yield BeforeAfter("bandwidth of the best loop", found, f"{number(last, 4)} Hz",
                      _change(first, last))  # fmt: skip
    pairs = [_resonances(problem, theta) for theta in (problem.start, run.theta)]
    for i, (one, other) in enumerate(zip(*pairs, strict=False), 1):
        if i <= options.resonances:
            before, after = (f"{number(hz, 4)} Hz" for hz in (one, other))
            yield BeforeAfter(f"resonance {i}", before, after, _change(one, other))


def _as_started(run: FinishedRun) -> bool:
    """Whether no better hardware was found than that of the start."""
    pairs = zip(run.problem.start, run.theta, strict=True)
    listed = run.result.get("listed", {}).get("values", {})
    return not listed and all(abs(end - begin) < 5e-4 * abs(begin) for begin, end in pairs)


def _resonances(problem: CoDesignProblem, theta: tuple[float, ...]) -> list[float]:
    modal = free_modal(problem, mechanics(plant_of(problem), theta, derivatives=False))
    return [float(hz) for hz in sorted(modal.natural[~modal.rigid & ~modal.driven_away] / HZ)]


def bars(result: Mapping[str, Any]) -> Iterator[Bar]:
    """Every requirement with the share of it that is used."""
    for one in result.get("requirements", ()):
        margin = one["margin"]
        yield Bar(
            one["name"], *requirement_words(one, digits=4),
            float("nan") if margin is None else 1.0 - margin,
            "not known" if margin is None else f"{percent_words(margin, 1)} %",
            requirement_place(one), one["evidence"],
        )  # fmt: skip


def nearest(found: list[Bar], most: int) -> list[Bar]:
    """Select those with the least left, in their order; one that is not known counts as missed."""
    used = [-math.inf if math.isnan(bar.used) else -bar.used for bar in found]
    kept = sorted(sorted(range(len(found)), key=lambda i: used[i])[:most])
    return [found[i] for i in kept]


def _limits(problem: CoDesignProblem, result: Mapping[str, Any]) -> list[str]:
    binds = (binding_words if "proof" in result else binding)(problem, result)
    return binds or ["Nothing binds: an interior optimum."]


def evidence(result: Mapping[str, Any]) -> str:
    """Describe who judged a design, and which of its requirements are proven."""
    judge = result.get("judge", {})
    second = result.get("second_engine", {}).get("words", "")
    several = judge.get("passed") and judge.get("plants", 1) > 1
    of_set = " checked of its set" if several else ""
    judged = f"{judge.get('words', '')}{of_set}"
    words = [f"An independent judge (NumPy, on the matrices as written): {judged}"]
    required = result.get("requirements", ())
    proven = [one["name"] for one in required if one["evidence"] == "proven"]
    if proven:
        names = result.get("proof", {}).get("parameters", ())
        over = f"the whole [robust] set ({', '.join(names)})" if names else "these plants alone"
        words.append(f"Proven for {over}: {', '.join(proven)}")
    return ". ".join(filter(None, (*words, second))) + "."


def _checks(result: Mapping[str, Any]) -> str:
    """The states of the verdict's lines: what was not checked is named, never left out."""
    found = []
    for line in lines_of(result):
        unknown = line.state == State.UNKNOWN
        found.append(f"{line.name} {f'UNKNOWN ({line.words})' if unknown else line.state}")
    return f"Checks: {'; '.join(found) or 'none'}."


def _next(decided: Decision, result: Mapping[str, Any]) -> str:
    """Describe what to do after reading this page."""
    deployed = "order" in result.get("verdict", {}).get("deployable", {})
    build = (
        [] if deployed or decided.refuses else ["ccd deploy, which writes the controller's code"]
    )
    return "; ".join([*decided.steps, *build]) or "put the controller on the machine"


def _reproduce(run: FinishedRun) -> str:
    """Describe which version made this, of what, and the command that makes it again."""
    result, value = run.result, FIGURES[run.result.get("minimise", "bandwidth")]
    versions, sampling = result.get("versions", {}), run.problem.sampling
    order = result.get("controller", {}).get("order")
    words = [f"J = {number(result['objective'], 5)} of cost and {value.words}"]
    if order is not None:
        words.append(f"controller of order {order}")
    if sampling is not None:
        late = with_unit(sampling.delay, "s")
        words.append(f"judged at {number(sampling.rate_hz)} Hz with a delay of {late}")
    command = f"ccd solve {run.case.path.name} --seed {result['seed']}"
    if result.get("formulation"):
        command += f" --formulation {result['formulation']}"
    made = f"ccd-casadi {versions.get('ccd-casadi', '')}, Python {versions.get('python', '')}"
    again = f"To reproduce it: {command}, in this run's folder, with {made}."
    if (result.get("time_budget") or {}).get("ended"):
        again += " Its budget of time ended the search: a faster machine may end elsewhere."
    return f"{', '.join(words)}. {again}"


def machines(run: FinishedRun) -> list[tuple[str, Markup]]:
    """The machine before and after at one scale: its drawing, its masses and springs, or none."""
    problem, plant = run.problem, plant_of(run.problem)
    thetas = {"before": problem.start, "after": run.theta}
    if _as_started(run):
        thetas = {"the design, as at the start": run.theta}
    if plant.drawing is not None:
        block = plant.drawing(thetas)
        drawn = block.drawing if isinstance(block, c.Figure) else block
        return [(" and ".join(thetas), block_html(drawn, "machine"))]
    systems = {name: mechanics(plant, theta, derivatives=False) for name, theta in thetas.items()}
    found = {name: find_lumped(system) for name, system in systems.items()}
    if any(one is None for one in found.values()):
        return []
    most = max(float(abs(one.masses).max()) for one in found.values() if one is not None)
    return [
        (
            name,
            block_html(c.Picture(lumped_svg(one, free_modal(problem, systems[name]), most)), name),
        )
        for name, one in found.items()
        if one is not None
    ]


def _print_page(page: Path, pdf: Path, options: BriefOptions) -> bool:
    """Whether a browser has printed the page."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        return False
    rights = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    pdf.unlink(missing_ok=True)
    words = ["--headless", *rights, "--disable-gpu", "--no-pdf-header-footer",
             f"--print-to-pdf={pdf}", page.resolve().as_uri()]  # fmt: skip
    try:
        subprocess.run([browser, *words], capture_output=True, timeout=options.print_seconds)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return pdf.exists()
