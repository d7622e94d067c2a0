"""Names, units and options of a stranger's case are shown on the pages as text."""

import importlib
import importlib.util
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from ccd_casadi.reporting.run_verdict import FILES
from ccd_casadi.solve import main as solve

ROOT = Path(__file__).parents[2]
OURS = [path.read_text() for path in (ROOT / "ccd_casadi" / "drawing" / "assets").glob("*.js")]

HOSTILE = "kg</td></pre><script>alert(1)</script><img src=x onerror=alert(2)>\"'&$\\\\frac$ {0} %s"
PLANT = """
import casadi as ca

def f(theta, note, table):
    m = theta["m"]
    return {
        "mass": ca.diag(ca.vertcat(m, 20.0)), "stiffness": 2e7 * ca.DM([[1, -1], [-1, 1]]),
        "damping_ratio": 0.02, "input": ca.DM([1, 0]), "output": ca.DM([[1, 0]]),
        "hardware_cost": m, "constraints": {note: m - 19.0},
    }
"""


class Page(HTMLParser):
    """Elements and attributes of a page, for what would run or fetch something."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.active: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for key, value in attrs:
            page_or_place = re.fullmatch(r"#.*|(\.\./)?[\w%-]+(/[\w%-]+)?\.html", str(value))
            if tag == "a" and value in FILES:  # of the run's folder, by the names that we give
                continue
            if key.startswith("on") or (key in ("src", "href") and page_or_place is None):
                self.active.append(f"{tag} {key}={value}")
        if tag in ("script", "img", "iframe", "object", "link", "embed", "form", "base"):
            self.active.append(tag)


@pytest.fixture(scope="module")
def hostile_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with markup in every text that a case may hold, and in the name of its folder."""
    place = tmp_path_factory.mktemp("hostile") / "<img src=x onerror=alert(3)> & b"
    place.mkdir()
    (place / "plant.py").write_text(PLANT)
    text = (ROOT / "runs" / "two_mass.toml").read_text()
    quoted = json.dumps(HOSTILE)
    head = f'[plant]\nfunction = "plant.py:f"\nnote = {quoted}\ntable = [{quoted}]\n'
    theta = f"[theta.m]\nlower = 10.0\nupper = 20.0\nunit = {quoted}\n"
    quick = "\n[sampling]\nlifted_points = 12\n[outer]\nstarts = 2\nmax_refinements = 1\n"
    quick += "box_points = 0\n"
    case = place / "<b>case.toml"
    rest = text[text.index("[objective]") :].replace("S_max = 1.75", "S_max = 1.9")
    case.write_text(f"# {HOSTILE}\n{head}{theta}{rest}{quick}")
    words = ["--out", str(place / "run"), "--quiet", "--workers", "1", "--formulation", "lifted"]
    assert solve([str(case), *words]) in (0, 4)
    return place / "run"


def pages_are_inert(folder: Path, least: int) -> None:
    pages = sorted(folder.rglob("*.html"))
    assert len(pages) >= least
    for page in pages:
        text = page.read_text()
        assert "<script>alert" not in text
        for script in OURS:
            text = text.replace(f"<script>{script}</script>", "")
        assert Page(text).active == [], page.name
    assert any("&lt;script&gt;alert(1)" in page.read_text() for page in pages), "shown as text"


def test_reports_show_markup_as_text(hostile_run: Path) -> None:
    pages_are_inert(hostile_run, 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["insight", "deploy", "robustness", "compare"])
def test_every_other_report_shows_markup_as_text(
    hostile_run: Path, tmp_path: Path, name: str
) -> None:
    module = importlib.import_module(f"ccd_casadi.{name}")
    more = {"insight": ["--points", "2"]}.get(name, [])
    given = hostile_run / "case.toml" if name == "compare" else hostile_run
    words = [str(given), "--out", str(tmp_path / "<i>out"), "--quiet", "--workers", "1", *more]
    assert module.main(words) in (0, 4)
    pages_are_inert(tmp_path, 1)
