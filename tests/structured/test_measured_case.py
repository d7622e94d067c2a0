"""A measured frequency response as the plant of a case: designed with, and refused in words."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from oracles.fixed_structure_loops import FAST
from oracles.measured_files import CASE, measured, written
from scipy.io import savemat

from ccd_casadi.cases.case import CaseError
from ccd_casadi.cases.measured_case import measured_case
from ccd_casadi.drawing.paint import escape
from ccd_casadi.extensions.measured.measured_loop import controller_response, judge
from ccd_casadi.inner import main as inner
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.solve import main as solve
from ccd_casadi.support.text import HZ


@pytest.mark.parametrize("sampled", [pytest.param(False, marks=pytest.mark.slow), True])
def test_inner_designs_on_the_lines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sampled: bool
) -> None:
    """What is printed is what the judge finds of the controller that is written."""
    loop = f"[loop]\nrate_hz = {FAST.rate_hz}\n" if sampled else ""
    path = written(tmp_path, CASE + loop, sampled)
    code = inner([str(path), "--out", str(tmp_path / "run"), "--quiet"])
    answer = json.loads(capsys.readouterr().out)
    assert (code, answer["status"]) == (0, "verified")
    assert "winding" in answer["words"]
    assert answer["plant"]["lines"] == 1200
    kept = json.loads((tmp_path / "run" / "controller.json").read_text())
    K = StateSpace(*(np.array(kept[name]) for name in "ABCD"))
    case = measured_case(path)
    assert case is not None
    assert (case.period is not None) == sampled
    figures = judge(case.responses[0], K, case.bounds, period=case.period)
    assert figures.stable
    assert figures.S_peak <= 2.0
    assert figures.bandwidth == pytest.approx(HZ * answer["bandwidth_hz"], rel=1e-6)
    # the page's data: |S| on the lines that it shows, none above the peak that the judge found
    shown = (tmp_path / "run" / "report.html").read_text().replace("\u00a0", " ")
    assert escape(answer["words"]) in shown
    assert ("sampled at 10000 Hz" in shown) == sampled
    data = re.findall(r"<tr>((?:<td[^>]*>[^<]*</td>){9})</tr>", shown)
    texts = [re.findall(r">([^<]+)</td>", row) for row in data]
    cells = np.array([[np.nan if v == "–" else float(v) for v in row] for row in texts])
    k = controller_response(K, case.responses[0].hz, case.period)[:, 0, 0]
    S = np.abs(1.0 / (1.0 + case.responses[0].G * k))
    at = [int(np.abs(case.responses[0].hz - hz).argmin()) for hz in cells[:, 0]]
    np.testing.assert_allclose(cells[:, 2], S[at], rtol=1e-3)
    assert cells[:, 2].max() == pytest.approx(figures.S_peak, rel=1e-4)


def test_a_mat_file_is_the_same_plant(tmp_path: Path) -> None:
    path = written(tmp_path, CASE.replace("stage.csv", "stage.mat"), lines=50)
    found = measured(None, 50)
    savemat(tmp_path / "stage.mat", {"f_hz": found.hz, "G": found.G, "note": "by hand"})
    case = measured_case(path)
    assert case is not None
    np.testing.assert_allclose(case.responses[0].G, found.G)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("stage.csv", "none.csv", "plant.file.*No such file"),
        ('file = "stage.csv"', "", "plant.file: is missing"),
        ('file = "stage.csv"', 'file = "stage.csv"\nzeta = 0.1', "plant.zeta: unknown key"),
        ('file = "stage.csv"', 'file = "stage.csv"\nunstable_poles = -1', "unstable_poles"),
        ("biquads = 0", "[theta.m]\nlower = 1.0\nupper = 2.0", "theta: has no effect"),
        ('structure = "sections"', "", "controller.structure: needs"),
        ("A_u = 1e-2", "", "weights.A_u: is missing"),
        ("S_max = 2.0", "S_max = 0.5", "inner.S_max"),
        ("biquads = 0", "biquads = 0\n[loop]\nrate_hz = 1e4\ndelay_us = 10.0", "loop.delay_us"),
        ("biquads = 0", "biquads = 0\n[loop]\nrate_hz = 1.5",
         "inner.omega_low_hz: is 1, not below 0.75, half of loop.rate_hz = 1.5; lower it"),
        ("[inner]", '[inner]\nminimise = "rms_error"', "inner.minimise: needs a model"),
    ],
)  # fmt: skip
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(CaseError, match=words):
        measured_case(written(tmp_path, CASE.replace(old, new), lines=20))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", b"", "is empty"),
        ("a.csv", b"f_hz,re,im\n1,2,three\n", "not a table of numbers"),
        ("a.csv", b"f_hz,re,im\n1,2\n", "line 2: has 2 cells"),
        ("a.csv", b"time,re,im\n1,2,3\n", "'time': is not understood"),
        ("a.csv", b"f_hz,re\n1,2\n", "needs re and im"),
        ("a.csv", b"f_hz,re,im\n" + b"1,2,3\n" * 6, "line 3 repeats 1 Hz"),
        ("a.csv", b"f_hz,re,im\n1,2,3\n", "five lines or more"),
        ("a.csv", b"\xff\xfe\x00\x01", "not a table of numbers"),
        ("a.mat", b"no such thing", r"\.mat file"),
        ("a.mat", b"\x89HDF\r\n\x1a\n" + bytes(600), r"\.mat file"),
    ],
)
def test_bad_files_are_one_line(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    path = written(tmp_path, CASE.replace("stage.csv", name), lines=20)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(CaseError, match=words) as caught:
        measured_case(path)
    assert "plant.file" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_other_commands_say_whose_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, CASE + "[theta.m]\nlower = 1.0\nupper = 2.0\n", lines=20)
    assert solve([str(path)]) == 2
    path = written(tmp_path, lines=20)
    for option in (("--theta", "m=1"), ("--begin-at", str(tmp_path))):
        assert inner([str(path), *option]) == 2
        assert "has no theta" in capsys.readouterr().err
