"""`python -m surrogates.retrain`: exit codes, bad input, and a copy to work on."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from ccd_casadi.codesign import retraining
from ccd_casadi.codesign.retraining import LOCK, RetrainingEnd, only_job
from ccd_casadi.sampling import sampler as sampling
from ccd_casadi.support.worker_process import WorkerLost
from surrogates.retrain import main

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With a case and nothing else."""
    path = tmp_path / "run"
    path.mkdir()
    shutil.copy(ROOT / "runs" / "two_mass.toml", path / "case.toml")
    return path


def test_a_finished_run_is_retrained_in_a_copy(
    two_mass_run: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = {path.name: path.read_bytes() for path in two_mass_run.glob("*.[jth]*")}
    out = tmp_path / "out"
    words = [str(two_mass_run), "--out", str(out), "--workers", "1"]
    assert main(words) == 0
    output = capsys.readouterr().out
    assert output.startswith("verified (converged): ")
    assert output.rstrip().endswith(f"surrogate 0001 in {out}")
    found = json.loads((out / "result.json").read_text())
    old = json.loads(before["result.json"])
    assert found["objective"] == pytest.approx(old["objective"], rel=1e-6)
    assert found["formulation"] == old["formulation"]
    assert (out / "surrogate.json").read_bytes() == (out / "surrogates/0001.json").read_bytes()
    assert "<html" in (out / "report.html").read_text()[:200]

    def untouchable(*_: Any, **more: Any) -> None:
        raise AssertionError("this was sampled already")

    for name in ("inner_unit", "design_unit"):
        monkeypatch.setattr(sampling, name, untouchable)
    assert main([*words, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert json.loads((out / "result.json").read_text()) == found
    after = {path.name: path.read_bytes() for path in two_mass_run.glob("*.[jth]*")}
    assert after == before


@pytest.mark.parametrize(("status", "code"), [("infeasible", 3), ("not_verified", 4)])
def test_exit_codes(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    status: str,
    code: int,
) -> None:
    ended = RetrainingEnd(status, "budget", 3, 20, "0001")
    monkeypatch.setattr(retraining.Job, "run", lambda self, write: ended)
    assert main([str(folder), "--quiet"]) == code
    assert capsys.readouterr() == ("", f"{folder}: {status} (budget)\n")


def test_a_lost_worker_leaves_a_job_that_resumes(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(*_: Any) -> None:
        raise WorkerLost("a worker died twice")

    monkeypatch.setattr(retraining.Job, "run", lost)
    assert main([str(folder), "--quiet"]) == 130
    output, errors = capsys.readouterr()
    assert (output, len(errors.splitlines())) == ("", 1)
    assert "resumes" in errors


def test_a_second_job_is_refused_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with only_job(folder, 0):
        assert main([str(folder)]) == 2
    assert capsys.readouterr().err == (
        f"{folder / LOCK}: database is locked; wait for the job that retrains this folder, "
        "retrain a copy (--out), or where no job runs delete that file\n"
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is not valid JSON"),
        ("[]", "holds no JSON object"),
        ("{}", "truth: is None"),
        ('{"truth": "os:system"}', "truth: is 'os:system'; only \"ccd_casadi\" is known"),
        ('{"truth": "a\\u001b[2J"}', "'a\\x1b[2J'"),
        ('{"truth": "ccd_casadi", "formulation": "both"}', "formulation: 'both' is unknown"),
    ],
)
def test_a_folder_that_names_another_truth_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], text: str, words: str
) -> None:
    (folder / "truth.json").write_text(text)
    assert main([str(folder)]) == 2
    output, errors = capsys.readouterr()
    assert (output, len(errors.splitlines())) == ("", 1)
    assert errors.startswith(f"{folder / 'truth.json'}: ")
    assert words in errors


@pytest.mark.parametrize(
    "more",
    [["--budget", "0"], ["--budget", "many"], ["--tolerance", "nan"], ["--tolerance", "-1"],
     ["--workers", "0"], ["--seed", "-1"], ["--what"]],
)  # fmt: skip
def test_wrong_options_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str]
) -> None:
    assert main([str(tmp_path), *more]) == 2
    output, errors = capsys.readouterr()
    assert (output, len(errors.splitlines())) == ("", 1)
    assert more[0] in errors
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_none_or_damaged_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "absent")]) == 2
    assert "there is no such run folder" in capsys.readouterr().err
    (folder / "samples.sqlite").write_text("no samples\n" * 100)
    assert main([str(folder)]) == 2
    assert "samples.sqlite" in capsys.readouterr().err
    (folder / "case.toml").write_text("[plant]\n")
    assert main([str(folder)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    (folder / "case.toml").unlink()
    assert main([str(folder)]) == 2
    assert f"{folder / 'case.toml'}: there is no such file" in capsys.readouterr().err


def test_a_scheduler_that_is_none_is_refused_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(folder), "--scheduler", "nowhere"]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert errors.startswith("--scheduler nowhere: is not an address; give what `dask scheduler`")
