"""The brief of a run: one page that answers what somebody who decides would ask."""

import json
import math
import re
import shutil
from html import unescape
from pathlib import Path

from ccd_casadi import report
from ccd_casadi.cases.run_folder import read_run
from ccd_casadi.reporting.brief import (
    BriefOptions,
    bars,
    before_and_after,
    brief_html,
    evidence,
    nearest,
)
from ccd_casadi.reporting.concerns import risks, what_if

OPTIONS = BriefOptions()
SURVIVES = {
    "stable_shift": [-0.2, 0.5], "S_max_shift": [-0.01, 0.06], "gain_margin": [0.5, 1.05],
    "robust_set": True, "set": "kept",
}  # fmt: skip
RESULT = {
    "status": "verified", "delay_margin_us": 150.0,
    "verdict": {"survives": {"state": "passed", "words": "", **SURVIVES},
                "deployable": {"state": "passed", "words": "", "rate_hz": 10_000.0}},
}  # fmt: skip


def test_what_if_is_what_the_verdict_knows() -> None:
    found = dict(what_if(RESULT, OPTIONS.shift, OPTIONS.gain))
    assert found["all resonances are 3 % lower"] == "stable, and |S| exceeds S_max from 1.0 % on"
    assert found["all resonances are 3 % higher"] == "stable and within S_max"
    assert found["the plant's gain is off by 10 %"].startswith("unstable")
    assert found["one sample more of delay"].startswith("stable; the delay margin is 1.5 samples")
    far = dict(what_if(RESULT, 0.3, OPTIONS.gain))
    assert far["all resonances are 30 % lower"] == "unstable: it is stable to -20 %"
    assert not list(what_if({}, OPTIONS.shift, OPTIONS.gain))  # what is not known is not said


def test_risks_name_what_failed_first_and_what_has_no_check() -> None:
    failed = {"state": "failed", "words": "the norm is above its bound"}
    result = RESULT | {"verdict": {**RESULT["verdict"], "certified": failed}}
    first, *rest = risks(result | {"phase_margin_deg": 20.0})
    assert first == "certified failed: the norm is above its bound"
    assert "phase margin is 20" in rest[0]
    alone = {"survives": {"state": "warned", "words": "", "set": "none", "robust_set": False}}
    assert "no [robust] set" in risks({"verdict": alone})[0]
    assert any("budget" in words for words in risks(RESULT | {"time_budget": {"ended": True}}))


def test_what_is_not_known_is_kept_and_is_no_zero() -> None:
    made = [{"name": str(i), "required": 1.0, "achieved": 0.5, "margin": 0.1 * i, "plant": "",
             "frequency_hz": None, "evidence": "judged"} for i in range(9)]  # fmt: skip
    made[8] |= {"achieved": None, "margin": None}
    found = nearest(list(bars({"requirements": made})), 3)
    assert [bar.name for bar in found] == ["0", "1", "8"]
    assert found[-1].achieved == "not known"
    assert math.isnan(found[-1].used)


def test_the_brief_names_what_is_proven_and_nothing_else() -> None:
    made = [{"name": name, "evidence": how} for name, how in
            (("S_max", "searched"), ("S_low", "proven"), ("too heavy", "judged"))]  # fmt: skip
    words = evidence({"requirements": made, "proof": {"parameters": ["gain"]}})
    assert "Proven for the whole [robust] set (gain): S_low." in words
    assert "S_max" not in words


def test_the_brief_of_a_run(two_mass_run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(two_mass_run, folder, ignore=shutil.ignore_patterns("*-wal", "*-shm"))
    assert report.main([str(folder), "--brief"]) == 0
    assert "one A4 page for a decision" in (folder / "index.html").read_text()
    run, page = read_run(folder), (folder / "brief.html").read_text()
    started = json.loads((folder / "result.json").read_text())["start"]
    assert set(started["theta"]) == set(run.problem.names)
    plain = re.sub(r"<style.*?</style>|<[^>]+>", " ", page, flags=re.DOTALL)
    text = unescape(plain).replace("\xa0", " ")
    rows = {row.name: row for row in before_and_after(run, OPTIONS)}
    assert rows["hardware cost"].after in text
    assert "Before and after" in text
    assert "Risks" in text
    assert not re.search(r"\bnan\b", text)
    for one in run.result["requirements"]:
        assert one["name"] in text
    assert "<script" not in page
    assert brief_html(run) == page


def test_what_changed_between_two_runs(two_mass_run: Path, tmp_path: Path, capsys) -> None:
    """A run against one with another case: its figure, its requirement, its line of the case."""
    folders = [tmp_path / name for name in ("before", "after")]
    for folder in folders:
        shutil.copytree(two_mass_run, folder, ignore=shutil.ignore_patterns("*-wal", "*-shm"))
    result = json.loads((folders[1] / "result.json").read_text())
    result["objective"] *= 1.25
    result["requirements"][0]["achieved"] *= 0.5
    (folders[1] / "result.json").write_text(json.dumps(result))
    case = folders[1] / "case.toml"
    case.write_text(re.sub(r"(?m)^w1 = .*$", "w1 = 3.25", case.read_text()))
    assert report.main([str(folder) for folder in folders]) == 0
    lines = capsys.readouterr().out.splitlines()
    (J,) = (line for line in lines if line.startswith("J "))
    assert J.endswith("+25.00 %")
    (bandwidth,) = (line for line in lines if line.startswith("bandwidth "))
    assert bandwidth.endswith("none")
    page = (folders[1] / "changes.html").read_text()
    assert "+objective.w1 = 3.25" in page
    assert f"{result['requirements'][0]['achieved']:.5g} of" in page
    assert "what changed from another run" in (folders[1] / "index.html").read_text()
    assert report.main([str(folders[0]), str(folders[1]), "--brief"]) == 2
