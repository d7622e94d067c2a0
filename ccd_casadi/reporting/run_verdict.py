"""The verdict of a run as every command and page shows it, and the index of a run's folder."""

import json
import re
import sys
from collections.abc import Mapping
from html import unescape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ccd_casadi.codesign.verdict import OwnSet, State, VerdictOptions
from ccd_casadi.drawing.content import INDEX, Chapter, Head, Links, Page, VerdictRow
from ccd_casadi.drawing.paint import block_html, page_html, write_page
from ccd_casadi.reporting.decision import (
    current_concern,
    limited_move,
    limited_move_remedy,
    loop_concerns,
    resonance_condition,
)
from ccd_casadi.reporting.facts import conclusion, run_name
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import columns, wrapped
from surrogates.files import write_whole

LINES = ("certified", "optimal", "predicted", "survives", "deployable")
NEXT = {  # what to do about a line that failed, or about what the decision names
    "certified": "solve the case again",
    "optimal": "more starts or box_points in [outer]",
    "predicted": "retrain, or more points in [sampling]",
    "survives": "a [robust] set in the case",
    "wider": "a wider resonance_shift or damping in [robust]",
    "deployable": "a higher rate or less delay",
    "unproven": "a smaller [robust] set, or fewer parameters in it",
    "budget": "solve again with a larger --budget, which goes on from what is stored",
    "current": "a larger peak_current, or less jerk or acceleration in [move]",
    "loop": "a smaller S_max; with sections bandwidth_least_hz, least_damping or weighted_level",
}
STATUS = {"verified": "verified", "infeasible": "no feasible design"}  # others: not verified
BADGE = re.compile(r"<p class='standing'>.*?</p>", re.DOTALL)
DECISION = re.compile(r'<p class="decision">(?:Do not b|B)uild this\b.*?</p>', re.DOTALL)
TABLE = re.compile(r'<table class="wide verdict">.*?</table>', re.DOTALL)


def lines_of(result: Mapping[str, Any]) -> tuple[VerdictRow, ...]:
    """Read the lines of the verdict of result.json.

    Parameters
    ----------
    result : mapping

    Returns
    -------
    tuple of VerdictRow
        Empty for a run without a design, or older than verdicts.
    """
    verdict = result.get("verdict")
    if not isinstance(verdict, Mapping):
        return ()
    found = []
    for name in LINES:
        line = verdict.get(name)
        if isinstance(line, Mapping) and line.get("state") in set(State):
            found.append(VerdictRow(name, str(line["state"]), str(line.get("words", ""))))
    return tuple(found)


def worst_state(result: Mapping[str, Any]) -> State:
    """Find the worst state of a verdict: failed, then warned, then passed.

    Parameters
    ----------
    result : mapping
        Of result.json; an unknown line counts as none of them.

    Returns
    -------
    State
    """
    states = {line.state for line in lines_of(result)}
    return next((s for s in (State.FAILED, State.WARNED) if s in states), State.PASSED)


def unproven(result: Mapping[str, Any]) -> str | None:
    """Why `survives` is neither passed nor warned; None where it is one of them."""
    line = next((line for line in lines_of(result) if line.name == "survives"), None)
    if line is None or line.state != State.UNKNOWN:
        return None
    own = result["verdict"]["survives"].get("set")
    return "searched, not proven" if own == OwnSet.SEARCHED else "not known"


def terminal_lines(result: Mapping[str, Any]) -> list[str]:
    """Write the verdict for the terminal, wrapped.

    Parameters
    ----------
    result : mapping
        Of result.json.

    Returns
    -------
    list of str
    """
    lines = [f"{line.name:14s}{line.state:9s}{line.words}" for line in lines_of(result)]
    return [wrapped(line, columns(sys.stdout)) for line in lines]


def head_of(
    title: str, good: bool, status: str, reason: str, meta: str, lead: str,
    result: Mapping[str, Any], decision: str = "",
) -> Head:  # fmt: skip
    """The head of a page about a run; the badge is not green where the run's verdict warns.

    `decision`: what the page answers, where that is not whether to build the design.
    """
    clean = worst_state(result) is State.PASSED and not loop_concerns(result)
    clean &= unproven(result) is None
    badge = "bad" if not good else "good" if clean else "warn"
    decision = decision or advice(result)
    return Head(title, badge, status, reason, meta, lead, lines_of(result), decision)


