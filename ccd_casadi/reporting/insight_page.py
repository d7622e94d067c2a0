"""insight.html: the trade-off around a design, and what it answers to."""

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.insight import bandwidth_of, natural_hz
from ccd_casadi.codesign.pareto import Front
from ccd_casadi.codesign.post_optimal import PostOptimal
from ccd_casadi.drawing.content import Block, Bullets, Page, Section, Words
from ccd_casadi.reporting.facts import cost_words, theta_words
from ccd_casadi.reporting.front_walk import front_walk
from ccd_casadi.reporting.insight import (
    front_figure,
    response_sentences,
    rule_sentence,
    table_responses,
)
from ccd_casadi.reporting.limits import limit_blocks
from ccd_casadi.reporting.loops import run_view
from ccd_casadi.reporting.sections_page import binding_words
from ccd_casadi.reporting.verdict import head_of
from ccd_casadi.support.units import HZ, number


def insight_page(run: FinishedRun, front: Front, responses: PostOptimal, index: str = "") -> Page:
    """insight.html; `index`: the page that it links as that of the whole run."""
    problem = run.problem
    bandwidth_hz = bandwidth_of(run) / HZ
    cost = float(run.result["hardware_cost"])
    rule = rule_sentence(bandwidth_hz, natural_hz(run))
    verified = sum(point.verified for point in front.points)
    whole = verified == len(front.points)
    head = head_of(
        f"Insight: {run.case.path.parent.name}",
        whole,
        "verified" if whole else "not all verified",
        f"{verified} of {len(front.points)} points of the front",
        f"around the design of {run.folder.name}/result.json",
        f"The design, {theta_words(run.result)}, has {number(bandwidth_hz)} Hz at a hardware cost "
        f"of {cost_words(run.result)}. {rule}",
        run.result,
    )
    drawn = front_figure(problem, front, (cost, bandwidth_hz, "this run's design"))
    answers = [Words(text) for text in response_sentences(responses)]
    sections = (
        Section("Weight against bandwidth", (drawn, *front_walk(run, front))),
        Section("What each parameter of the case would change",
                (*answers, table_responses(problem, responses))),
        Section("What limits the bandwidth", _limits(run, rule)),
    )
    return Page(head, sections, index)


def _limits(run: FinishedRun, rule: str) -> tuple[Block, ...]:
    """The shares of γ; of a fixed structure, which has no γ, the bounds that hold it."""
    if run.result.get("gamma") is None:
        held = binding_words(run.problem, run.result)
        without = (
            "A fixed structure has no γ, and no weights' frequencies to move: what holds ω_b are "
            "the bounds above."
        )
        return Bullets(tuple(held)), Words(without), Words(rule)
    return limit_blocks(run_view(run), rule)
