"""What deploy and robustness find is written into the run's verdict, and every page shows it."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.result import with_verdict_line
from ccd_casadi.codesign.verdict import Check, State
from ccd_casadi.deploy import main as deploy
from ccd_casadi.drawing.content import Page
from ccd_casadi.drawing.paint import write_page
from ccd_casadi.reporting.run_verdict import run_head, write_index
from ccd_casadi.robustness import main as robustness


@pytest.fixture
def copied(two_mass_run: Path, tmp_path: Path) -> Path:
    return Path(
        shutil.copytree(
            two_mass_run, tmp_path / "run", ignore=shutil.ignore_patterns("*-shm", "*-wal")
        )
    )


def verdict_of(folder: Path) -> dict:
    return json.loads((folder / "result.json").read_text())["verdict"]


@pytest.mark.slow
def test_after_deploy_and_robustness_no_page_says_what_the_run_no_longer_does(copied: Path) -> None:
    before = verdict_of(copied)
    assert before["deployable"]["state"] == "unknown"
    quick = ["--quiet"]
    assert deploy([str(copied), "--rate-hz", "10000", *quick]) == 0
    few = ["--quiet", "--samples", "20", "--workers", "1"]
    assert robustness([str(copied), *few]) == 0
    after = verdict_of(copied)
    # S_max is exceeded, if by less than a deployment may
    assert after["deployable"]["sensitivity_peak"] > 1.75
    assert after["deployable"]["state"] == "warned"
    assert after["deployable"]["rate_hz"] == 10000.0
    assert after["deployable"]["at_solve"] == before["deployable"]
    study = json.loads((copied / "robustness.json").read_text())["tolerances"]
    hardware = after["survives"]["robustness"]["hardware"]
    assert hardware["unstable"] == study["unstable"] > 0
    said = f"{study['unstable']} of 20 plants with hardware within +-1 % unstable"
    assert said in after["survives"]["words"]
    assert after["survives"]["state"] == "warned"
    assert after["survives"]["at_solve"] == before["survives"]
    assert {k: v for k, v in after.items() if k not in ("deployable", "survives")} == {
        k: v for k, v in before.items() if k not in ("deployable", "survives")
    }
    for name in ("index.html", "report.html", "robustness.html", "deploy/report.html"):
        text = (copied / name).read_text().replace("\xa0", " ")
        assert "run deploy" not in text, name
        assert "at 10000 Hz with a delay of 100" in text, name
        assert f"{study['unstable']} of 20 plants" in text, name
    for name in ("index.html", "report.html", "robustness.html", "deploy/report.html"):
        said = "Do not build this: it does not survive small errors of its model. Next: a [robust]"
        assert said in (copied / name).read_text()
    # given again, what it adds is not added twice
    run = read_run(copied)
    assert robustness([str(copied), *few]) == 0
    assert verdict_of(copied) == after
    assert read_run(copied).result == run.result
    # a rate at which the loop is lost: the line fails, and no page is green
    assert deploy([str(copied), "--rate-hz", "1000", *quick]) == 4
    assert verdict_of(copied)["deployable"]["state"] == "failed"
    assert "since then failed: deployable" in (copied / "report.html").read_text()


def run_in(folder: Path, result: dict) -> FinishedRun:
    """A finished run of which nothing but folder and result is looked at."""
    nothing = dict.fromkeys(("case", "problem", "theta", "plant", "weights", "controller"))
    return FinishedRun(folder=folder, figures=None, result=result, **nothing)  # type: ignore[arg-type]


def test_words_from_anywhere_stay_words_and_a_study_kept_apart_changes_no_run(tmp_path) -> None:
    lines = {
        name: {"state": "passed", "words": name}
        for name in ("certified", "optimal", "predicted", "survives", "deployable")
    }
    result = {"status": "verified", "theta": {}, "formulation": "nested", "verdict": lines}
    result |= {"certificate": {"passed": True, "norm_bound": 1.0}, "hardware_cost": 1.0}
    result |= dict.fromkeys(
        ("bandwidth_hz", "objective", "verification_error", "syntheses", "seconds"), 1.0
    )
    folder = tmp_path / "run"
    (folder / "other").mkdir(parents=True)
    place = folder / "result.json"
    place.write_text(json.dumps(result))
    for name in ("report.html", "other/report.html"):
        write_page(folder / name, Page(run_head("t", result, "", ""), ()))
    (folder / "other" / "result.json").write_text("{}")  # another run, below this one
    run, kept = run_in(folder, result), place.read_bytes()
    said = Reason.QUOTED(words=r"</table><script>\1 \g<0>")
    line = Check("deployable", State.FAILED, (said,), {"figure": 1.0})
    assert with_verdict_line(run, tmp_path / "elsewhere", line) is run
    old = replace(run, result={k: v for k, v in result.items() if k != "verdict"})
    assert with_verdict_line(old, folder, line) is old
    assert place.read_bytes() == kept
    with_verdict_line(run, folder / "deploy", line)
    write_index(folder)
    for name in ("report.html", "index.html"):
        text = (folder / name).read_text()
        assert r"&lt;/table&gt;&lt;script&gt;\1 \g&lt;0&gt;" in text
        assert "since then failed: deployable" in text
        assert '<span class="badge good">✓ verified' not in text
    assert "failed" not in (folder / "other" / "report.html").read_text()
    assert json.loads(place.read_text())["status"] == "verified"
