"""The examples with plants of one's own: from case file to verified design, a number asserted."""

import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.extensions.imported.modal_table import read_modal_table, write_modal_table
from ccd_casadi.plants.modal import modal_plant
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.solve import main
from ccd_casadi.synthesis.closed_loop import measure

EXAMPLES = Path(__file__).parents[2] / "examples"


def solved(case: Path, folder: Path) -> FinishedRun:
    options = ["--formulation", "lifted", "--out", str(folder), "--workers", "1", "--quiet"]
    options += ["--no-report"]
    assert main([str(case), *options]) == 0
    return read_run(folder)


@pytest.mark.slow  # the tutorial has a plant of its own, too
def test_three_mass_axis_is_designed_between_its_bounds(tmp_path: Path) -> None:
    axis = Path(shutil.copytree(EXAMPLES / "three_mass_axis", tmp_path / "axis"))
    with (axis / "case.toml").open("a") as file:
        file.write("\n[outer]\nbox_points = 4\n")  # it is found before the look
    run = solved(axis / "case.toml", tmp_path / "run")
    assert run.result["status"] == "verified"
    assert run.result["bandwidth_hz"] == pytest.approx(43.753, abs=0.005)
    assert run.theta == pytest.approx((2.7567e-3, 6.3206e-3), rel=1e-3)
    assert run.result["active"][0] == "S_max"
    assert (run.plant.B.shape[1], run.plant.C.shape[0]) == (1, 1)


@pytest.mark.slow
def test_the_magnetic_axis_comes_back_on_its_whole_square_law(tmp_path: Path) -> None:
    """The example's simulation shares nothing with the package."""
    axis = Path(shutil.copytree(EXAMPLES / "magnetic_axis", tmp_path / "axis"))
    run = solved(axis / "case.toml", tmp_path / "run")
    assert run.result["status"] == "verified"
    assert {"S_max", "too weak"} <= set(run.result["active"])
    moved = runpy.run_path(str(axis / "simulate.py"))["simulate"](tmp_path / "run")
    assert np.abs(moved).max() < 2e-5
    assert np.abs(moved[200:]).max() < 1e-7


@pytest.mark.slow
def test_gantry_is_designed_from_its_table_alone_and_holds_on_the_true_model(
    tmp_path: Path,
) -> None:
    """The case stands in a folder with nothing but the table; its model is the test's judge."""
    for name in ("case.toml", "modes.csv"):
        shutil.copy(EXAMPLES / "modal_table" / name, tmp_path)
    run = solved(tmp_path / "case.toml", tmp_path / "run")
    assert run.result["bandwidth_hz"] == pytest.approx(58.833, abs=0.005)
    assert run.theta == pytest.approx((0.02, 1e-3), rel=1e-3)
    assert run.result["box_look"]["moved"], "IPOPT's starts end at 51.45 Hz, J 17 % worse"
    notes = run.result["notes"]
    assert "on the model interpolated between the 25 samples of modes.csv" in notes[0]
    assert "one of the samples, h=0.02, t=0.001" in notes[1]
    assert list(run.result["references"]) == ["the nearest sample as it stands"]
    assert run.result["references"]["the nearest sample as it stands"]["stable"]
    gantry = runpy.run_path(str(EXAMPLES / "modal_table" / "gantry.py"))
    omega, shapes, tube = gantry["modes"](*run.theta)
    assert run.result["hardware_cost"] == pytest.approx(tube, rel=1e-9)
    B = shapes[:, [0, -1]]
    none = tuple(np.zeros((0, *shape)) for shape in ((7, 7), (7, 7), (7, 7), (7, 2), (2, 7)))
    true = Mechanics(np.eye(7), np.zeros((7, 7)), np.diag(omega**2), B, B.T, 0.01, none)
    plant = scale_plant(modal_plant(true, run.problem.suspension), run.problem.weights.M_K)
    figures = measure(
        plant, run.controller, run.weights,
        omega_low=run.problem.inner.omega_low,
    )  # fmt: skip
    assert figures.certified
    assert figures.bandwidth == pytest.approx(run.figures.bandwidth, rel=5e-4)
    assert figures.sensitivity_peak == pytest.approx(run.figures.sensitivity_peak, rel=1e-3)


def test_the_shipped_table_is_what_the_script_writes(tmp_path: Path) -> None:
    gantry = runpy.run_path(str(EXAMPLES / "modal_table" / "gantry.py"))
    write_modal_table(tmp_path / "modes.csv", gantry["table"]())
    one = read_modal_table(tmp_path / "modes.csv")
    other = read_modal_table(EXAMPLES / "modal_table" / "modes.csv")
    np.testing.assert_allclose(one.omega, other.omega, rtol=1e-6)
    np.testing.assert_allclose(one.theta, other.theta)
    for a, b in ((one.inputs, other.inputs), (one.outputs, other.outputs)):
        # an eigenvector's sign, and the basis of the rigid-body modes, are the solver's choice
        np.testing.assert_allclose(np.abs(a[:, 2:]), np.abs(b[:, 2:]), rtol=1e-5, atol=1e-8)
        np.testing.assert_allclose(
            np.einsum("sim,sin->smn", a[:, :2], a[:, :2]),
            np.einsum("sim,sin->smn", b[:, :2], b[:, :2]), rtol=1e-6, atol=1e-9,
        )  # fmt: skip
