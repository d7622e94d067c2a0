"""Screenshots of the site, from runs made for them: python docs/pictures.py [NAME ...]

`make pictures` draws all of them, in ten minutes on two cores; NAME: that picture alone. The runs
are kept in build/pictures (`--runs`) and continued. docs/pictures.json has of each picture a digest
of the code that draws its page, which `tests/commands/test_docs_pictures.py` compares.
"""

import argparse
import ast
import hashlib
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import scipy

HERE = Path(__file__).parent
ROOT = HERE.parent
STAMPS = HERE / "pictures.json"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
TITLED = re.compile(r'^```\w+ title="([^"]+)"\n(.*?)^```$', re.MULTILINE | re.DOTALL)
BUILT, EXPLORED, FRONT = "runs/two_mass_built.toml", "runs/two_mass.toml", "examples/planar_stage"
RUNS = {  # folder of a run: its commands without `ccd`
    "stage": ["solve {runs}/my_stage.toml --formulation lifted", "robustness", "deploy"],
    "built": [f"solve {BUILT}"],
    "tuned": ["tune {runs}/stage.mat --rate 8000 --delay 1e-4 --s-max 1.6"],
    "front": [f"solve {FRONT}/case.toml --formulation lifted", "insight"],
    "explored": [f"solve {EXPLORED}"],
}
DRAWN = ("drawing/*.py", "drawing/assets/*.css", "drawing/assets/page.html",
         "drawing/assets/blocks.html", "drawing/assets/lumped.svg")  # fmt: skip
GLANCE = ("solve_page", "limit_figures", "decision", "concerns", "facts", "run_verdict",
          "gain_figures", "nyquist", "machine", "moves")  # fmt: skip


@dataclass(frozen=True)
class Shot:
    """A picture: of which run and page, how many px of it from the top, and what draws that."""

    run: str
    page: str
    height: int
    sources: tuple[str, ...]


def reporting(*names: str) -> tuple[str, ...]:
    """Sources of a page of a run."""
    return (*DRAWN, *(f"reporting/{name}.py" for name in names))


REPORT = (*reporting(*GLANCE), "templates/report.txt")
SHOTS = {
    "report_tutorial": Shot("stage", "report.html", 1000, REPORT),
    "robustness_tutorial": Shot("stage", "robustness.html", 1000,
                                (*reporting("robustness_page", "decision", "run_verdict"),
                                 "templates/robustness.txt")),
    "deploy_tutorial": Shot("stage", "deploy/report.html", 1000,
                            (*reporting("deploy_page", "decision", "run_verdict"),
                             "templates/deploy.txt")),
    "report": Shot("built", "report.html", 1240, REPORT),
    "tune": Shot("tuned", "report.html", 900,
                 (*DRAWN, "extensions/measured/measured_answer.py", "reporting/gain_figures.py",
                  "reporting/nyquist.py")),
    "insight": Shot("front", "insight.html", 945,
                    (*reporting("insight_page", "decision", "run_verdict"),
                     "templates/insight.txt")),
    "explorer": Shot("explored", "", 0,
                     ("extensions/explorer/*.py", "extensions/explorer/page.html",
                      "extensions/explorer/assets/*")),
}  # fmt: skip


def digest(shot: Shot, root: Path = ROOT / "ccd_casadi") -> str:
    """Of what draws a picture: Python without its comments and docstrings, other files as text."""
    found = hashlib.sha256()
    for pattern in shot.sources:
        for file in sorted(root.glob(pattern)):
            text = file.read_text(encoding="utf-8")
            found.update((bare(text) if file.suffix == ".py" else text).encode())
    return found.hexdigest()[:16]


