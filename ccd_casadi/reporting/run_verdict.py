"""The verdict of a run as every command and page shows it, and the index of a run's folder."""

import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ccd_casadi.codesign.verdict import State
from ccd_casadi.drawing.content import INDEX, Chapter, Head, Links, Page
from ccd_casadi.drawing.paint import page_html, update_pages, write_page
from ccd_casadi.reporting.concerns import lines_of, loop_concerns, why_unproven, worst_state
from ccd_casadi.reporting.decision import decide
from ccd_casadi.reporting.facts import conclusion, run_name
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import columns, wrap
from ccd_casadi.support.text import plural
from surrogates.files import write_whole

STATUS = {"verified": "verified", "infeasible": "no feasible design"}  # others: not verified


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
    return [wrap(line, columns(sys.stdout)) for line in lines]


def detail_lines(result: Mapping[str, Any]) -> list[str]:
    """Write what the lines of the verdict rest on for the terminal, a row each.

    Parameters
    ----------
    result : mapping
        Of result.json.

    Returns
    -------
    list of str
    """
    return [f"{line.name}: {words}" for line in lines_of(result) for words in line.details]


def head_of(
    title: str, good: bool, status: str, reason: str, meta: str, lead: str,
    result: Mapping[str, Any], decision: str = "",
) -> Head:  # fmt: skip
    """Make the head of a page about a run; the badge is not green where the run's verdict warns.

    Parameters
    ----------
    title : str
    good : bool
        Whether what the page is about holds.
    status, reason, meta, lead : str
        Of the badge; why; seed and versions; the page in a sentence.
    result : mapping
        As result.json has it.
    decision : str
        What the page answers, where that is not whether to build the design.

    Returns
    -------
    Head
    """
    clean = worst_state(result) is State.PASSED and not loop_concerns(result)
    clean &= why_unproven(result) is None
    badge = "bad" if not good else "good" if clean else "warn"
    own, found, lines = bool(decision), decide(result), lines_of(result)
    words, also = (decision, ()) if own else (found.words, found.also)
    return Head(title, badge, status, reason, meta, lead, lines, words, also, own, folded=True)


def run_head(title: str, result: Mapping[str, Any], meta: str, lead: str) -> Head:
    """Make the head of a page that is about the run itself: badge and verdict are the run's.

    Parameters
    ----------
    title : str
    result : mapping
        Of result.json.
    meta, lead : str
        As `head_of` takes them.

    Returns
    -------
    Head
    """
    good = result["status"] == "verified"
    failed = [name for name, held in result.get("checks", {}).items() if held is False]
    failed = failed or [line.name for line in lines_of(result) if line.state == State.FAILED]
    why = f"failed: {', '.join(failed)}" if failed else str(result.get("reason") or "")
    reason = head_words(result) if good else why
    reason = f"{reason[:1].upper()}{reason[1:].rstrip('.')}." if reason else ""
    status = STATUS.get(result["status"], "not verified")
    return replace(head_of(title, good, status, reason, meta, lead, result), folded=False)


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
    warned, failed, unknown = (
        [line.name for line in lines_of(result) if line.state == state]
        for state in (State.WARNED, State.FAILED, State.UNKNOWN)
    )
    if failed:
        return f"by the solve, and since then failed: {', '.join(failed)}"
    if not warned and why_unproven(result) is not None:
        return f"all that could be checked passed; survives: {why_unproven(result)}"
    if not warned:
        count = len(loop_concerns(result))
        open_ = ", ".join(unknown)
        words = f"no check failed; unknown: {open_}" if open_ else "all checks passed"
        return words + (f", with {plural(count, 'reservation')}" if count else "")
    return f"with warnings: {', '.join(warned)}"


PAGES = {
    "report.html": "the machine, its loop, what binds, how it was found",
    "brief.html": "one A4 page for a decision",
    "changes.html": "what changed from another run",
    "insight.html": "the front of cost against bandwidth, and what loosening each bound would gain",
    "robustness.html": "margins, plants off the model, hardware tolerances, a move",
    "*/report.html": "order, rate, code, the move on the machine",
    "feedforward/report.html": "feedforward and shaper of a move, for every plant of the set",
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
    whole = run_head("", result, "", "")

    def updated(own: bool, name: str, page: Page) -> Page:
        head = page.head
        if head.verdict:
            head = replace(head, verdict=whole.verdict)
        if head.decision and not head.own_decision:
            head = replace(head, decision=whole.decision, also=whole.also)
        if own and name == "report.html":
            head = replace(head, badge=whole.badge, status=whole.status, reason=whole.reason)
        return replace(page, head=head)

    pages = _pages(folder)
    titles: dict[Path, str] = {}
    for place in sorted({page.parent for page in pages}):
        titles |= update_pages(place, partial(updated, place == folder))
    links = tuple(
        (quote(place.relative_to(folder).as_posix()), titles.get(place, place.name), words)
        for place, words in pages.items()
    )
    files = tuple((n, n, words) for n, words in FILES.items() if (folder / n).exists())
    lead, meta = conclusion(result), f"{result.get('formulation', '')} formulation"
    head = run_head(f"Run: {run_name(folder)}", result, meta, lead)
    chapters = (Chapter("Pages", (Links(links),)), Chapter("Files", (Links(files),)))
    write_whole(folder / INDEX, page_html(Page(head, chapters, index="")))


def _pages(folder: Path) -> dict[Path, str]:
    """List the pages of a folder, with words; a folder with a run of its own is no deployment."""
    return {
        place: words
        for name, words in PAGES.items()
        for place in sorted(folder.glob(name))
        if place.parent == folder or not (place.parent / "result.json").exists()
    }
