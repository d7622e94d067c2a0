"""Bad input through the commands: one line that says what to change, and no traceback."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracles.commands import TWO_MASS, changed, run
from oracles.helpers import HZ

from ccd_casadi.inner import main as inner
from ccd_casadi.sampling import sampler as sampling
from ccd_casadi.solve import main
from ccd_casadi.support.worker_process import WorkerLost


def refusal(words: list[str], capsys: pytest.CaptureFixture[str], command: Any = main) -> str:
    """The one line on stderr of a command that refuses its input."""
    assert command(words) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.endswith("\n")
    line = errors[:-1]
    assert len(line.splitlines()) == 1
    assert line.isprintable()
    return line


FILES: dict[str, tuple[bytes | None, str]] = {
    "absent": (None, "there is no such file"),
    "empty": (b"", "plant: is missing; add a table [plant]"),
    "latin-1": (b'[plant]\nmodel = "caf\xe9"\n', "not UTF-8"),
    "broken": (b"[plant\n", "is not valid TOML"),
    "binary": (bytes(range(256)), "is not"),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("command", [main, inner], ids=["solve", "inner"])
def test_a_wrong_file_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, command: Any
) -> None:
    content, words = FILES[name]
    path = tmp_path / "bad.toml"
    if content is not None:
        path.write_bytes(content)
    more = [] if command is main else ["--theta", "m1=60,m2=60"]
    line = refusal([str(path), *more], capsys, command)
    assert line.startswith(f"{path}: ")
    assert words in line
    assert not (tmp_path / "bad").exists(), "nothing is written for a wrong file"


def test_a_folder_for_a_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "is a folder; name a case file in it" in refusal([str(tmp_path)], capsys)
    assert "name a readable file" in refusal([str(TWO_MASS / "x.toml")], capsys)


@pytest.mark.parametrize(
    ("old", "new", "key", "remedy"),
    [
        ("S_max = 1.75", "S_max = 0.9", "inner.S_max", "give more than 1"),
        ("S_max = 1.75", "S_max = nan", "inner.S_max", "give"),
        ("S_max = 1.75", "S_mx = 1.75", "inner.S_mx", "did you mean S_max?"),
        ("S_low = 0.03", 'S_low = "0.03"', "inner.S_low", "give a number"),
        ("omega_low_hz = 1.0", "omega_low_hz = -1.0", "inner.omega_low_hz", "above 0"),
        ("[10.0, 1800.0]", "[1800.0, 10.0]", "inner.omega_S_hz", "low < high"),
        ("[25.0, 1000.0]", "[25.0]", "inner.omega_T_hz", "two positive numbers"),
        ("w2 = -0.9950", "w2 = 0.9950", "objective.w2", "give a negative number"),
        ("w1 = 0.0995", "w1 = -1.0", "objective.w1", "give 0 or more"),
        ("M_K = 2e7", "", "weights.M_K", "add it"),
        ("M_K = 2e7", "M_K = true", "weights.M_K", "give a number"),
        ("gamma_backoff = 1.02", "gamma_backoff = 1", "inner.gamma_backoff", "above 1"),
        ("gamma_backoff = 1.02", "gamma_backoff = 1e9", "inner.gamma_backoff", "below 10"),
        ("omega_low_hz = 1.0", "omega_low_hz = 1e308", "inner.omega_low_hz", "in another unit"),
        ("w2 = -0.9950", "w2 = -1e308", "objective.w2", "in another unit"),
        ("w2 = -0.9950", "w2 = -1e-308", "objective.w2", "in another unit"),
        ('model = "two_mass"', 'model = "two_masses"', "plant.model", "did you mean two_mass?"),
        ('model = "two_mass"', 'function = "no.py:f"', "plant", "relative to the case file"),
        ("[theta.m1]", "[theta.mass]", "theta.mass", "known are m1, m2"),
        ("[weights]", "[wieghts]", "wieghts", "did you mean weights?"),
    ],
)
def test_a_wrong_case_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, key: str, remedy: str
) -> None:
    path = changed(tmp_path, (old, new))
    line = refusal([str(path), "--out", str(tmp_path / "run")], capsys)
    assert line.startswith(f"{path}: {key}")
    assert remedy in line
    assert not (tmp_path / "run").exists()


GOOD = (
    'dict(mass=ca.diag(ca.vertcat(t["m1"], t["m2"])), damping_ratio=0.01, input=ca.DM([1, 0]), '
    "output=ca.DM([[1, 0]]), stiffness=1e8 * ca.DM([[1, -1], [-1, 1]]), "
    'hardware_cost=t["m1"] + t["m2"])'
)


def plant_file(folder: Path, source: str) -> Path:
    (folder / "plant.py").write_text(source)
    text = re.sub(
        r'model = "two_mass".*\nzeta = .*\n', 'function = "plant.py:f"\n', TWO_MASS.read_text()
    )
    path = folder / "own.toml"
    path.write_text(text + "\n[sampling]\npoints = 2\n")
    return path


def model(result: str) -> str:
    return f"import math\nimport casadi as ca\n\ndef f(t, **options):\n    return {result}\n"


def test_a_users_plant_is_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = plant_file(tmp_path, model(GOOD))
    words = [str(path), "--theta", "m1=60,m2=60", "--omega-s-hz", "100", "--omega-t-hz", "100"]
    assert inner(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert max(answer["natural_hz"]) == pytest.approx(np.sqrt(2e8 / 60.0) / HZ, rel=1e-6)
    assert answer["hardware_cost"] == 120.0


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("import nothing_like_this\n", "cannot be loaded: ModuleNotFoundError"),
        ("def f(t: return\n", "cannot be loaded: SyntaxError"),
        ("x = 1 / 0\n", "cannot be loaded: ZeroDivisionError"),
        ('raise ValueError("two\\nlines \\x1b[31m")\n', "cannot be loaded: ValueError: two lines"),
        ("g = 1\n", "defines no function f; check plant.function"),
        ("f = 1\n", "defines no function f; check plant.function"),
        ("def f(): pass\n", "f() takes 0 positional arguments but 1 was given"),
        (model('t["m3"]'), "m3"),
        (model("1 / 0"), "ZeroDivisionError"),
        (model("undefined"), "NameError"),
        (model("None"), "plant"),
        (model("[1, 2]"), "plant"),
        (model("{}"), "returns no mass"),
        (model(GOOD + " | {'mas': 1}"), "unknown mas; drop it"),
        (model(GOOD + " | {'damping': 0}"), "either damping or damping_ratio"),
        (model(GOOD + " | {'mass': 'heavy'}"), "plant"),
        (model(GOOD + " | {'mass': ca.DM.ones(2, 3)}"), "mass"),
        (model(GOOD + " | {'stiffness': 1}"), "stiffness"),
        (model(GOOD + " | {'input': ca.DM.ones(3, 1)}"), "input"),
        (model(GOOD + " | {'damping_ratio': 2}"), "between 0 and 1"),
        (model(GOOD + " | {'damping_ratio': t['m1']}"), "damping_ratio"),
        (model(GOOD + " | {'constraints': [1]}"), "plant"),
        (model(GOOD + " | {'hardware_cost': ca.DM([1, 2])}"), "hardware_cost"),
        (model(GOOD + " | {'constraints': {'a': ca.DM([1, 2])}}"), "a is"),
    ],
)
def test_a_users_plant_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], source: str, words: str
) -> None:
    path = plant_file(tmp_path, source)
    line = refusal([str(path), "--out", str(tmp_path / "run"), "--quiet"], capsys)
    assert line.startswith(f"{path}: plant")
    assert words in line
    assert len(line) < 500
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (GOOD + " | {'mass': ca.diag(ca.vertcat(60 - t['m1'], 1))}", "mass is not positive def"),
        (GOOD + " | {'stiffness': math.nan * ca.DM.ones(2, 2)}", "is not finite at theta = m1="),
        (GOOD + " | {'stiffness': ca.DM([[1, 2], [3, 4]])}", "stiffness is not symmetric"),
        (GOOD + " | {'output': 1e200 * ca.DM([[1, 0]])}", "an entry beyond 1e+100 at theta"),
    ],
)
def test_a_plant_that_fails_at_some_theta_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], result: str, words: str
) -> None:
    path = plant_file(tmp_path, model(result))
    line = refusal([str(path), "--out", str(tmp_path / "run"), "--quiet"], capsys)
    assert words in line
    assert line.startswith(f"{path}: plant: ")


def test_a_design_that_rounding_destroys_is_not_verified(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Found by fuzzing: a plant of gain 1e12, whose loop hangs on digits that doubles lack."""
    plant = GOOD.replace("ca.DM([1, 0])", "ca.DM([[1e12, 0], [0, 0]])")
    path = plant_file(tmp_path, model(plant))
    words = ["--theta", "m1=60,m2=60", "--omega-s-hz", "56.462161732861716"]
    assert inner([str(path), *words, "--omega-t-hz", "292.4017738213266"]) == 4
    answer = json.loads(capsys.readouterr().out)
    assert answer["status"] == "not_verified"


