"""insight.html: the trade-off around a design, and what it answers to."""

from pathlib import Path

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.insight import bandwidth_of, natural_hz
from ccd_casadi.codesign.pareto import Front
from ccd_casadi.codesign.post_optimal import PostOptimal
from ccd_casadi.codesign.verdict import State
from ccd_casadi.drawing.page import (
    Section,
    escape,
    figure_html,
    header,
    number,
    page,
    paragraph,
    table_html,
)
from ccd_casadi.inner_problem.design_loops import design_view
from ccd_casadi.reporting.facts import cost_words, theta_words
from ccd_casadi.reporting.front_walk import front_walk
from ccd_casadi.reporting.index import index_of, write_index
from ccd_casadi.reporting.insight import (
    caption_front,
    figure_front,
    response_sentences,
    rule_sentence,
    table_front,
    table_responses,
)
from ccd_casadi.reporting.limits import limit_sentences, table_limits
from ccd_casadi.reporting.sections_page import binding_words
from ccd_casadi.reporting.verdict import verdict_html, worst
from ccd_casadi.support.units import HZ
from surrogates.files import write_whole


def write_insight(folder: Path, run: FinishedRun, front: Front, responses: PostOptimal) -> Path:
    """Write insight.html, atomically."""
    path = folder / "insight.html"
    write_whole(path, insight_html(run, front, responses, index_of(folder)))
    write_index(folder)
    return path


def insight_html(run: FinishedRun, front: Front, responses: PostOptimal, index: str = "") -> str:
    """The page's text; `index`: the page that it links as that of the whole run."""
    problem = run.problem
    bandwidth_hz = bandwidth_of(run) / HZ
    cost = float(run.result["hardware_cost"])
    rule = rule_sentence(bandwidth_hz, natural_hz(run))
    verified = sum(point.verified for point in front.points)
    whole = verified == len(front.points)
    title = f"Insight: {run.case.path.parent.name}"
    head = header(
        title,
        whole,
        "verified" if whole else "not all verified",
        f"{verified} of {len(front.points)} points of the front",
        f"around the design of {run.folder.name}/result.json",
        f"The design, {theta_words(run.result)}, has {number(bandwidth_hz)} Hz at a hardware cost "
        f"of {cost_words(run.result)}. {rule}",
        warned=worst(run.result) is not State.PASSED,
        verdict=verdict_html(run.result),
    )
    drawn = figure_front(problem, front, (cost, bandwidth_hz, "this run's design"))
    words = "\n".join(paragraph(text) for text in response_sentences(responses))
    sections = [
        Section(
            "Weight against bandwidth",
            figure_html(drawn, caption_front(front), table_front(problem, front))
            + front_walk(run, front),
        ),
        Section(
            "What each parameter of the case would change",
            words + table_html(table_responses(problem, responses)),
        ),
        Section("What limits the bandwidth", _limits(run, rule)),
    ]
    return page(title, sections, head, index)


def _limits(run: FinishedRun, rule: str) -> str:
    """The shares of γ; of a fixed structure, which has no γ, the bounds that hold it."""
    if run.result.get("gamma") is None:
        held = binding_words(run.problem, run.result)
        without = (
            "A fixed structure has no γ, and no weights' frequencies to move: what holds ω_b are "
            "the bounds above."
        )
        items = "".join(f"<li>{escape(text)}</li>" for text in held)
        return f"<ul>{items}</ul>" + paragraph(without) + paragraph(rule)
    loop = design_view(
        run.problem, run.theta, run.controller, weights=run.weights, gamma=run.figures.gamma,
        bandwidth_hz=run.figures.bandwidth / HZ,
    )  # fmt: skip
    limits = "\n".join(paragraph(text) for text in (*limit_sentences(loop), rule))
    return limits + table_html(table_limits(loop))