def bare(source: str) -> str:
    """The syntax of a module without docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        first = body[0] if isinstance(body, list) and body else None
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
            body[0] = ast.Expr(ast.Constant(""))
    return ast.unparse(tree)


def make(run: str, runs: Path) -> None:
    """The run of a picture, with its pages."""
    if run == "stage":
        for name, text in TITLED.findall((HERE / "tutorial.md").read_text(encoding="utf-8")):
            (runs / name).write_text(text, encoding="utf-8")
    if run == "tuned":
        scipy.io.savemat(runs / "stage.mat", stage_model())
    for words in RUNS[run]:
        command, *given = words.format(runs=runs).split()
        folder = ["--out", str(runs / run)] if given else [str(runs / run)]
        subprocess.run([sys.executable, "-m", f"ccd_casadi.{command}", *given, *folder, "--quiet"],
                       cwd=ROOT)  # fmt: skip


def stage_model() -> dict[str, np.ndarray]:
    """Two masses on a spring, 390 Hz, on soft cables: force to position in SI."""
    M, k, c = np.diag([6.0, 1.5]), 7.2e6, 25.0
    K = k * np.array([[1.0, -1.0], [-1.0, 1.0]]) + np.diag([3e3, 0.0])
    D = c * np.array([[1.0, -1.0], [-1.0, 1.0]]) + np.diag([40.0, 0.0])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    B = np.array([[0.0], [0.0], [1.0 / 6.0], [0.0]])
    return {"A": A, "B": B, "C": np.array([[0.5, 0.5, 0.0, 0.0]]), "D": np.zeros((1, 1))}


def drawn(names: Iterable[str], runs: Path) -> None:
    """Take the pictures, and stamp each."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as tool:
        place = next(filter(None, map(shutil.which, BROWSERS)), None)
        browser = tool.chromium.launch(executable_path=place, args=["--no-sandbox"])
        for name in names:
            shot = SHOTS[name]
            taken = explorer(browser, runs / shot.run) if not shot.page else of_page(
                browser, runs / shot.run / shot.page, shot.height)  # fmt: skip
            keep(taken, HERE / f"{name}.png")
            stamps = json.loads(STAMPS.read_text()) if STAMPS.exists() else {}
            STAMPS.write_text(json.dumps(stamps | {name: digest(shot)}, indent=1) + "\n")


def of_page(browser: "Browser", page: Path, height: int) -> bytes:  # noqa: F821
    """The first screen of a page."""
    view = browser.new_page(viewport={"width": 1280, "height": 1000}, color_scheme="light",
                            reduced_motion="reduce")  # fmt: skip
    view.goto(page.resolve().as_uri())
    return view.screenshot(full_page=True,
                           clip={"x": 120, "y": 0, "width": 1040, "height": height})  # fmt: skip


def explorer(browser: "Browser", run: Path) -> bytes:  # noqa: F821
    """The first screen of the explorer of a run, with two pinned designs."""
    ready = "window.Bokeh?.documents[0]?.get_model_by_name('answer')?.data.serial[0] > 0"
    words = ["-m", "ccd_casadi.explore", str(run), "--no-open", "--out", str(run / "explored")]
    served = subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        address = re.search(r"http://\S+", served.stdout.readline())[0]
        view = browser.new_page(viewport={"width": 1400, "height": 900}, color_scheme="light")
        view.set_default_timeout(300e3)
        view.goto(address)
        view.wait_for_function(ready)
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
        return view.screenshot(clip={"x": 0, "y": top, "width": 1400, "height": 900 - top})
    finally:
        served.terminate()
        served.wait()


def keep(taken: bytes, place: Path) -> None:
    """As a small PNG."""
    from PIL import Image

    picture = Image.open(BytesIO(taken)).convert("RGB")
    picture = picture.resize((900, round(900 * picture.height / picture.width)),
                             Image.Resampling.LANCZOS)  # fmt: skip
    picture.quantize(128).save(place, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[[], *SHOTS], metavar="NAME")
    parser.add_argument("--runs", type=Path, default=ROOT / "build/pictures")
    given = parser.parse_args()
    names, runs = given.names or [*SHOTS], given.runs.resolve()
    runs.mkdir(parents=True, exist_ok=True)
    for run in dict.fromkeys(SHOTS[name].run for name in names):
        make(run, runs)
    drawn(names, runs)


if __name__ == "__main__":
    main()