def run_head(title: str, result: Mapping[str, Any], meta: str, lead: str) -> Head:
    """The head of a page that is about the run itself: badge and verdict are the run's."""
    good = result["status"] == "verified"
    failed = [line for line in lines_of(result) if line.state == State.FAILED]
    below = "; ".join(f"{line.name}: {line.words}" for line in failed)
    why = str(result.get("reason") or "").replace(f" ({below})", "")
    reason = head_words(result) if good else why
    reason = f"{reason[:1].upper()}{reason[1:].rstrip('.')}." if reason else ""
    status = STATUS.get(result["status"], "not verified")
    return head_of(title, good, status, reason, meta, lead, result)


def with_verdict_of(text: str, result: Mapping[str, Any], *, whole: bool) -> str:
    """A page with the decision and the verdict as they are now; of the run's own (`whole`) the
    badge too."""
    source = block_html(run_head("", result, "", ""))
    for place in (DECISION, TABLE, *([BADGE] if whole else [])):
        old, new = place.search(text), place.search(source)
        if old is not None and new is not None:
            text = text[: old.start()] + new[0] + text[old.end() :]
    return text


def advice(result: Mapping[str, Any]) -> str:
    """Write the decision: build this or not, and what comes next.

    Parameters
    ----------
    result : mapping
        Of result.json. Without a verdict only concerns about the loop are written.

    Returns
    -------
    str
    """
    states = {line.name: line.state for line in lines_of(result)}
    failed = [name for name, state in states.items() if state == State.FAILED]
    looked_at = loop_concerns(result)
    if not states:
        if result.get("status", "verified") != "verified":
            return "Do not run this: it is not verified. Next: see why."
        words = f"Look at the loop before you run it: {'; '.join(looked_at)}."
        lines = all("between two lines" in concern for concern in looked_at)
        after = "more lines there, or more averages" if lines else "a smaller S_max"
        after = NEXT["current"] if looked_at == current_concern(result) else after
        return f"{words} Next: {after}." if looked_at else ""
    stuck = limited_move(result)
    also = f" Besides, {stuck}." if stuck else ""
    if failed or result.get("status") != "verified":
        why = f"{' and '.join(failed)} failed" if failed else "it is not verified"
        step = _next_of_failed(failed[0], result) if failed else "see why"
        return f"Do not build this: {why}.{also} Next: {step}."
    own = result["verdict"].get("survives", {}).get("set")
    unclosed = states.get("survives") == State.WARNED and own == OwnSet.UNPROVEN
    doubts = _doubts_of_kept_set(result) if own == OwnSet.KEPT else []
    if states.get("survives") == State.WARNED and not unclosed and not doubts:
        words = "Do not build this: it does not survive small errors of its model."
        if own == OwnSet.NONE:
            words = "Do not build this yet: it was judged on the model alone."
        return f"{words}{also} Next: {NEXT['wider' if own == OwnSet.KEPT else 'survives']}."
    warned = ["the bounds are not proven on the whole [robust] set"] if unclosed else doubts
    warned += [
        f"{name} warned"
        for name, state in states.items()
        if state == State.WARNED and name != "survives"
    ]
    if states.get("survives") == State.UNKNOWN:
        if unproven(result) == "not known":
            words = "Do not build this yet: what it survives is not known."
            return f"{words}{also} Next: {NEXT['survives']}."
        warned.append(f"the [robust] set is {unproven(result)}")
    if stuck:
        return f"Do not build this yet: {stuck}. Next: {limited_move_remedy(result)}."
    condition = resonance_condition(result)
    condition = condition and f" {condition}"
    budget = result.get("time_budget", {})
    if ended := bool(budget.get("ended")):
        warned.append(f"the search was ended by its budget of {budget['minutes']:g} min")
    unjudged = states.get("deployable") == State.UNKNOWN
    if warned or looked_at:
        words = f"Build this only if you accept: {'; '.join([*warned, *looked_at])}."
        of_motor = current_concern(result)
        steps = [NEXT["unproven"]] * unclosed + [NEXT["current"]] * len(of_motor)
        steps += [NEXT["loop"]] * (len(looked_at) > len(of_motor))
        steps += [NEXT["budget"]] * ended
        after = " Deploy it first: hold and delay are not judged yet." if unjudged else ""
        return words + (f" Next: {'; '.join(steps)}." if steps else "") + after + condition
    later = " after deploy: hold and delay are not judged yet" if unjudged else ""
    return f"Build this{later}.{condition}"


def _next_of_failed(name: str, result: Mapping[str, Any]) -> str:
    """What to do about a line that failed; where a rate is not enough at this delay, the delay."""
    line = result["verdict"][name]
    rate_helps = line.get("needed_hz", 0.0) is not None
    return NEXT[name] if name != "deployable" or rate_helps else "less delay"


