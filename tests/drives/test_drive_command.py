"""`ccd drive` and [drive] in a case: what is written, and what is refused by name."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccd_casadi.cases.case import parse_case, read_toml
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.check import main as check
from ccd_casadi.deploy import main as deploy
from ccd_casadi.drive import main
from ccd_casadi.extensions.drives.cascade_rows import split
from ccd_casadi.extensions.drives.drive_case import drive_problem
from ccd_casadi.extensions.drives.drive_design import rigid_mass
from ccd_casadi.support.errors import UserError

EXAMPLE = Path(__file__).parents[2] / "examples/drive_bench/case.toml"


def changed(**tables: dict[str, Any]) -> dict[str, Any]:
    data = read_toml(EXAMPLE)
    for name, table in tables.items():
        data[name] = {**data.get(name, {}), **table}
    return data


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"drive": {"name": "sinamics"}}, "beckhoff_ax5000"),
        ({"drive": {"name": "pi_e727"}}, "its PID is not designed"),
        ({"drive": {"filters": 5}}, "has 4 filters of the current"),
        ({"drive": {"velocity": "spindle"}}, "one of motor, load"),
        ({"drive": {"position_rate_hz": 3000.0}}, "no whole part of loop.rate_hz"),
        ({"drive": {"position_rate_hz": 2.0}}, "at most twice inner.omega_low_hz"),
        (
            {"inner": {"compliance_max": 1e-5}, "drive": {"position_rate_hz": 2000.0}},
            "compliance_max does not go with a slower position loop",
        ),
        ({"controller": {"weighted_level": 2.0}}, "weighted_level"),
    ],
)
def test_what_does_not_go_with_a_drive_is_named(
    tables: dict[str, dict[str, Any]], words: str
) -> None:
    with pytest.raises(UserError, match=words):
        drive_problem(parse_case(changed(**tables), EXAMPLE))


FEED = EXAMPLE.parents[1] / "feed_drive/case.toml"


def test_a_force_at_the_table_is_bounded_on_plants_that_vary() -> None:
    found = drive_problem(parse_case(read_toml(FEED), FEED))
    assert found.uncertain.names[2:] == ("theta.at", "theta.load")
    assert found.bounds.compliance_max == 1.6e-8
    assert found.ported is not None
    plant = found.ported.plant(found.ported.nominal).plant_si()
    _, drive, counted = split(plant, found.cascade)
    w = 1e-3
    moved = counted @ np.linalg.solve(1j * w * np.eye(len(plant.A)) - plant.A, drive)
    mass = rigid_mass(found.uncertain, found.cascade.position)
    assert abs(moved[0, 0]) * w**2 == pytest.approx(1.0 / mass, rel=1e-3)


def test_a_force_that_nothing_bounds_is_named() -> None:
    data = read_toml(FEED)
    del data["inner"]["compliance_max"]
    with pytest.raises(UserError, match="without inner"):
        drive_problem(parse_case(data, FEED))


def test_other_commands_refuse_a_case_with_a_drive(capsys: pytest.CaptureFixture[str]) -> None:
    """But `check`, whose next step is `ccd drive`."""
    with pytest.raises(UserError, match="ccd drive"):
        problem_of(parse_case(read_toml(EXAMPLE), EXAMPLE))
    assert check([str(FEED)]) == 0
    words = capsys.readouterr().out
    assert "every load from 0 to 300 kg" in words
    assert words.splitlines()[-1].startswith("next")
    assert "drive " in words.splitlines()[-1]


def test_the_command_writes_a_sheet_and_says_what_is_proven(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    today = tmp_path / "today.toml"
    today.write_text('p1417 = 500\n"speed controller P gain Kp" = 12\n', "utf-8")
    text = EXAMPLE.read_text("utf-8").replace("filters = 3", "filters = 1", 1)
    plant = f"function = {str(EXAMPLE.parent / 'plant.py') + ':bench'!r}"
    text = text.replace('function = "plant.py:bench"', plant).replace("S_low = 0.1", "S_low = 0.3")
    case = tmp_path / "case.toml"
    case.write_text(text, "utf-8")
    out = tmp_path / "run"
    strange = tmp_path / "strange.toml"
    strange.write_text("p1417 = 500\nKp = 12\n", "utf-8")
    assert main([str(case), "--today", str(strange), "--out", str(out)]) == 2
    assert "Kp is no parameter of this drive: " in capsys.readouterr().err
    code = main([str(case), "--starts", "1", "--today", str(today), "--out", str(out)])
    answer = json.loads((out / "drive.json").read_text())
    assert code == (0 if answer["status"] == "verified" else 4)
    failed = [line for line in answer["verdict"].values() if line["state"] == "failed"]
    assert (answer["status"] == "verified") == (not failed)
    assert len(answer["parameters"]) == 13
    assert answer["following_error"]["m"] < 0.2 * answer["following_error"]["without_m"]
    sheet = (out / "sheet.txt").read_text("utf-8")
    assert "p1417" in sheet
    assert "500" in sheet
    assert f"load = {answer['theta']['load']:.5g} kg" in sheet
    for place in ("motor", "load", "actuator"):
        share = answer["judge"]["shares"][f"S_max of {place}"]
        assert f"{2.0 * share:.4g} (limit 2) at {place}" in sheet
    page = (out / "report.html").read_text("utf-8")
    assert "|S| is below -3 dB up to" in page  # where the shape binds, |S| crosses -3 dB later
    for line in sheet.splitlines():  # what the sheet says of the design, the page says too
        if line.startswith(("peaks of S", "decision", "margins", "filters", "encoder")):
            assert line[20:] in page
    assert page.count("Re L (–)") >= 3  # a Nyquist plot at each place
    for row in answer["parameters"]:  # each block of the diagram, as the drive names and writes it
        assert f"{row['number']} {row['name'].split(', ')[-1]}".strip() in page
        assert f">{row['value']:.10g}<" in page
    assert [row["today"] for row in answer["parameters"]].count(None) == 11
    assert deploy([str(out)]) == 2
    assert "the folder is of `ccd drive`" in capsys.readouterr().err
    assert "cascade_step" in (out / "cascade.c").read_text("utf-8")
