"""Pictures of the site: python docs/pictures.py STAGE_RUN BUILT_RUN TUNED

STAGE_RUN, of the tutorial's stage, needs what `solve`, `robustness` and `deploy` write; BUILT_RUN
is of runs/two_mass_built.toml, TUNED what `ccd tune` writes for the response or model of a stage.
"""

import shutil
import sys
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
HERE = Path(__file__).parent
PAGES = {  # which run, its page, and how much of it is shown: top, height
    "report_tutorial": (0, "report.html", 0, 1000),
    "robustness_tutorial": (0, "robustness.html", 0, 1000),
    "deploy_tutorial": (0, "deploy/report.html", 0, 1000),
    "report": (1, "report.html", 0, 1240),
    "tune": (2, "report.html", 0, 560),
}


def main(runs: list[Path]) -> None:
    with sync_playwright() as tool:
        place = next(filter(None, map(shutil.which, BROWSERS)), None)
        browser = tool.chromium.launch(executable_path=place, args=["--no-sandbox"])
        view = browser.new_page(viewport={"width": 1280, "height": 1000}, color_scheme="light")
        for name, (run, file, top, height) in PAGES.items():
            if (runs[run] / file).exists():
                view.goto((runs[run] / file).resolve().as_uri())
                taken = view.screenshot(full_page=True, clip={
                    "x": 120, "y": top, "width": 1040, "height": height})  # fmt: skip
                picture = Image.open(BytesIO(taken)).convert("RGB").quantize(200)
                picture.save(HERE / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main([Path(run) for run in sys.argv[1:]])