def _doubts_of_kept_set(result: Mapping[str, Any]) -> list[str]:
    """Why `survives` warns of a loop that keeps its [robust] set and small errors beyond it; empty
    where it does not survive the latter."""
    line = result["verdict"]["survives"]
    shift, least = line.get("stable_shift"), line.get("least_shift", 0.0)
    if shift is None or not (shift[0] <= -least and shift[1] >= least):
        return []
    damping, least_factors = line.get("stable_damping"), VerdictOptions().least_factors
    if line.get("closer_models") or damping is None:
        return []
    if not (damping[0] <= least_factors[0] and damping[1] >= least_factors[1]):
        return []
    poles = line.get("unstable_controller_poles_hz") or []
    at = ", ".join(f"{hz:.4g}" for hz in poles[:3])
    return [f"the controller is unstable by itself (poles at {at} Hz)"] if poles else []


def head_words(result: Mapping[str, Any]) -> str:
    """Write what the badge of a verified run stands for, never more than the lines of its verdict.

    Parameters
    ----------
    result : mapping
        Of result.json.

    Returns
    -------
    str
    """
    warned, failed = (
        [line.name for line in lines_of(result) if line.state == state]
        for state in (State.WARNED, State.FAILED)
    )
    if failed:
        return f"by the solve, and since then failed: {', '.join(failed)}"
    if not warned and unproven(result) is not None:
        return f"all that could be checked passed; survives: {unproven(result)}"
    if not warned:
        return "all checks passed" + ("; the loop needs a look" if loop_concerns(result) else "")
    return f"with warnings: {', '.join(warned)}"


PAGES = {
    "report.html": "the machine, its loop, what binds, how it was found",
    "brief.html": "one A4 page for a decision",
    "changes.html": "what changed from another run",
    "insight.html": "the front of cost against bandwidth, and what loosening each bound would gain",
    "robustness.html": "margins, plants off the model, hardware tolerances, a move",
    "*/report.html": "order, rate, code, the move on the machine",
}
FILES = {
    "result.json": "every figure of the run", "report.json": "what the pages show",
    "controller.json": "the controller, SI",
    "case.toml": "the case as it was solved", "samples.sqlite": "every synthesis and design",
    "surrogate.json": "the surrogate", "insight.json": "the figures of insight.html",
    "robustness.json": "the figures of robustness.html", "plant.py": "the plant's own code",
    "truth.json": "the formulation, for retraining",
}  # fmt: skip


def index_of(folder: Path) -> str:
    """Find the page that links all pages of a run, in a folder or in the one above.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    str
        Its address; empty where there is none.
    """
    for place, link in ((folder, INDEX), (folder.resolve().parent, f"../{INDEX}")):
        if (place / "result.json").exists():
            return link
    return ""


def publish(folder: Path, path: Path, page: Page, workers: Pool | None = None) -> None:
    """Write a page about a run with what it shows, and update the run's index.

    Parameters
    ----------
    folder : Path
        Of the run.
    path : Path
        Of the page.
    page : Page
    workers : Pool, optional
        They draw a chapter each.
    """
    write_page(path, page, workers)
    write_index(folder)


def write_index(folder: Path) -> None:
    """Write index.html again after a page was added; nothing where the folder holds no run.

    It links what the folder holds now. The verdict, to which `deploy` and `robustness` write their
    lines, is updated in every page that shows it.

    Parameters
    ----------
    folder : Path
    """
    try:
        result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        result["status"] = str(result["status"])
    except (OSError, ValueError, KeyError):
        return
    if result["status"] != "infeasible" and "objective" not in result:  # `tune` has one page
        return
    pages = _pages(folder)
    for place in pages:
        text = place.read_text(encoding="utf-8")
        now = with_verdict_of(text, result, whole=place == folder / "report.html")
        if now != text:
            write_whole(place, now)
    links = tuple(
        (quote(place.relative_to(folder).as_posix()), _title(place), words)
        for place, words in pages.items()
    )
    files = tuple((n, n, words) for n, words in FILES.items() if (folder / n).exists())
    lead, meta = conclusion(result), f"{result.get('formulation', '')} formulation"
    head = run_head(f"Run: {run_name(folder)}", result, meta, lead)
    chapters = (Chapter("Pages", (Links(links),)), Chapter("Files", (Links(files),)))
    write_whole(folder / INDEX, page_html(Page(head, chapters, index="")))


def _pages(folder: Path) -> dict[Path, str]:
    """What there is, and what it is; a folder with a run of its own is no deployment."""
    return {
        place: words
        for name, words in PAGES.items()
        for place in sorted(folder.glob(name))
        if place.parent == folder or not (place.parent / "result.json").exists()
    }


def _title(place: Path) -> str:
    found = re.search(r"<title>(.*?)</title>", place.read_text(encoding="utf-8"))
    return unescape(found[1]) if found else place.name
