"""`python -m surrogates.retrain`: exit codes, bad input, and a copy to work on."""

import json
import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camel import Camel

import ccd_casadi.retrain as retrain_module
from ccd_casadi.codesign.retrained_run import open_run
from ccd_casadi.codesign.truth import Observations
from ccd_casadi.codesign.versions import LOCK, only_job
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.worker_process import WorkerLost
from surrogates.interface import Array
from surrogates.retrain import main

ROOT = Path(__file__).parent.parent


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], None]:
    """Install a truth under the name "camel", which every folder gets."""

    def install(make: Any) -> None:
        @contextmanager
        def opened(folder: Path, **_: Any) -> Iterator[Any]:
            yield make(folder)

        monkeypatch.setattr(retrain_module, "opener_of", lambda folder: opened)

    return install


def test_exit_codes(
    camel_copy: Path,
    tmp_path: Path,
    installed: Callable[[Any], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    installed(Camel)
    assert main([str(camel_copy), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")
    assert main([str(camel_copy)]) == 0
    assert capsys.readouterr().out.startswith("verified (converged): 0 rounds")

    class Empty(Camel):
        def _at(self, X: Array) -> Observations:
            return Observations(X, np.full((len(X), 2), np.nan))

    class Killed(Camel):
        def evaluate(self, X: Array) -> Observations:
            raise WorkerLost("a worker died twice")

    class Doubtful(Camel):
        def finish(self, *_: Any) -> str:
            return "not_verified"

    shutil.copytree(camel_copy, tmp_path / "Doubtful")
    for kind, code in ((Empty, 3), (Doubtful, 4), (Killed, 130)):
        folder = tmp_path / kind.__name__
        folder.mkdir(exist_ok=True)
        installed(kind)
        assert main([str(folder), "--quiet"]) == code
        output, errors = capsys.readouterr()
        assert output == ""
        assert len(errors.splitlines()) == 1
        assert ("resumes" in errors) == (code == 130)


def test_a_second_job_is_told_in_one_line(
    camel_copy: Path, installed: Callable[[Any], None], capsys: pytest.CaptureFixture[str]
) -> None:
    installed(Camel)
    with only_job(camel_copy, 0):
        assert main([str(camel_copy)]) == 2
    assert capsys.readouterr().err == (
        f"{camel_copy / LOCK}: database is locked; wait for the job that retrains this folder, "
        "retrain a copy (--out), or where no job runs delete that file\n"
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "is no readable JSON"),
        ("[]", "truth: is missing"),
        ('{"truth": 3}', "truth: 3 is not installed"),
        ('{"truth": "os:system"}', "truth: 'os:system' is not installed (known: ccd_casadi and"),
        ('{"truth": "../evil.py"}', "is not installed"),
        ('{"truth": "a\\u001b[2J"}', "'a\\x1b[2J' is not installed"),
    ],
)
def test_a_folder_that_names_no_known_truth_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    text: str | None,
    words: str,
) -> None:
    points = [type("Point", (), {"name": name})() for name in ("other", "camel")]
    monkeypatch.setattr(retrain_module, "entry_points", lambda group: points)
    if text is not None:
        (tmp_path / "truth.json").write_text(text)
    assert main([str(tmp_path)]) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert len(errors.splitlines()) == 1
    assert errors.startswith(f"{tmp_path / 'truth.json'}: ")
    assert words in errors


def test_an_installed_package_offers_a_truth(
    camel_copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @contextmanager
    def opened(folder: Path, **_: Any) -> Iterator[Any]:
        yield Camel(folder)

    point = type("Point", (), {"name": "camel", "load": lambda self: opened})()
    monkeypatch.setattr(retrain_module, "entry_points", lambda group: [point])
    (camel_copy / "truth.json").write_text('{"truth": "camel"}')
    assert main([str(camel_copy), "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    "more",
    [["--budget", "0"], ["--budget", "many"], ["--tolerance", "nan"], ["--tolerance", "-1"],
     ["--batch", "0"], ["--explore", "1.5"], ["--workers", "0"], ["--seed", "-1"], ["--what"]],
)  # fmt: skip
def test_wrong_options_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str]
) -> None:
    assert main([str(tmp_path), *more]) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert len(errors.splitlines()) == 1
    assert more[0] in errors
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path / "absent")]) == 2
    assert "there is no such run folder" in capsys.readouterr().err


def test_a_copy_is_retrained_and_the_run_left_alone(
    camel_copy: Path,
    tmp_path: Path,
    installed: Callable[[Any], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    installed(Camel)
    with closing(sqlite3.connect(camel_copy / "samples.sqlite")) as database, database:
        database.execute("create table t (x)")
        database.execute("insert into t values (7)")
    before = {path.name: path.read_bytes() for path in camel_copy.glob("*") if path.is_file()}
    out = tmp_path / "out"
    for _ in range(2):  # made, then gone on with
        assert main([str(camel_copy), "--out", str(out), "--quiet"]) == 0
        assert capsys.readouterr() == ("", "")
    after = {path.name: path.read_bytes() for path in camel_copy.glob("*") if path.is_file()}
    assert after == before
    with closing(sqlite3.connect(out / "samples.sqlite")) as database, database:
        assert database.execute("select x from t").fetchall() == [(7,)]


def test_a_scheduler_is_the_truths_own_business(
    camel_copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = []

    @contextmanager
    def opened(folder: Path, *, scheduler: str | None, **_: Any) -> Iterator[Any]:
        given.append(scheduler)
        if scheduler is not None:
            raise UserError(f"--scheduler {scheduler}: this truth knows no clusters")
        yield Camel(folder)

    monkeypatch.setattr(retrain_module, "opener_of", lambda folder: opened)
    assert main([str(camel_copy), "--quiet"]) == 0
    assert main([str(camel_copy), "--quiet", "--scheduler", "tcp://127.0.0.1:9"]) == 2
    assert given == [None, "tcp://127.0.0.1:9"]
    assert capsys.readouterr().err == (
        "--scheduler tcp://127.0.0.1:9: this truth knows no clusters\n"
    )


def test_a_scheduler_that_is_none_is_told_in_one_line(
    two_mass_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(two_mass_run), "--out", str(tmp_path / "run"), "--scheduler", "nowhere"]
    assert main(words) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert told.startswith("--scheduler nowhere: is no address; give what `dask scheduler`")


@pytest.mark.parametrize("formulation", ["nested", "lifted", "direct"])
def test_a_run_keeps_the_name_of_its_formulation(tmp_path: Path, formulation: str) -> None:
    """A `direct` run was called `lifted` once it had been trained again."""
    (tmp_path / "case.toml").write_text((ROOT / "runs" / "two_mass.toml").read_text())
    named = {"truth": "ccd_casadi", "formulation": formulation}
    (tmp_path / "truth.json").write_text(json.dumps(named))
    options: dict[str, Any] = {"tolerance": None, "workers": 1, "seed": 0, "quiet": True}
    with open_run(tmp_path, **options, write_page=lambda *_: None) as truth:
        truth.finish(truth.lower, (), None)
    assert json.loads((tmp_path / "result.json").read_text())["formulation"] == formulation
    assert json.loads((tmp_path / "truth.json").read_text()) == named
