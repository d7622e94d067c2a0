"""The run report: sound HTML without outside resources, every figure complete, in every case."""

import base64
import hashlib
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest
from oracles.html_document import Document

from ccd_casadi.analysis.loop_channels import scalar_channels
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.formulations import formulation_of
from ccd_casadi.codesign.outer_problem import FormulationResult
from ccd_casadi.codesign.run import co_design
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.drawing.paint import block_html, draw, page_html, read_pages
from ccd_casadi.inner_problem.kinds import design_view
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.report import main as report_command
from ccd_casadi.reporting.landscape import read_truths
from ccd_casadi.reporting.nyquist import bode
from ccd_casadi.reporting.solve_page import solve_page, write_report
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.support.text import number

HZ = 2.0 * np.pi
Run = tuple[Path, Case, CoDesignProblem, Solution, str]
HOSTILE_UNIT = r'kg</td><script>alert(1)</script>"&$\\frac$'
HOSTILE_STEM = 'a <img src=x onerror=alert(2)> & "b"'
COMMON = """
[objective]
w1 = 0.1
w2 = -1.0
[weights]
M_S = 2.0
A_S = 1e-4
c_K = 1e4
omega_K_hz = 100.0
M_K = 1e7
A_l = 1.0
A_u = 1e-2
[inner]
S_max = 1.9
S_low = 0.05
omega_low_hz = 1.0
omega_S_hz = [10.0, 1000.0]
omega_T_hz = [25.0, 1000.0]
"""
PLANTS = """
import casadi as ca
SPRING = ca.DM([[1, -1], [-1, 1]])

def line(m, k, end):
    return {"mass": ca.diag(ca.vertcat(m, end)), "stiffness": k * SPRING, "damping_ratio": 0.02,
            "input": ca.DM([1, 0]), "output": ca.DM([[1, 0]]), "hardware_cost": m + end}

def one(theta):
    return line(theta["m"], 2e7, 20.0)

def two(theta):
    return line(theta["m"], 2e7, theta["e"])

def three(theta):
    plant = line(theta["m"], 2e7 * theta["k"], 20.0 + theta["o"])
    return plant | {"constraints": {"room <b>": theta["m"] + theta["o"] - 34.0}}

def mimo(theta):
    a, b = theta["a"], theta["b"]
    K = ca.SX(3, 3)
    K[:2, :2] += 2e7 * a * SPRING
    K[1:, 1:] += 2e7 * b * SPRING
    return {"mass": ca.diag(ca.vertcat(20 * a, 8 * b, 10)), "stiffness": K, "damping_ratio": 0.02,
            "input": ca.DM([[1, 0], [0, 0], [0, 1]]), "output": ca.DM([[1, 0, 0], [0, 0, 1]]),
            "hardware_cost": a + b}
"""


def parameter(name: str, low: float, high: float, unit: str = "") -> str:
    return f"[theta.{name}]\nlower = {low}\nupper = {high}\nunit = '{unit}'\n"


TWO = parameter("m", 10, 20, "kg") + parameter("e", 15, 25, "kg")
CASES = {  # name: function, parameters, sampling and outer, formulation
    "one": ("one", parameter("m", 10, 20, "kg"), "points = 4\n[outer]\nbox_points = 4", "nested"),
    "three_nested": (
        "three",
        parameter("m", 10, 20, HOSTILE_UNIT) + parameter("k", 0.5, 1.5) + parameter("o", 0, 15),
        "points = 2\n[outer]\nbox_points = 4\nmax_refinements = 0\ntolerance = 1e-9",
        "nested",
    ),
    "three": (
        "three",
        parameter("m", 10, 20, HOSTILE_UNIT) + parameter("k", 0.5, 1.5) + parameter("o", 0, 15),
        "lifted_points = 12\n[outer]\nbox_points = 4\nstarts = 2\nmax_refinements = 0\n"
        "tolerance = 1e-9",
        "lifted",
    ),
    "two_nested": ("two", TWO, "points = 3\n[outer]\nbox_points = 4\nstarts = 4", "nested"),
    "two_direct": ("two", TWO, "[outer]\nbox_points = 4\ndirect_starts = 1", "direct"),
    "one_direct": (
        "one",
        parameter("m", 10, 20, "kg"),
        "[outer]\nbox_points = 4\ndirect_starts = 1",
        "direct",
    ),
    "mimo": (
        "mimo",
        parameter("a", 0.5, 1.5) + parameter("b", 0.5, 1.5),
        "lifted_points = 12\n[outer]\nbox_points = 4\nstarts = 2\nmax_refinements = 1",
        "lifted",
    ),
}


