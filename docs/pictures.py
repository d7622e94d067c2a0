"""Pictures of the site: python docs/pictures.py STAGE_RUN, the run of the tutorial's stage.

STAGE_RUN needs what `solve`, `robustness` and `deploy` write.
"""

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
HERE = Path(__file__).parent
PAGES = {
    "report_tutorial": ("report.html", 0),
    "robustness_tutorial": ("robustness.html", 0),
    "deploy_tutorial": ("deploy/report.html", 0),
}


def main(run: Path) -> None:
    with sync_playwright() as tool:
        place = next(filter(None, map(shutil.which, BROWSERS)), None)
        browser = tool.chromium.launch(executable_path=place, args=["--no-sandbox"])
        view = browser.new_page(viewport={"width": 1280, "height": 1000}, color_scheme="light")
        for name, (file, top) in PAGES.items():
            view.goto((run / file).resolve().as_uri())
            view.screenshot(path=HERE / f"{name}.png", full_page=True, clip={
                "x": 0, "y": top, "width": 1280, "height": 1000})  # fmt: skip


if __name__ == "__main__":
    main(Path(sys.argv[1]))
