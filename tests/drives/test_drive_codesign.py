"""Machine and cascade together: the best θ is a design of its own, and better than the start."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from ccd_casadi.cases.case import parse_case, read_toml
from ccd_casadi.drive import main
from ccd_casadi.extensions.drives import drive_case
from ccd_casadi.extensions.drives.cascade_rows import SearchOptions
from ccd_casadi.extensions.drives.cascade_search import Search
from ccd_casadi.extensions.drives.drive_case import (
    DriveAt,
    DriveCodesignOptions,
    DriveProblem,
    codesign_drive,
    drive_problem,
)
from ccd_casadi.extensions.drives.drive_design import DriveOptions, first_points, plants_at
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.plants.plant import hardware_cost
from ccd_casadi.support.errors import UserError

EXAMPLE = Path(__file__).parents[2] / "examples/drive_bench/case.toml"
FEW = DriveCodesignOptions(
    evaluations=4,
    drive=DriveOptions(search=SearchOptions(starts=2, stages=((1.0, 8),), steps=6, points=40)),
)


def problem(minimise: str = "") -> DriveProblem:
    data = read_toml(EXAMPLE)
    data["drive"]["filters"], data["drive"]["setpoint_filters"] = 1, 0
    data["inner"]["S_low"] = 0.3
    if minimise:
        data["inner"]["minimise"], data["objective"]["w2"] = minimise, 0.005
        data["plant"]["sensor"] = "load"
        del data["controller"]["bandwidth_of"], data["controller"]["channel"]
        del data["drive"]["velocity"]
        data["budget"] = {"force": {"unit": "N^2/Hz", "level": 1e-6}}
    return drive_problem(parse_case(data, EXAMPLE))


def test_the_best_theta_is_better_and_its_cascade_meets_the_bounds_there() -> None:
    drive = problem()
    first, best = codesign_drive(drive, options=FEW)
    own = drive.problem
    assert best.objective <= first.objective
    assert all(a <= b <= c for a, b, c in zip(own.lower, best.theta, own.upper, strict=True))
    cost = hardware_cost(plant_of(own), best.theta)
    assert best.objective == own.w1 * cost + own.w2 * best.candidate.bandwidth
    uncertain = uncertain_plant(own, best.theta)
    plants = plants_at(uncertain, first_points(uncertain))
    search = Search(drive.cascade, drive.bounds, drive.sampling, plants, FEW.drive.search)
    assert search.stable(best.candidate.values)
    _, excess = search.judge(best.candidate.values)
    assert excess < 10.0 * FEW.drive.search.met


def test_another_figure_than_the_bandwidth_is_refused() -> None:
    with pytest.raises(UserError, match="counts the bandwidth"):
        codesign_drive(problem("rms_error"), options=FEW)


def test_no_start_is_said() -> None:
    drive = problem()
    hopeless = replace(drive, bounds=replace(drive.bounds, S_low=1e-6))
    with pytest.raises(UserError, match="no cascade"):
        codesign_drive(hopeless, options=FEW)


def test_theta_is_fixed_or_searched(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(EXAMPLE), "--theta", "load=0.0771", "--codesign"]) == 2
    assert "give one of both" in capsys.readouterr().err


@pytest.mark.parametrize(("least", "there_is"), [(0.0785, True), (0.09, False)])
def test_a_start_that_breaks_a_constraint_is_no_answer(
    least: float, there_is: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where J is smallest there: the cascades are not searched here, J = f(θ)."""
    text = (EXAMPLE.parent / "plant.py").read_text("utf-8")
    held = f'"constraints": {{"heavy": {least} - load}}'
    (tmp_path / "plant.py").write_text(text.replace('"constraints": {}', held), "utf-8")
    drive = drive_problem(parse_case(read_toml(EXAMPLE), tmp_path / "case.toml"))

    def designed(drive: DriveProblem, theta: tuple[float, ...], *rest: Any) -> DriveAt:
        return DriveAt(theta, theta[0], theta[0], SimpleNamespace(bandwidth=1.0), 1.0)  # type: ignore[arg-type]

    monkeypatch.setattr(drive_case, "_design", designed)
    if there_is:
        assert codesign_drive(drive)[1].theta[0] >= least - 1e-6
        return
    with pytest.raises(UserError, match="meets the constraints"):
        codesign_drive(drive)