def test_lost_workers_leave_a_run_to_be_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: Any, **more: Any) -> None:
        raise WorkerLost("a worker process died twice on the task x")

    monkeypatch.setattr(sampling, "inner_unit", killed)
    assert run(tmp_path / "run") == 130
    output, errors = capsys.readouterr()
    assert output == ""
    assert len(errors.splitlines()) == 1
    assert "died twice" in errors
    assert "the same command resumes from there" in errors


@pytest.mark.parametrize(
    ("theta", "words"),
    [
        ("m1=60", "m2 is missing; give all of m1, m2"),
        ("60,60", "not of the form name=value"),
        ("m1=60,m9=60", "'m9' is not a parameter of the case; known are m1, m2"),
        ("m1=60,m2=6o", "is not a number"),
        ("m1=60,m2=nan", "outside its bounds"),
        ("m1=60,m2=80", "outside its bounds; give 55 to 70"),
        ("m1=60,m1=60", "given twice"),
    ],
)
def test_a_wrong_theta_is_refused(
    capsys: pytest.CaptureFixture[str], theta: str, words: str
) -> None:
    line = refusal([str(TWO_MASS), "--theta", theta], capsys, inner)
    assert line.startswith(f"{TWO_MASS}: --theta: ")
    assert words in line


@pytest.mark.parametrize(
    "more", [["--omega-s-hz", "100"], ["--omega-t-hz", "100"], ["--omega-s-hz", "-1"]]
)
def test_wrong_frequencies_are_refused(capsys: pytest.CaptureFixture[str], more: list[str]) -> None:
    line = refusal([str(TWO_MASS), "--theta", "m1=60,m2=60", *more], capsys, inner)
    assert "--omega-s-hz" in line


def test_a_store_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "samples.sqlite").write_text("these are no samples\n" * 100)
    line = refusal([str(TWO_MASS), "--out", str(tmp_path)], capsys)
    assert line.startswith(f"{tmp_path / 'samples.sqlite'}: ")
    assert "choose another --out" in line


@pytest.mark.parametrize(
    "words",
    [["ccd_casadi.inner", "bad.toml", "--theta", "m1=60,m2=60"], ["ccd_casadi.solve", "own.toml"]],
)
def test_the_real_command_refuses_in_one_line(tmp_path: Path, words: list[str]) -> None:
    changed(tmp_path, ("S_max = 1.75", "S_max = 1.0")).rename(tmp_path / "bad.toml")
    plant_file(tmp_path, "import nothing_like_this\n")
    done = subprocess.run(
        [sys.executable, "-m", *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stderr.startswith(words[1] + ": ")
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_dir()) in ([], ["__pycache__"])
