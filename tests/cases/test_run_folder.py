"""A finished run read back: the same design, and one line for what is missing or wrong."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import read_run
from ccd_casadi.codesign.outer_problem import FormulationResult
from ccd_casadi.codesign.result import write_run
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.support.errors import UserError

EXAMPLES = Path(__file__).parents[2] / "examples"


def edited(folder: Path, name: str, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / name
    found = json.loads(path.read_text())
    change(found)
    path.write_text(json.dumps(found))


def test_the_design_is_measured_again_as_it_was_written(two_mass_run: Path) -> None:
    run = read_run(two_mass_run)
    assert run.figures.certified
    result = json.loads((two_mass_run / "result.json").read_text())
    assert run.figures.bandwidth / (2 * 3.141592653589793) == pytest.approx(
        result["bandwidth_hz"], rel=1e-12
    )
    assert run.figures.gamma == pytest.approx(result["gamma"], rel=1e-9)
    assert run.theta == tuple(result["theta"].values())


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("controller.json", lambda c: c["A"].pop(), "A"),
        ("controller.json", lambda c: c.pop("B"), "B: is not a matrix"),
        ("controller.json", lambda c: c["D"][0].__setitem__(0, None), "D: is not a finite matrix"),
        ("controller.json", lambda c: c["D"][0].__setitem__(0, 1e9), "not certified"),
        ("result.json", lambda r: r.update(status="infeasible"), "no feasible design"),
        ("result.json", lambda r: r["theta"].update(m1=1.0), "theta.m1: is outside"),
        ("result.json", lambda r: r["theta"].update(m1="x"), "theta.m1"),
        ("result.json", lambda r: r["theta"].pop("m1"), "theta: does not name m1, m2"),
        ("result.json", lambda r: r.update(gamma=float("nan")), "gamma: is not a positive number"),
        (
            "result.json",
            lambda r: r.update(omega_S_hz=-1.0),
            "omega_S_hz: is not a positive number",
        ),
    ],
)
def test_what_was_changed_is_named(
    two_mass_run: Path, tmp_path: Path, name: str, change: Callable[..., object], words: str
) -> None:
    folder = Path(
        shutil.copytree(
            two_mass_run, tmp_path / "run", ignore=shutil.ignore_patterns("*-shm", "*-wal")
        )
    )
    edited(folder, name, change)
    with pytest.raises(UserError, match=words) as caught:
        read_run(folder)
    assert str(folder / name) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["controller.json", "result.json"])
@pytest.mark.parametrize("text", [b"", b"[1]", b"{", b"\xff\xfe", b"[" * 100000])
def test_a_damaged_file_is_named(
    two_mass_run: Path, tmp_path: Path, name: str, text: bytes
) -> None:
    folder = Path(
        shutil.copytree(
            two_mass_run, tmp_path / "run", ignore=shutil.ignore_patterns("*-shm", "*-wal")
        )
    )
    (folder / name).write_bytes(text)
    with pytest.raises(UserError, match="make the run again"):
        read_run(folder)
    (folder / name).unlink()
    with pytest.raises(UserError, match="there is no such file"):
        read_run(folder)


def test_a_folder_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not a folder"):
        read_run(tmp_path / "nothing")


def test_a_run_folder_needs_no_other_file(tmp_path: Path) -> None:
    """For who gets the folder alone: the plant's code and the options of other plants are in it."""
    own = Path(shutil.copytree(EXAMPLES / "two_axes", tmp_path / "own"))
    with (own / "case.toml").open("a") as file:
        file.write('\n[robust]\nplants = ["plants/off_centre.toml"]\n')
    case = load_case(own / "case.toml")
    known = problem_of(case).identity()
    (tmp_path / "run").mkdir()
    solution = Solution({"formulation": "direct"}, FormulationResult(), None)
    write_run(tmp_path / "run", case, solution)
    shutil.rmtree(own)
    there = load_case(shutil.move(tmp_path / "run", tmp_path / "sent") / "case.toml")
    assert there.robust.plants == ({"offset": 0.02},)
    assert problem_of(there).identity() == known
    (tmp_path / "sent" / "plant.py").unlink()
    with pytest.raises(UserError, match=r"plant\.function: there is no"):
        load_case(there.path)


@pytest.mark.parametrize(
    ("changed", "words"),
    [({"gamma": 1e3}, "norm_bound: is 1000, and a synthesis reaches"), ({}, "S_max = 1.5 of")],
)
def test_what_a_file_claims_is_not_relied_on(
    two_mass_run: Path, tmp_path: Path, changed: dict[str, float], words: str
) -> None:
    """A γ that no synthesis needs, and an S_max of the case that the loop does not keep."""
    for name in ("case.toml", "result.json", "controller.json"):
        (tmp_path / name).write_text((two_mass_run / name).read_text())
    result = json.loads((tmp_path / "result.json").read_text()) | changed
    (tmp_path / "result.json").write_text(json.dumps(result))
    if not changed:
        text = (tmp_path / "case.toml").read_text()
        assert "S_max = 1.75" in text
        (tmp_path / "case.toml").write_text(text.replace("S_max = 1.75", "S_max = 1.5"))
    with pytest.raises(UserError, match=words):
        read_run(tmp_path)
