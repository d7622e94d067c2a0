"""Modal tables and sampled matrices as plants: against the models that they were made of."""

import runpy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few
from scipy.io import mmwrite, savemat
from scipy.linalg import eigh
from scipy.sparse import coo_array, csc_array, save_npz

from ccd_casadi.cases.case import CaseError, load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.extensions.imported.interpolation import ANY, InterpolatedModes
from ccd_casadi.extensions.imported.modal_table import (
    ModalTable,
    frames,
    read_modal_table,
    write_modal_table,
)
from ccd_casadi.extensions.imported.sampled_plant import modes_of, plant_of_table, reduced_table
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.plants.plant import Mechanics, mechanics
from ccd_casadi.support.errors import PlantError

EXAMPLE = Path(__file__).parents[2] / "examples" / "modal_table"
gantry = runpy.run_path(str(EXAMPLE / "gantry.py"))
THETA = np.linspace(0.0, 1.0, 9)


def veering(coupling: float, theta: np.ndarray = THETA, seed: int = 0) -> ModalTable:
    """Three grounded masses; the second's frequency passes the first's as θ grows. Signs random."""
    rng = np.random.default_rng(seed)
    omega, shapes = [], []
    for t in theta:
        K = np.diag([1e6, 1e6 * (0.6 + 0.8 * t), 9e6])
        K[0, 1] = K[1, 0] = coupling * 1e6
        lam, modes = eigh(K)
        omega.append(np.sqrt(lam))
        shapes.append(modes * rng.choice([-1.0, 1.0], 3))
    shapes = np.array(shapes).transpose(0, 2, 1)  # (sample, mode, mass)
    N = len(theta)
    return ModalTable(
        names=("t",), input_names=("u",), output_names=("y", "z"), constraint_names=("a",),
        theta=theta[:, None], omega=np.array(omega), zeta=np.full((N, 3), 0.02),
        inputs=shapes[:, :, :1] + 0.5 * shapes[:, :, 2:], outputs=shapes[:, :, :2] + 0.0,
        shapes=shapes, cost=1.0 + 2.0 * theta, constraints=(theta - 3.0)[:, None],
    )  # fmt: skip


NONE: Any = ()  # no derivatives


@cache
def veering_modes(coupling: float, modal: bool = True) -> InterpolatedModes:
    table = veering(coupling)
    if not modal:
        table = replace(table, zeta=table.zeta * np.array([1.0, 2.0, 3.0]) * (1 + table.theta))
    return InterpolatedModes(table, 1.0)


def response(system: Any, s: complex) -> np.ndarray:
    return system.C @ np.linalg.solve(system.K + s**2 * system.M, system.B)


@pytest.mark.parametrize("coupling", [0.0, 0.005, 0.02, 0.1])
def test_veering_and_crossing_modes_are_interpolated(coupling: float) -> None:
    """Response and frequencies between samples, where modes exchange their shapes."""
    modes = veering_modes(coupling)
    assert modes.left_out.frequency < 1e-3
    for t in np.linspace(0.02, 0.98, 25):
        row = veering(coupling, np.array([t]))
        B, C = row.inputs[0], row.outputs[0].T
        true = Mechanics(np.eye(3), np.eye(3), np.diag(row.omega[0] ** 2), B, C, None, NONE)
        found = modes([t])
        np.testing.assert_allclose(
            np.sqrt(np.linalg.eigvalsh(found.K)), np.sqrt(np.diag(true.K)), rtol=2e-4
        )
        for w in (500.0, 950.0, 1100.0, 2500.0):
            one, other = (response(item, (0.1 + 1j) * w) for item in (true, found))
            assert np.abs(one - other).max() < 5e-3 * np.abs(one).max()


def test_what_the_signs_in_the_table_are_does_not_matter() -> None:
    one, other = (InterpolatedModes(veering(0.02, seed=seed), 1.0)([0.37]) for seed in (1, 2))
    for w in (500.0, 1000.0):
        np.testing.assert_allclose(
            response(one, (0.1 + 1j) * w), response(other, (0.1 + 1j) * w), rtol=1e-6
        )


def test_modes_by_frequency_alone_would_not_do() -> None:
    """The frame chosen is better by far than the naive one: the choice is worth its trouble."""
    table, modes = veering(0.02), veering_modes(0.02)
    assert modes.frame.name == "modes matched, close ones turned together"
    naive = modes._fit(frames(table, 0)[0])
    assert naive[0].name == "modes in order of frequency"
    assert naive[2].response > 10.0 * modes.left_out.response


