"""`report.json`: what the pages of a folder show, kept beside them so that they can be drawn again.

    {"format": 1, "pages": {"report.html": {...}, "robustness.html": {...}}}

A page is drawn from what was stored of it, so that it is the same whenever it is drawn.
"""

import json
from pathlib import Path
from typing import Any

from ccd_casadi.drawing.content import Page
from ccd_casadi.drawing.paint import page_html
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.json_files import plain, restored
from ccd_casadi.support.process_pool import Pool
from surrogates.files import write_whole

NAME = "report.json"
FORMAT = 1


def write_page(path: Path, page: Page, workers: Pool | None = None) -> None:
    """Draw a page and keep what it shows in report.json beside it, each atomically."""
    try:
        pages = read_pages(path.parent)
    except UserError:  # what cannot be read is written anew
        pages = {}
    pages[path.name] = plain(page, listed=True)
    content = {"format": FORMAT, "pages": pages}
    write_whole(path.with_name(NAME), json.dumps(content, ensure_ascii=False, allow_nan=False))
    draw(path, pages[path.name], workers)


def draw(path: Path, stored: Any, workers: Pool | None = None) -> None:
    """Draw a page from an entry of report.json, whose chapters may be called sections. Raises
    UserError where it is none."""
    try:
        page = restored(Page, {"chapters": stored.get("sections"), **stored})
    except (AttributeError, KeyError, TypeError, ValueError, IndexError):
        words = f"pages.{path.name}: is not what a page shows; repeat the command that wrote it"
        raise UserError(f"{path.with_name(NAME)}: {words}") from None
    write_whole(path, page_html(page, workers))


def read_pages(folder: Path) -> dict[str, Any]:
    """The entries of a folder's report.json; none where there is no such file.

    Raises UserError where it is damaged, or of a later version.
    """
    path = folder / NAME
    if not path.exists():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        pages = dict(found["pages"]) if found["format"] == FORMAT else None
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{path}: is not a report.json; repeat the command") from None
    if pages is not None and any(name != Path(name).name or "." not in name for name in pages):
        raise UserError(f"{path}: pages: names a file that is not a page of this folder")
    if pages is None:
        raise UserError(f"{path}: format: is not {FORMAT}; draw it with the version that wrote it")
    return pages
