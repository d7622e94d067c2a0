"""Headless Chromium by Playwright, where both are installed; else the test is skipped."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser; while it is open Playwright's event loop runs in this thread."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    place = next(filter(None, map(shutil.which, NAMES)), None)
    if place is None:
        pytest.skip(f"none of {', '.join(NAMES)} is installed: the page is not driven")
    with api.sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=place, args=["--no-sandbox"])
        yield made
        made.close()


def axe_findings(page: Any) -> list[str]:
    """What axe-core finds on a page that is serious or critical: rule, count and first place."""
    held = pytest.importorskip("axe_playwright_python", reason="axe-core is not installed")
    page.evaluate((Path(held.__file__).parent / "axe.min.js").read_text(encoding="utf-8"))
    found = page.evaluate("axe.run()")["violations"]
    return [
        f"{one['id']} at {len(one['nodes'])} places: {one['nodes'][0]['html'][:120]}"
        for one in found
        if one["impact"] in ("serious", "critical")
    ]
