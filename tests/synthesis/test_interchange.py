"""Plants and controllers through python-control and .mat: the same bandwidth on the other side."""

from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest
import scipy.io
from oracles.helpers import FlexibleCase, flexible_case

from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.interchange import (
    DesignFile,
    from_control,
    named_controller,
    named_plant,
    plant_from_control,
    read_mat,
    to_control,
    write_mat,
)
from ccd_casadi.synthesis.synthesis import synthesise

OMEGA_LOW = 2.0 * np.pi


@pytest.fixture(scope="module")
def run(two_mass_run: Path) -> FinishedRun:
    return read_run(two_mass_run)


def written(run: FinishedRun, path: Path) -> Path:
    systems = {
        "plant": named_plant(run.plant.plant_si()),
        "controller": named_controller(run.controller),
    }
    theta = dict(zip(run.problem.names, run.theta, strict=True))
    units = dict(zip(run.problem.names, run.problem.units, strict=True))
    write_mat(path, DesignFile(systems, theta, units))
    return path


def test_the_bandwidth_survives_control_and_mat(run: FinishedRun, tmp_path: Path) -> None:
    found = read_mat(written(run, tmp_path / "design.mat"))
    G = to_control(found.systems["plant"], "stage")
    K = to_control(found.systems["controller"])
    assert (G.input_labels, G.output_labels, G.name) == (["u1"], ["y1"], "stage")
    assert (K.input_labels, K.output_labels) == (["e1"], ["u1"])
    plant = plant_from_control(G, run.plant.force)
    figures = measure(
        plant, from_control(K), run.weights,
        gamma=run.figures.gamma * (1 + 1e-6), omega_low=OMEGA_LOW,
    )  # fmt: skip
    assert figures.certified
    assert figures.bandwidth == pytest.approx(run.figures.bandwidth, rel=1e-9)
    assert figures.sensitivity_peak == pytest.approx(run.figures.sensitivity_peak, rel=1e-9)
    assert found.theta == dict(zip(run.problem.names, run.theta, strict=True))
    assert found.units == {"m1": "kg", "m2": "kg"}
    # python-control's own loop crosses -3 dB there, with one minus sign and no other convention
    S = control.feedback(1, G * K)
    assert abs(S(1j * run.figures.bandwidth)) == pytest.approx(2**-0.5, rel=1e-7)


@pytest.mark.parametrize("seed", [0, 1])
def test_many_channels_survive_too(seed: int, tmp_path: Path) -> None:
    case: FlexibleCase = flexible_case(seed)
    made = synthesise(case.plant, case.weights, omega_low=OMEGA_LOW)
    assert made.figures.certified
    systems = {"G": named_plant(case.plant.plant_si()), "K": named_controller(made.controller)}
    write_mat(tmp_path / "x.mat", DesignFile(systems))
    found = read_mat(tmp_path / "x.mat").systems
    plant = plant_from_control(to_control(found["G"]), case.plant.force)
    K = from_control(to_control(found["K"]))
    figures = measure(plant, K, case.weights, omega_low=OMEGA_LOW)
    assert figures.bandwidth == pytest.approx(made.figures.bandwidth, rel=1e-9)


def test_what_matlab_reads(run: FinishedRun, tmp_path: Path) -> None:
    path = written(run, tmp_path / "design.mat")
    assert path.read_bytes().startswith(b"MATLAB 5.0")
    K = scipy.io.loadmat(path, simplify_cells=True)["controller"]
    assert set(K) == {"A", "B", "C", "D", "Ts", "InputName", "OutputName", "InputUnit",
                      "OutputUnit"}  # fmt: skip
    np.testing.assert_array_equal(K["A"], run.controller.A)
    assert (K["Ts"], K["InputName"], K["OutputName"]) == (0.0, "e1", "u1")


def test_a_foreign_file_with_the_matrices_alone(tmp_path: Path) -> None:
    parts = {"A": -np.eye(2), "B": np.ones((2, 1)), "C": np.ones((1, 2)), "D": [[0.0]]}
    scipy.io.savemat(tmp_path / "x.mat", {"G": parts, "other": 3.0})
    found = read_mat(tmp_path / "x.mat").systems
    assert list(found) == ["G"]
    G = found["G"]
    assert (G.inputs, G.outputs, G.system.period) == (("u1",), ("y1",), 0.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"A": np.eye(3)}, "sizes of A, B, C, D do not fit"),
        ({"A": np.full((2, 2), np.nan)}, r"G.A: is not a finite real matrix"),
        ({"A": "pole"}, r"G.A: is not a finite real matrix"),
        ({"B": None}, "has no B"),
        ({"Ts": -1.0}, "not a sampling period"),
    ],
)
def test_a_damaged_struct_is_named(tmp_path: Path, change: dict, words: str) -> None:
    parts = {"A": -np.eye(2), "B": np.ones((2, 1)), "C": np.ones((1, 2)), "D": [[0.0]]}
    parts = {key: value for key, value in (parts | change).items() if value is not None}
    scipy.io.savemat(tmp_path / "x.mat", {"G": parts})
    with pytest.raises(UserError, match=words) as caught:
        read_mat(tmp_path / "x.mat")
    assert "x.mat" in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"MATLAB 7.3 MAT-file" + b" " * 500, b"\x80\x04N."])
def test_no_mat_file(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.mat").write_bytes(content)
    with pytest.raises(UserError, match=r"x\.mat"):
        read_mat(tmp_path / "x.mat")
    with pytest.raises(UserError, match="no such file"):
        read_mat(tmp_path / "y.mat")


def test_what_is_no_plant(run: FinishedRun) -> None:
    plant = run.plant.plant_si()
    with pytest.raises(PlantError, match="feedthrough"):
        plant_from_control(to_control(named_plant(replace(plant, D=np.ones((1, 1))))), 2e7)
    still = StateSpace(-np.eye(1), np.zeros((1, 1)), np.ones((1, 1)), np.zeros((1, 1)))
    with pytest.raises(PlantError, match="accelerates"):
        plant_from_control(to_control(named_plant(still)), 2e7)
    with pytest.raises(UserError, match="discrete"):
        plant_from_control(control.sample_system(to_control(named_plant(plant)), 1e-3), 2e7)
    with pytest.raises(UserError, match="without a period"):
        from_control(control.ss([[0.5]], [[1]], [[1]], [[0]], True))
    with pytest.raises(UserError, match=r"control\.ss"):
        from_control(3.0)
