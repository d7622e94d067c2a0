"""The planar stage of the examples: a coupled 3 x 3 plant from case file to verified design."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import find_channels
from ccd_casadi.solve import main

EXAMPLE = Path(__file__).parents[2] / "examples" / "planar_stage"


pytestmark = pytest.mark.slow  # another example is solved in test_own_examples


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    """The example without the global check over the box, half the work for nothing."""
    folder = tmp_path_factory.mktemp("planar") / "run"
    copy = Path(shutil.copytree(EXAMPLE, folder.parent / "example"))
    with (copy / "case.toml").open("a") as stream:
        stream.write("\n[outer]\nbox_points = 0\n")
    options = ["--formulation", "lifted", "--out", str(folder), "--workers", "1", "--quiet"]
    assert main([str(copy / "case.toml"), *options]) == 0
    return read_run(folder)


def test_design_is_what_the_readme_says(finished: FinishedRun) -> None:
    result = json.loads((finished.folder / "result.json").read_text())
    assert result["status"] == "verified"
    assert result["bandwidth_hz"] == pytest.approx(95.54, abs=0.01)
    assert finished.theta == pytest.approx((16.177e-3, 1.1696e-3), rel=1e-4)
    assert {"S_max", "plate bending"} <= set(result["active"])


def test_axes_are_coupled_and_three_are_rigid(finished: FinishedRun) -> None:
    modal = modal_plant(
        mechanics(plant_of(finished.problem), finished.theta), finished.problem.suspension
    )
    assert modal.rigid.sum() == 3
    assert len(find_channels(modal.K, modal.D, modal.B, modal.C)) == 1
    assert finished.plant.plant_si().B.shape == (12, 3)


def test_total_mass_is_what_the_rigid_modes_feel(finished: FinishedRun) -> None:
    """f counts the plate and the legs; with the payload that is what a force along x moves."""
    system = mechanics(plant_of(finished.problem), finished.theta)
    shift = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    assert shift @ system.M @ shift == pytest.approx(finished.result["hardware_cost"] + 3.0)
    assert np.abs(system.K @ shift).max() < 1e-9 * np.abs(system.K).max()