# others are of these kinds
HEAVY = ("one", "one_direct", "two_direct", "two_nested", "three_nested", "mimo")


def written(folder: Path, name: str) -> Case:
    """The case of that name, in a folder."""
    function, theta, rest, _ = CASES[name]
    (folder / "plants.py").write_text(PLANTS)
    path = folder / f"{HOSTILE_STEM}.toml"
    head = f'[plant]\nfunction = "plants.py:{function}"\n'
    path.write_text(head + theta + COMMON + "[sampling]\n" + rest + "\n")
    return load_case(path)


@pytest.fixture(scope="module")
def run(common_folder: Callable[[str], Any], two_mass_run: Path) -> Callable[[str], Run]:
    """A solved case and its report; two_mass is the shared run of the shipped case.

    Another process of the tests finds the samples of the first.
    """

    def shipped() -> Run:
        case = load_case(two_mass_run / "case.toml")
        result = json.loads((two_mass_run / "result.json").read_text())
        text = (two_mass_run / "report.html").read_text(encoding="utf-8")
        solution = Solution(result, FormulationResult(), None)
        return two_mass_run, case, problem_of(case), solution, text

    @cache
    def solved(name: str) -> Run:
        if name == "two_mass":
            return shipped()
        folder = Path(mkdtemp())
        case, formulation = written(folder, name), CASES[name][3]
        problem = problem_of(case)
        with common_folder(f"report_{name}") as place, Workers(1, 2.0) as workers:
            with SampleStore(place / "samples.sqlite") as store:
                sampler = Sampler(problem, store, workers)
                solution = co_design(sampler, formulation_of(case, formulation), 0)
            shutil.copy(place / "samples.sqlite", folder)
        page = write_report(folder, case, problem, solution)
        return folder, case, problem, solution, page.read_text(encoding="utf-8")

    return solved


ALL = [
    pytest.param(name, marks=pytest.mark.slow) if name in HEAVY else name
    for name in ("two_mass", *CASES)
]


def figures(text: str) -> list[str]:
    return re.findall(r"<figure>.*?</figure>", text, flags=re.DOTALL)


def test_report_is_one_file_of_moderate_size(run: Any) -> None:
    folder, *_ = run("two_mass")
    assert (folder / "report.html").stat().st_size < 1_000_000
    assert not (folder / "report.html.part").exists()


@pytest.mark.parametrize("name", ALL)
def test_html_is_well_formed_and_asks_for_nothing(run: Any, name: str) -> None:
    text = run(name)[4]
    document = Document(text)
    tags = {tag for tag, _ in document.tags}
    assert not tags & {"link", "img", "iframe", "object", "image", "foreignobject"}
    scripts = re.findall(r"<script>(.*?)</script>", text, flags=re.DOTALL)
    for script in scripts:  # nothing else may run
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in text.split("</head>")[0]
    assert len(scripts) == sum(tag == "script" for tag, _ in document.tags)
    ids = [attrs["id"] for _, attrs in document.tags if "id" in attrs]
    assert len(ids) == len(set(ids))
    for _, attrs in document.tags:
        assert not any(key.startswith("on") or key == "src" for key in attrs)
        target = attrs.get("href")
        assert target in (None, "index.html") or (target[0] == "#" and target[1:] in ids)
    assert set(re.findall(r"url\(([^)]*)\)", text)) <= {f"#{i}" for i in ids}
    outside = re.sub(r"<pre>.*?</pre>|<script>.*?</script>", "", text, flags=re.DOTALL)
    assert "://" not in outside
    assert "@import" not in text


