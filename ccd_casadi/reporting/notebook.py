"""Results, designs and problems as a notebook shows them: the parts of our pages, one at a time,
and what a run has computed as a table of pandas.
"""

from collections.abc import Mapping
from dataclasses import asdict
from functools import singledispatch
from itertools import count
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.drawing.content import Block, Facts, Head, Heading, Table, Words
from ccd_casadi.drawing.paint import CSS, block_html
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_words import sections_dict
from ccd_casadi.inner_problem.sweep import InnerResult
from ccd_casadi.reporting.facts import conclusion, facts, theta_axes, theta_table
from ccd_casadi.reporting.gain_figures import gains, run_view, view_of
from ccd_casadi.reporting.limit_figures import controller_blocks
from ccd_casadi.reporting.run_verdict import run_head
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.sampling.units import problem_hash
from ccd_casadi.support.errors import require
from ccd_casadi.support.text import HZ, number, template
from ccd_casadi.synthesis.derivatives import Sensitivities
from ccd_casadi.synthesis.synthesis import Design, DesignFigures

if TYPE_CHECKING:
    import pandas


_figures = count()  # ids in an SVG are the whole notebook's


@singledispatch
def html_of(item: object) -> str:
    """Write an object as HTML for a notebook's cell, with its style confined to the cell.

    Parameters
    ----------
    item : object

    Returns
    -------
    str

    Raises
    ------
    TypeError
        Its type has no form in a notebook.
    """
    raise TypeError(f"{type(item).__name__} has no form in a notebook")


def _cell(*parts: Head | Block) -> str:
    body = Markup("\n").join(block_html(part, f"nb{next(_figures)}") for part in parts)
    return template("drawing/assets/cell.html").render(css=CSS, body=body)


@html_of.register
def _(item: Solution) -> str:
    result, own = item.result, item.verified
    if own is None:
        return _cell(_result_head(result))
    return _cell(*_design_parts(own.problem, result, view_of(own)))


@html_of.register
def _(item: FinishedRun) -> str:
    return _cell(*_design_parts(item.problem, item.result, run_view(item)))


@html_of.register
def _(item: Case) -> str:
    return html_of(problem_of(item))


@html_of.register
def _(item: CoDesignProblem) -> str:
    rows = []
    for i, (name, unit, factor) in enumerate(theta_axes(item)):
        numbers = (factor * value for value in (item.lower[i], item.upper[i], item.start[i]))
        rows.append((name, unit or "–", *numbers))
    name = item.source.name
    table = Table(("θ", "unit", "lower", "upper", "start"), tuple(rows))
    found = facts("problem", item, *kind_of(item).describe())
    return _cell(Heading(f"A co-design problem: {name}"), table, Facts(tuple(found)))


@html_of.register
def _(item: InnerResult) -> str:
    if item.optimum is None:
        words = f"{item.shortfall}; {item.syntheses} syntheses"
        return _cell(Head("The inner problem", "bad", "infeasible", "", "", words))
    binds = ", ".join(item.active) or "nothing"
    words = f"The largest bandwidth of {item.syntheses} syntheses; {binds} binds."
    return _cell(*_design("The inner problem", item.optimum.figures, words))


@html_of.register
def _(item: Sensitivities) -> str:
    return _cell(*_design("One synthesis, with derivatives", item.figures))


@html_of.register
def _(item: Design) -> str:
    order = f"A controller of {len(item.controller.A)} states."
    return _cell(*_design("One synthesis", item.figures, order))


@html_of.register
def _(item: SectionsDesign) -> str:
    title, outcome = "A controller of fixed structure", item.outcome.name.lower()
    spent = f"{item.starts} starts, {number(item.seconds, 2)} s"
    head = Head(title, "good" if item.certified else "bad", outcome, item.words, spent, "")
    if item.controller is None:
        return _cell(head)
    found = Facts((("Bandwidth ω_b", f"{number(item.bandwidth / HZ)} Hz", "on every plant"),))
    made = {"controller": sections_dict(item.structure, item.kappa)}
    return _cell(head, found, *controller_blocks(made))


def _result_head(result: Mapping[str, Any]) -> Head:
    return run_head("Co-design", result, "", conclusion(result))


def _design_parts(
    problem: CoDesignProblem, result: Mapping[str, Any], view: LoopView
) -> list[Head | Block]:
    parts: list[Head | Block] = [_result_head(result), theta_table(problem, result)]
    if "sections" in result.get("controller", {}):
        parts += controller_blocks(result)
    return [*parts, gains(view)]


def _design(title: str, figures: DesignFigures, words: str = "") -> tuple[Head | Block, ...]:
    badge = "good" if figures.certified else "bad"
    head = Head(title, badge, figures.outcome.value, "", "", "")
    if not figures.certified:
        return head, Words(words)
    return head, Facts(tuple(facts("synthesis", figures))), Words(words)


_RATES = ("omega_S", "omega_T", "bandwidth", "sensitivity_peak_frequency")  # stored in rad/s
_LEFT_OUT = ("key", "theta", "gradients")


def samples_frame(run: FinishedRun) -> "pandas.DataFrame":
    """Every true synthesis of a run, one row each: θ in SI under its names, then the figures.

    Frequencies end in `_hz`; a figure is NaN where a synthesis ended before it was known, and
    `certified` and `reason` say which rows are designs. Of a fixed structure a row is the best
    design at its θ.

    Parameters
    ----------
    run : FinishedRun
        As `read_run` gives it.

    Returns
    -------
    pandas.DataFrame

    Raises
    ------
    MissingPackage
        pandas is not installed.
    UserError
        The folder has no usable samples.sqlite.
    """
    pandas = require("pandas", "notebook")
    with SampleStore(run.folder / "samples.sqlite") as store:
        samples = store.select(problem_hash(run.problem.identity()))
    rows = []
    for sample in samples:
        row = dict(zip(run.problem.names, sample.theta, strict=True))
        for name, value in asdict(sample).items():
            if name in _RATES:
                row[f"{name}_hz"] = value / HZ
            elif name not in _LEFT_OUT:
                row[name] = value
        rows.append(row)
    return pandas.DataFrame(rows)
