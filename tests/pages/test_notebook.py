"""What shows itself in a notebook, and what a finished run becomes in other people's tools."""

import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import control
import numpy as np
import pytest
from oracles.helpers import HZ, problem

import ccd_casadi as ccd
from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.codesign.outer_problem import FormulationResult, RunTerms
from ccd_casadi.codesign.result import infeasible_dict
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.fixed_structure.design import SectionsOutcome
from ccd_casadi.support.errors import MissingPackage
from ccd_casadi.support.terminal import NotebookHtml, Progress

ROOT = Path(__file__).resolve().parents[2]
VOID = {"br", "hr", "img", "meta", "input"}


class _Text(HTMLParser):
    """The text outside of <style>; every element has to be closed."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.feed(html)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: object) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.text += data


def shown(item: NotebookHtml) -> str:
    return _Text(item._repr_html_()).text.replace("\u00a0", " ")  # a unit stays with its number


@pytest.fixture(scope="module")
def run(two_mass_run: Path) -> FinishedRun:
    return read_run(str(two_mass_run))


def test_a_run_shows_its_verdict_its_theta_and_its_loop(run: FinishedRun) -> None:
    text = shown(run)
    for words in ("verified", "survives", "m1", "at lower", "71.932 Hz", "S_max 1.75"):
        assert words in text
    # two of them in one notebook: no id twice
    ids = [re.findall(r'\bid="([^"]*)"', run._repr_html_()) for _ in range(2)]
    assert ids[0]
    assert not set(ids[0]) & set(ids[1])


def test_a_case_and_its_problem_show_the_same() -> None:
    case = ccd.load_case(ROOT / "runs/two_mass.toml")
    text = shown(case)
    assert text == shown(ccd.problem_of(case))
    for words in ("two_mass", "55", "70", "≤ 1.75", "10 to 1800 Hz"):
        assert words in text
    built = shown(ccd.load_case(ROOT / "runs/two_mass_built.toml"))
    assert "of fixed structure" in built
    assert "10000 Hz" in built


def test_inner_designs_show_their_figures() -> None:
    chosen = problem()
    best = ccd.true_inner(chosen, (60.0, 60.0))
    assert all(words in shown(best) for words in ("58.12", "S_max, omega_T lower binds"))
    assert best.optimum is not None
    assert "58.12" in shown(best.optimum)
    none = ccd.true_inner(
        replace(
            chosen, inner=replace(chosen.inner, S_max=1.01, sweep_points=(3, 3)), method="sweep"
        ),
        (60.0, 60.0),
    )
    assert "where S_max = 1.01 is required" in shown(none)
    made = ccd.synthesise(
        ccd.scaled_plant(chosen, (60.0, 60.0)),
        chosen.weights.at(800.0 * HZ, 40.0 * HZ), omega_low=HZ,
    )  # fmt: skip
    assert "55.558 Hz" in shown(made)


def test_a_solution_without_a_design_says_why() -> None:
    result = infeasible_dict(RunTerms("lifted", 1e-3, 0), "too <heavy>", {"samples": 1})
    text = shown(Solution(result, FormulationResult(), None))
    assert "No feasible design: too <heavy>" in text


def test_sections_show_themselves() -> None:
    plant = control.tf([1.0], [1.8, 12.0, 800.0])
    bounds = ccd.Bounds(S_max=1.8, S_low=0.1, omega_low=5.0, shape=1.1, compliance_max=1e-4)
    made = ccd.synthesise_sections(
        [plant], ccd.Structure(lead=1, biquads=0, roll_off=1), bounds,
        sampling=ccd.Sampling(rate_hz=2000.0, delay_us=250.0), starts=2,
    )  # fmt: skip
    text = shown(made)
    assert "integrator with zero" in text
    assert made.words in text
    nothing = replace(made, controller=None, outcome=SectionsOutcome.NO_STABLE_START)
    assert "no_stable_start" in shown(nothing)


def test_a_run_becomes_systems_of_python_control(run: FinishedRun) -> None:
    G, K = run.to_control()
    S = control.feedback(1, G * K)
    assert abs(S(1j * run.figures.bandwidth)) == pytest.approx(2**-0.5, rel=1e-7)
    assert (G.input_labels, K.output_labels) == (["u1"], ["u1"])


def test_its_syntheses_become_a_table(run: FinishedRun) -> None:
    pytest.importorskip("pandas")
    table = ccd.samples_frame(run)
    assert set(run.problem.names) < set(table.columns)
    good = table[table.certified]
    assert (good.bandwidth_hz > 0.0).all()
    # the design that the run ended with is one of them
    of_design = (good[list(run.problem.names)] == np.array(run.theta)).all(axis=1)
    gap = (good[of_design].bandwidth_hz / run.result["bandwidth_hz"] - 1.0).abs()
    assert gap.min() < 1e-9


def test_without_pandas_it_is_said_what_to_install(
    run: FinishedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingPackage, match=r"pip install 'ccd-casadi\[notebook\]'"):
        ccd.samples_frame(run)


def test_progress_in_a_cell_is_one_line_on_stdout(monkeypatch: pytest.MonkeyPatch) -> None:
    """As ipykernel's stream has it: no terminal, no size, "\\r" goes back to the line's start."""

    class OutStream:
        text = ""

        def write(self, text: str) -> None:
            self.text += text

        def flush(self) -> None: ...

        def isatty(self) -> bool:
            return False

    OutStream.__module__ = "ipykernel.iostream"
    monkeypatch.setitem(sys.modules, "ipykernel", sys)
    cell = OutStream()
    monkeypatch.setattr(sys, "stdout", cell)
    with Progress(3, "sampling") as bar:
        bar.interval = 0.0
        bar.advance(note="a long note that has to go away again")
        bar.advance(2)
    lines = cell.text.split("\n")
    assert len(lines) == 2
    assert lines[1] == ""
    states = lines[0].split("\r")[1:]
    assert len({len(state) for state in states}) == 1, "each covers the one before"
    assert "3/3" in states[-1]
    assert "\x1b" not in cell.text