@few(max_examples=15)
@given(st.floats(0.05, 0.95), st.booleans())
def test_derivatives_are_those_of_the_interpolated_plant(t: float, modal: bool) -> None:
    modes = veering_modes(0.02, modal)
    assert (modes.ratio is not None) == modal
    h = 1e-4
    here, ends = modes([t]), [modes([t + s * h]) for s in (-2, -1, 1, 2)]
    for k, name in enumerate("MDKBC"):
        a, b, c, d = (getattr(item, name) for item in ends)
        slope = (a - 8.0 * b + 8.0 * c - d) / (12.0 * h)
        size = np.abs(getattr(here, name)).max() + 1e-300
        np.testing.assert_allclose(here.derivatives[k][0] / size, slope / size, atol=1e-7)


def scattered(seed: int) -> ModalTable:
    """Eight samples at random, of modes that have nothing to do with one another."""
    rng = np.random.default_rng(seed)
    table = veering(0.02, np.sort(rng.uniform(0.0, 1.0, 8)), seed)
    inputs, outputs = rng.standard_normal((8, 3, 1)), rng.standard_normal((8, 3, 2))
    return replace(table, inputs=inputs, outputs=outputs, shapes=inputs,
                   omega=np.sort(rng.uniform(1e3, 5e3, (8, 3)), axis=1))  # fmt: skip


@pytest.mark.parametrize("table", [veering(0.02), *map(scattered, range(3))])
def test_at_a_sample_the_plant_is_that_sample(table: ModalTable) -> None:
    """Frequencies and residues, whatever the samples are; and beside it what its slopes say."""
    modes = InterpolatedModes(table, 1.0)
    for s, theta in enumerate(table.theta):
        found = modes(theta)
        lam, turn = eigh(found.K)
        np.testing.assert_allclose(np.sqrt(lam), table.omega[s], rtol=1e-9)
        residues = np.einsum("pr,rm->rpm", found.C @ turn, turn.T @ found.B)
        own = np.einsum("rp,rm->rpm", table.outputs[s], table.inputs[s])
        np.testing.assert_allclose(residues, own, atol=1e-9 * np.abs(own).max())
        h = 1e-5
        ends = [modes(theta + sign * h) for sign in (-1, 1)]
        for k, name in enumerate("MDKBC"):
            slope = (getattr(ends[1], name) - getattr(ends[0], name)) / (2.0 * h)
            size = np.abs(getattr(found, name)).max() + np.abs(slope).max() + 1e-300
            np.testing.assert_allclose(found.derivatives[k][0] / size, slope / size, atol=1e-4)


def test_what_samples_do_not_settle_is_refused_but_at_samples() -> None:
    """By the sample, the mode, and the sample to add, which lies between two."""
    table = scattered(0)
    plant = plant_of_table(table, ("t",), 0.1, "modes.csv")
    words = plant.unknown_between
    assert "left out, is predicted" in words
    assert "in the frequency of mode" in words
    more = float(words.split("add a sample at t=")[1].split(",")[0])
    assert table.theta.min() < more < table.theta.max()
    assert np.abs(table.theta - more).min() > 0.0
    mechanics(plant, tuple(table.theta[3]))
    with pytest.raises(PlantError, match="at a sample, such as t="):
        mechanics(plant, (more,))
    assert not plant_of_table(table, ("t",), 0.1, "m", ANY).unknown_between


def test_one_sample_twice_is_refused() -> None:
    table = veering(0.02, np.array([0.0, 0.5, 0.5, 1.0]))
    with pytest.raises(PlantError, match="two samples are at the same theta"):
        InterpolatedModes(table, 1.0)


def test_a_written_table_is_read_back(tmp_path: Path) -> None:
    table = veering(0.02)
    write_modal_table(tmp_path / "modes.csv", table)
    found = read_modal_table(tmp_path / "modes.csv")
    for name in ("theta", "omega", "zeta", "inputs", "outputs", "shapes", "cost", "constraints"):
        np.testing.assert_allclose(getattr(found, name), getattr(table, name), rtol=1e-14)
    assert (found.names, found.constraint_names) == (("t",), ("a",))


