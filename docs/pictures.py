"""Pictures of the site: python docs/pictures.py STAGE_RUN BUILT_RUN TUNED FRONT_RUN [EXPLORED_RUN]

STAGE_RUN, of the tutorial's stage, needs what `solve`, `robustness` and `deploy` write; BUILT_RUN
is of runs/two_mass_built.toml, TUNED what `ccd tune` writes for the response or model of a stage,
FRONT_RUN of examples/planar_stage with `insight`, EXPLORED_RUN of runs/two_mass.toml.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
HERE = Path(__file__).parent
PAGES = {  # which run, its page, and how much of it is shown: top, height
    "report_tutorial": (0, "report.html", 0, 1000),
    "robustness_tutorial": (0, "robustness.html", 0, 1000),
    "deploy_tutorial": (0, "deploy/report.html", 0, 1000),
    "report": (1, "report.html", 0, 1240),
    "tune": (2, "report.html", 0, 560),
    "insight": (3, "insight.html", 0, 945),
}


READY = "window.Bokeh?.documents[0]?.get_model_by_name('answer')?.data.serial[0] > 0"


def explorer(browser: Browser, run: Path) -> None:
    """The explorer of a run with two pinned designs."""
    words = ["-m", "ccd_casadi.explore", str(run), "--no-open", "--out", tempfile.mkdtemp()]
    served = subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True)
    try:
        address = re.search(r"http://\S+", served.stdout.readline())[0]
        view = browser.new_page(viewport={"width": 1400, "height": 1000}, color_scheme="light")
        view.set_default_timeout(300e3)
        view.goto(address)
        view.wait_for_function(READY)
        first = view.locator(".noUi-handle").first
        for _ in range(2):
            for _ in range(40):
                first.press("PageUp")
            view.wait_for_timeout(8000)
            view.get_by_role("button", name="Pin this design").click()
            view.wait_for_timeout(3000)
        first.press("Home")
        view.wait_for_timeout(8000)
        top = view.locator("main").bounding_box()["y"]  # above it are paths
        picture = Image.open(BytesIO(view.screenshot(full_page=True))).convert("RGB")
        picture = picture.crop((0, int(top), picture.width, picture.height))
        size = (900, round(900 * picture.height / picture.width))
        picture.resize(size, Image.Resampling.LANCZOS).quantize(
            256, Image.Quantize.MAXCOVERAGE
        ).save(HERE / "explorer.png")
    finally:
        served.terminate()
        served.wait()


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
        for run in runs[4:]:
            explorer(browser, run)


if __name__ == "__main__":
    main([Path(run) for run in sys.argv[1:]])
