"""index.html of a run's folder: its verdict, its pages, and what its files are."""

import json
import re
from html import unescape
from pathlib import Path
from urllib.parse import quote

from ccd_casadi.drawing.content import INDEX, Chapter, Links, Page
from ccd_casadi.drawing.paint import page_html
from ccd_casadi.drawing.stored import write_page
from ccd_casadi.reporting.facts import conclusion, run_name
from ccd_casadi.reporting.verdict import run_head, with_verdict_of
from ccd_casadi.support.process_pool import Pool
from surrogates.files import write_whole

PAGES = {
    "report.html": "the machine, its loop, what binds, how it was found",
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
    """What a page in this folder links as the page of all pages of a run, here or one above."""
    for place, link in ((folder, INDEX), (folder.resolve().parent, f"../{INDEX}")):
        if (place / "result.json").exists():
            return link
    return ""


def publish(folder: Path, path: Path, page: Page, workers: Pool | None = None) -> None:
    """Write a page about the run in `folder` with what it shows, and the run's index anew."""
    write_page(path, page, workers)
    write_index(folder)


def write_index(folder: Path) -> None:
    """Write index.html anew after a page was added; nothing where the folder holds no run.

    Links are to what the folder holds now. The verdict, to which `deploy` and `robustness` write
    their lines, is put anew into every page that shows it.
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