def test_modal_mass_scales_shapes_and_remarks_are_skipped(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(
        "# shapes scaled to 1\nt,mode,frequency_hz,damping,modal_mass,in:u,out:y\n"
        "0,1,10,0.01,4,1,1\n1,1,20,0.01,4,1,-1\n"
    )
    table = read_modal_table(tmp_path / "m.csv")
    np.testing.assert_allclose(table.inputs[:, 0, 0], 0.5)
    np.testing.assert_allclose(table.outputs[:, 0, 0], [0.5, -0.5])


HEAD = "t,mode,frequency_hz,damping,in:u,out:y\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no rows"),
        (HEAD, "holds no rows"),
        (HEAD.replace("damping,", "") + "0,1,1,1,1\n", "has no column damping"),
        (HEAD.replace("in:u", "out:z") + "0,1,1,0.1,1,1\n", "has no column in:NAME"),
        (HEAD.replace("t,", "") + "1,1,0.1,1,1\n", "no column of theta"),
        (HEAD + "0,1,1,0.1,1\n", "line 2: has 5 columns, the header 6"),
        (HEAD + "0,1,fast,0.1,1,1\n", "line 2: frequency_hz: 'fast' is not a number"),
        (HEAD + "0,1,nan,0.1,1,1\n", "line 2: frequency_hz: 'nan' is not finite"),
        (HEAD + "0,1,-1,0.1,1,1\n", "frequency_hz: is negative"),
        (HEAD + "0,1,1,1.5,1,1\n", "damping: is 1.5"),
        (HEAD + "0,1,1,.1,1,1\n0,2,2,.1,1,1\n1,1,1,.1,1,1\n", "sample t = 1 has 1 modes"),
        (HEAD + "0,1,0,.1,1,1\n1,1,5,.1,1,1\n", "rigid-body modes"),
        (HEAD + "0,1,5,0,1,1\n1,1,5,0,1,1\n", "no damping"),
        (HEAD.replace("out:y", "in:u") + "0,1,1,.1,1,1\n", "empty or twice"),
    ],
)
def test_a_wrong_table_is_reported(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(PlantError, match=r"m\.csv: ") as caught:
        plant_of_table(read_modal_table(tmp_path / "m.csv"), ("t",), 0.1, "m.csv")
    assert words in str(caught.value)


def case(folder: Path, *changes: tuple[str, str]) -> Path:
    text = (EXAMPLE / "case.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "case.toml").write_text(text)
    (folder / "modes.csv").write_bytes((EXAMPLE / "modes.csv").read_bytes())
    return folder / "case.toml"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("upper = 0.05\n", "upper = 0.06\n", "theta.h: its bounds 0.02 to 0.06 go beyond"),
        ('table = "modes.csv"', "", "plant.table: is missing"),
        ('table = "modes.csv"', 'table = "m.csv"', "there is no 'm.csv'"),
        ('table = "modes.csv"', "table = 3", "plant.table: is 3"),
        ("[theta.h]", "[theta.height]", "has the parameters h, t, the case height, t"),
        ("rigid_modes = 2", "rigid_modes = 3", "2 rigid-body modes at the start"),
    ],
)
def test_a_wrong_case_of_a_table_is_reported(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    with pytest.raises(CaseError) as caught:
        problem_of(load_case(case(tmp_path, (old, new))))
    assert words in str(caught.value)


def test_check_and_solve_refuse_what_inner_designs_at_a_sample(tmp_path: Path) -> None:
    path = case(tmp_path, ('"modes.csv"', '"modes.csv"\nfrequency_error = 1e-6'))
    with pytest.raises(CaseError, match=r"modes\.csv: the samples do not settle the plant"):
        problem_of(load_case(path))
    problem = problem_of(load_case(path), at_a_sample=True)
    with pytest.raises(PlantError, match="the samples do not settle"):
        mechanics(plant_of(problem), problem.start + np.array([1e-3, 0.0]))


def test_samples_belong_to_the_content_of_the_table_not_to_its_place(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    one = problem_of(load_case(case(tmp_path)))
    other = problem_of(load_case(case(tmp_path / "other")))
    assert one.identity() == other.identity()
    assert "modes.csv" not in str(one.identity())
    with (tmp_path / "other" / "modes.csv").open("a") as file:
        file.write("# checked\n")
    assert one.identity() != other.identity()


# ---- matrices at samples ----------------------------------------------------------------------


def matrix_folder(folder: Path) -> Path:
    """The gantry's matrices at nine samples, in three formats."""
    rows = ["h,t,mass,stiffness,damping,hardware_cost"]
    for i, h in enumerate((0.02, 0.03, 0.04)):
        for j, t in enumerate((1e-3, 2e-3, 3e-3)):
            M, K, tube = gantry["matrices"](h, t)
            name = f"{i}{j}"
            if j == 0:
                names = [f"M{name}.mtx", f"K{name}.mtx"]
                for matrix, file in ((M, names[0]), (K, names[1])):
                    mmwrite(folder / file, coo_array(matrix), symmetry="symmetric", precision=17)
            elif j == 1:
                names = [f"M{name}.npz", f"K{name}.npz"]
                save_npz(folder / names[0], csc_array(M))
                np.savez(folder / names[1], K=K)
            else:
                names = [f"M{name}.mat", f"K{name}.mat"]
                savemat(folder / names[0], {"M": csc_array(M)})
                savemat(folder / names[1], {"K": K})
            rows.append(f"{h},{t},{names[0]},{names[1]},0.01,{tube}")
    (folder / "index.csv").write_text("\n".join(rows) + "\n")
    (folder / "dofs.csv").write_text(
        "kind,name,dof\nin,left,0\nin,right,48\nout,left,0\nout,right,48\n"
    )
    return folder


def test_matrices_become_the_table_of_their_modes(tmp_path: Path) -> None:
    table = reduced_table(matrix_folder(tmp_path), 5)
    assert table.names == ("h", "t")
    assert table.shapes.shape == (9, 5, 10)
    for s, (h, t) in enumerate(table.theta):
        omega, shapes, tube = gantry["modes"](h, t)
        np.testing.assert_allclose(table.omega[s, 2:], omega[2:5], rtol=1e-6)
        np.testing.assert_allclose(
            np.abs(table.inputs[s, 2:]), np.abs(shapes[2:5][:, [0, -1]]), rtol=1e-4
        )
        assert table.cost[s] == pytest.approx(tube)
    plant = plant_of_table(table, ("t", "h"), 0.1, "fe")
    system = mechanics(plant, (1.5e-3, 0.033))
    omega, _, tube = gantry["modes"](0.033, 1.5e-3)
    error = np.abs(np.sqrt(np.linalg.eigvalsh(system.K)[2:]) / omega[2:5] - 1.0).max()
    assert 0.0 < error < 2.0 * plant.evaluate.left_out.frequency < 0.1  # told: the right size
    assert float(plant.hardware([1.5e-3, 0.033])[0]) == pytest.approx(tube, rel=1e-6)


def test_static_correction_restores_the_compliance_that_truncation_loses() -> None:
    M, K, _ = (np.array(item) for item in gantry["matrices"](0.03, 2e-3))
    K = K + 1e4 * np.eye(len(K))  # held, so that there is a static compliance
    force = np.zeros((len(K), 1))
    force[12] = 1.0
    exact = (force.T @ np.linalg.solve(K, force)).item()

    def compliance(extra: np.ndarray | None) -> float:
        omega, basis = modes_of(csc_array(M), csc_array(K), 4, extra)
        return float(((basis.T @ force)[:, 0] ** 2 / omega**2).sum())

    assert abs(compliance(None) / exact - 1.0) > 1e-4
    assert compliance(force) == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("index.csv", None, "index.csv: cannot be read"),
        ("dofs.csv", "kind,name,dof\nin,u,5000\nout,y,0\n", "5000 is not a row of a matrix of 50"),
        ("dofs.csv", "kind,name,dof\nin,u,0\n", "names no out"),
        ("dofs.csv", "kind,name,dof\nforce,u,0\n", "needs the columns kind"),
        ("M00.mtx", "nonsense", "M00.mtx: is neither Matrix Market nor"),
        ("M00.mtx", "%%MatrixMarket matrix coordinate real general\n2 2 1\n1 2 3.0\n",
         "is not symmetric"),
        ("M01.npz", "nonsense", "M01.npz: cannot be read"),
        ("M02.mat", "nonsense", "M02.mat: cannot be read"),
    ],
)  # fmt: skip
def test_wrong_files_are_reported(tmp_path: Path, file: str, text: str | None, words: str) -> None:
    folder = matrix_folder(tmp_path)
    if text is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(text)
    with pytest.raises(PlantError) as caught:
        reduced_table(folder, 5)
    assert words in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_a_pickled_matrix_is_refused(tmp_path: Path) -> None:
    folder = matrix_folder(tmp_path)
    np.savez(folder / "M01.npz", M=np.array([object()]))
    with pytest.raises(PlantError, match=r"M01.npz: cannot be read: .*pickle"):
        reduced_table(folder, 5)


def test_a_case_names_a_folder_of_matrices(tmp_path: Path) -> None:
    folder = tmp_path / "fe"
    folder.mkdir()
    matrix_folder(folder)
    path = case(
        tmp_path,
        ('model = "modal_table"', 'model = "sampled_matrices"'),
        ('table = "modes.csv"', 'folder = "fe"\nmodes = 5'),
        ("upper = 0.05\n", "upper = 0.04\n"),
    )
    problem = problem_of(load_case(path))
    before = problem.identity()
    (folder / "dofs.csv").write_text((folder / "dofs.csv").read_text() + "# moved\n")
    assert problem.identity() != before