@pytest.mark.parametrize("name", ALL)
def test_every_figure_has_units_a_caption_and_data(run: Any, name: str) -> None:
    found = figures(run(name)[4])
    assert len(found) >= 3
    for figure in found:
        svg = figure[: figure.index("<figcaption>")]
        words = re.findall(r"<text[^>]*>([^<]*)</text>", svg)
        labels = [word for word in words if re.search(r" \(.+\)$", word)]
        panels = svg.count("-axes_")
        assert panels >= 1
        assert len(labels) >= 2 * panels - svg.count("QuadMesh")
        caption = re.search(r"<figcaption>(.*?)</figcaption>", figure, flags=re.DOTALL)
        assert caption is not None
        assert re.search(r"\d", caption[1])
        assert not re.search(r"\bnan\b|\binf\b|None", caption[1])
        assert figure.count("<details>") == 1
        assert figure.count("<tr>") > 2


@pytest.mark.parametrize("name", ALL)
def test_the_page_says_what_the_result_says(run: Any, name: str) -> None:
    _, case, problem, solution, text = run(name)
    result = solution.result
    good = result["status"] == "verified"
    assert (f'class="badge {"good" if good else "bad"}"') in text
    assert number(result["bandwidth_hz"]) in text
    assert all(key in text for key in (*problem.names, "KKT", "Certificate", result["formulation"]))
    for version in result["versions"].values():
        assert version in text
    assert re.search(r"<pre>\[plant\]", text)
    assert case.path.suffix == ".toml"


def test_what_binds_is_said_in_words(run: Any) -> None:
    text = run("two_mass")[4].replace("\xa0", " ")
    number_ = r"([-+.\de⁻·−]+)"
    for words in ("m1 is at its lower bound, 55 kg. Lowering this bound by 0.15 kg",
                  r"Raising S_max by 1 %"):  # fmt: skip
        moves = rf"ω_b changes by {number_} Hz, the cost by {number_} kg"
        heard = rf"{words}: {moves} \(J falls by {number_}\)"
        said = re.search(heard, text)
        assert said is not None
        hz, kg, J = map(float, said.groups())
        assert J > 0.0  # one true pair: J = w1 f + w2 ω_b has it
        assert 0.9950 * 2.0 * np.pi * hz - 0.0995 * kg == pytest.approx(J, rel=0.02)
        assert kg == (-0.15 if "m1" in words else 0.0)


def test_unverified_result_says_why(run: Any) -> None:
    *_, solution, text = run("three")
    assert solution.result["status"] == "not_verified"
    assert "✕ not verified" in text
    assert "Failed: prediction" in text
    assert "UNVERIFIED" in text
    assert "prediction and truth differ by" in solution.result["reason"]
    assert text.count("prediction and truth differ by") == 1  # in its line alone


def test_hostile_names_and_units_are_escaped(run: Any) -> None:
    text = run("three")[4]
    assert "<script>alert" not in text
    assert "<img" not in text
    assert "alert(1)" in text  # it is shown, as text
    assert "&lt;img src=x" in text
    assert "room <b>" not in text


def test_infeasible_run_has_a_page_too(run: Any, tmp_path: Path) -> None:
    _, case, problem, solution, _ = run("three")
    kept = ("formulation", "syntheses", "seconds", "seed", "versions")
    result = {key: solution.result[key] for key in kept}
    result |= {"status": "infeasible", "reason": "S_max cannot be met by <0.1>"}
    nothing = FormulationResult()
    text = page_html(solve_page(tmp_path, case, problem, Solution(result, nothing, None)))
    Document(text)
    assert "S_max cannot be met by &lt;0.1&gt;" in text


def test_workers_draw_the_same_page(run: Any, tmp_path: Path) -> None:
    folder, *_ = run("three")
    stored = read_pages(folder)["report.html"]
    stored["chapters"] = stored["chapters"][:3]
    draw(tmp_path / "alone.html", stored)
    with Workers(2) as workers:
        draw(tmp_path / "report.html", stored, workers)
        assert len(workers._workers) == 2
    drawn, alone = ((tmp_path / name).read_text() for name in ("report.html", "alone.html"))
    assert drawn == alone
    assert drawn.count("<svg") >= 2


@pytest.mark.parametrize("name", [pytest.param("one", marks=pytest.mark.slow), "two_mass"])
def test_a_page_is_drawn_again_from_its_folder_alone(
    run: Any, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, *_, first = run(name)
    again = tmp_path / "run"
    again.mkdir()
    shutil.copy(folder / "report.json", again)

    def refused(*given: object, **named: object) -> None:
        raise AssertionError("a page that is there computes nothing")

    for computing in (
        "synthesis.synthesis.synthesise", "analysis.move.simulate", "lti.loop.constant_drive",
        "inner_problem.problem.plant_of", "lti.state_space.StateSpace.response",
    ):  # fmt: skip
        monkeypatch.setattr(f"ccd_casadi.{computing}", refused)
    stored = (again / "report.json").read_text(encoding="utf-8")
    assert '"chapters":' in stored
    # as folders of before have them; those of today test_a_run_without_one_gets_a_report
    text = stored.replace('"chapters":', '"sections":')
    (again / "report.json").write_text(text, encoding="utf-8")
    assert report_command([str(again), "--quiet"]) == 0
    assert (again / "report.html").read_text(encoding="utf-8") == first


@pytest.mark.slow
def test_a_run_without_one_gets_a_report_of_its_design(
    two_mass_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(
        shutil.copytree(
            two_mass_run, tmp_path / "run", ignore=shutil.ignore_patterns("*-shm", "*-wal")
        )
    )
    for name in ("report.html", "report.json"):
        (folder / name).unlink(missing_ok=True)

    def refused(*given: object, **named: object) -> None:
        raise AssertionError("nothing is designed")

    for place in ("synthesis.synthesis", "reporting.gain_figures"):
        monkeypatch.setattr(f"ccd_casadi.{place}.synthesise", refused)
    assert report_command([str(folder), "--quiet"]) == 0
    text = (folder / "report.html").read_text(encoding="utf-8")
    Document(text)
    for heading in (
        "At a glance",
        "The design",
        "Loop, plant and controller",
        "A move",
        "Provenance",
    ):
        assert f"<h2>{heading}</h2>" in text
    assert "how the design was found was not kept" in text
    assert report_command([str(folder), "--quiet"]) == 0
    assert (folder / "report.html").read_text(encoding="utf-8") == text


def test_a_foreign_or_damaged_report_json_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "report.json"
    for text, said in (
        ("{", "is not a report.json"), ('{"format": 2, "pages": {}}', "format: is not 1"),
        ('{"format": 1, "pages": {"../a.html": {}}}', "names a file that is not a page"),
        ('{"format": 1, "pages": {"a.html": {"head": 3}}}', "is not what a page shows"),
    ):  # fmt: skip
        place.write_text(text)
        assert report_command([str(tmp_path)]) == 2
        assert said in capsys.readouterr().err


def test_mimo_shows_its_channels_or_all_singular_values(tmp_path: Path) -> None:
    problem = problem_of(written(tmp_path, "mimo"))
    K = StateSpace(-100.0 * np.eye(2), np.eye(2), 1e5 * np.eye(2), np.zeros((2, 2)))
    for theta, apart in (((0.5, 0.5), True), ((0.9, 1.3), False)):  # masses 10, 4, 10 kg or not
        plant = scaled_plant(problem, theta)
        weights = problem.weights.at(HZ * 50.0, HZ * 100.0)
        loop = design_view(problem, theta, K, weights=weights, gamma=1.0, bandwidth_hz=50.0)
        text = block_html(bode(loop, scalar_channels(plant, K)), "k")
        assert ("channel 1, outputs +" in text) == apart
        assert ("phase of G" in text) == apart
        assert ("plant σ(G) (m/N)" in text) != apart


def test_paper_frequencies_are_marked(run: Any) -> None:
    text = run("two_mass")[4].replace("\xa0", " ")
    assert "Resonances (▲) of the plant: 183.6 Hz; anti-resonances (▼): 129.8 Hz" in text


def test_other_problems_in_the_store_are_left_out(run: Any) -> None:
    folder, _, problem, *_ = run("two_mass")
    other = replace(problem, weights=replace(problem.weights, M_K=1e7))
    own, others = (read_truths(folder / "samples.sqlite", each) for each in (problem, other))
    assert len(own.designs) > 0
    assert len(others.designs) == len(others.theta) == 0
