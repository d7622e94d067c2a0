"""Matrices and modes in the files of Nastran, ANSYS and Abaqus, some written by the programs."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import mmwrite
from scipy.sparse import csc_array

from ccd_casadi.extensions.imported import main
from ccd_casadi.extensions.imported.matrix_files import MATRIX_FORMATS, read_matrix
from ccd_casadi.extensions.imported.modal_table import read_modal_table
from ccd_casadi.extensions.imported.result_files import RESULT_FORMATS, read_modes
from ccd_casadi.extensions.imported.sampled_plant import modes_of
from ccd_casadi.support.errors import PlantError

NODES = ((4, 1), (4, 2), (11, 1), (11, 3), (7, 6))


def a_matrix(seed: int) -> np.ndarray:
    X = np.random.default_rng(seed).normal(size=(5, 5))
    return np.asarray(X @ X.T + np.eye(5))


def abaqus(M: np.ndarray, triangle: str = "both") -> str:
    rows = [f"{a},{i}, {b},{j}, {M[p, q]:.17e}" for p, (a, i) in enumerate(NODES)
            for q, (b, j) in enumerate(NODES)
            if triangle == "both" or (p >= q if triangle == "lower" else p <= q)]  # fmt: skip
    return "** written by a test\n*MATRIX INPUT, NAME=K\n" + "\n".join(rows) + "\n"


def coordinate(M: np.ndarray) -> str:
    return "".join(f"{i + 1} {j + 1} {M[i, j]:.17e}\n" for i in range(5) for j in range(5))


def harwell_boeing(M: np.ndarray) -> str:
    """The lower triangle in fixed columns that touch each other."""
    entries = [(i, M[i, j]) for j in range(5) for i in range(j, 5)]
    starts = np.cumsum([1, *(5 - j for j in range(5))])
    pointers = "".join(f"{s:8d}" for s in starts)
    indices = [f"{i + 1:8d}" for i, _ in entries]
    values = [f"{v:25.16E}".replace("E", "D") for _, v in entries]
    index_lines = ["".join(indices[k : k + 10]) for k in range(0, 15, 10)]
    value_lines = ["".join(values[k : k + 3]) for k in range(0, 15, 3)]
    body = [pointers, *index_lines, *value_lines]
    head = [
        f"{'A stiffness':72s}KEY     ",
        f"{len(body):14d}{1:14d}{len(index_lines):14d}{len(value_lines):14d}{0:14d}",
        f"RSA{'':11s}{5:14d}{5:14d}{15:14d}{0:14d}",
        f"{'(10I8)':16s}{'(10I8)':16s}{'(3D25.16)':20s}{'':20s}",
    ]
    return "\n".join([*head, *body]) + "\n"


@pytest.mark.parametrize("name", ["lower", "upper", "both", "coordinate", "rsa", "market"])
def test_every_text_of_a_matrix_gives_it_back(tmp_path: Path, name: str) -> None:
    M = a_matrix(3)
    path = tmp_path / ("K.rsa" if name == "rsa" else "K.mtx")
    if name == "market":
        mmwrite(path, csc_array(M), symmetry="symmetric", precision=17)
    else:
        texts = {"coordinate": coordinate, "rsa": harwell_boeing}
        path.write_text(texts[name](M) if name in texts else abaqus(M, name))
    found, rows = read_matrix(tmp_path, path.name, "stiffness")
    order = list(range(5))
    if name in ("lower", "upper", "both"):
        # Abaqus names degrees of freedom: nodes in order, and their directions
        assert rows == {(4, "x"): 0, (4, "y"): 1, (7, "rz"): 2, (11, "x"): 3, (11, "z"): 4}
        order = [0, 1, 4, 2, 3]
    else:
        assert rows is None
    np.testing.assert_allclose(found.toarray(), M[np.ix_(order, order)], rtol=1e-15)


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("K.mtx", "1 2 3 4\n", "neither Matrix Market nor Abaqus"),
        ("K.rsa", harwell_boeing(a_matrix(0)).replace("RSA", "CSA"), "is CSA, not a real"),
        ("K.rsa", harwell_boeing(a_matrix(0)).replace("            15", "            16", 1),
         "not those that its header counts"),
        ("K.odb", "", "is not a matrix file that is read: .mtx (Matrix Market, Abaqus)"),
    ],
)  # fmt: skip
def test_a_matrix_that_cannot_be_read_names_its_cause(
    tmp_path: Path, file: str, text: str, words: str
) -> None:
    (tmp_path / file).write_text(text)
    with pytest.raises(PlantError) as caught:
        read_matrix(tmp_path, file, "stiffness")
    assert words in str(caught.value)


def test_forces_are_named_by_node_and_direction(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    K, M = a_matrix(1), a_matrix(2)
    rows = ["h,mass,stiffness,damping,hardware_cost"]
    for k, h in enumerate((1.0, 2.0)):
        (tmp_path / f"M{k}.mtx").write_text(abaqus(M, "lower"))
        (tmp_path / f"K{k}.mtx").write_text(abaqus(h * K, "upper"))
        rows.append(f"{h},M{k}.mtx,K{k}.mtx,0.01,1")
    (tmp_path / "index.csv").write_text("\n".join(rows) + "\n")
    dofs = "kind,name,node,direction,gain\nin,f,11,z,1\nout,y,7,rz,2\n"
    (tmp_path / "dofs.csv").write_text(dofs)
    assert main([str(tmp_path), "--quiet", "--modes", "5"]) == 0
    table = read_modal_table(tmp_path / "modes.csv")
    # the static compliance does not depend on the order of rows: 2 e7ᵀ K⁻¹ e11
    compliance = (table.inputs[0, :, 0] * table.outputs[0, :, 0] / table.omega[0] ** 2).sum()
    assert compliance == pytest.approx(2.0 * np.linalg.inv(K)[4, 3], rel=1e-9)
    (tmp_path / "dofs.csv").write_text(dofs.replace("11,z", "11,y"))
    assert main([str(tmp_path)]) == 2
    assert "y of node 11 is not in the matrices; it has x, z" in capsys.readouterr().err
    (tmp_path / "dofs.csv").write_text(dofs)
    (tmp_path / "M1.mtx").write_text(abaqus(M, "lower").replace("11,3", "11,2"))
    assert main([str(tmp_path)]) == 2
    assert "its degrees of freedom are not those of the stiffness" in capsys.readouterr().err


def test_every_format_is_in_the_documents() -> None:
    page = (Path(__file__).parents[2] / "docs" / "own_finite_elements.md").read_text()
    for ending in (*MATRIX_FORMATS, *RESULT_FORMATS):
        assert f"`{ending}`" in page, ending


def test_ansys_modes_and_matrices() -> None:
    """The cantilever and the free beam that come with the reader: frequencies of its manual."""
    reader = pytest.importorskip("ansys.mapdl.reader.examples")
    folder = Path(reader.__file__).parent
    (K, rows), (M, other) = (read_matrix(folder, "file.full", key)
                             for key in ("stiffness", "mass"))  # fmt: skip
    assert rows is not None
    assert rows == other
    hz = modes_of(M, K, 6)[0] / (2.0 * np.pi)
    np.testing.assert_allclose(hz[:4], [1283.20037, 1283.20037, 5781.97486, 6919.39888], rtol=1e-7)
    free = read_modes(folder / "file.rst")
    assert free.frequency_hz[0] == pytest.approx(7366.49504, rel=1e-8)
    # its mesh is that of the cantilever, whose held nodes are missing in the matrices: of modes
    # of unit mass the rest is a little less, and modes are orthogonal
    shapes = np.zeros((len(hz), M.shape[0]))
    for (node, direction), row in rows.items():
        shapes[:, row] = free.displacements[node][:6, "xyz".index(direction)]
    masses = shapes @ (M @ shapes.T)
    assert (np.diag(masses) > 0.9).all()
    assert (np.diag(masses) <= 1.0).all()


def test_nastran_modes_and_matrices_agree() -> None:
    """A superelement of pyYeti's: the op4 has six rigid motions and motions without mass."""
    tests = Path(pytest.importorskip("pyyeti").__file__).parent / "tests" / "nas2cam_csuper"
    (K, _), (M, _) = (read_matrix(tests, f"inboard_mk.op4:{name}", role)
                      for name, role in (("KXX", "stiffness"), ("MXX", "mass")))  # fmt: skip
    assert repr(np.float64(0.1)) == "np.float64(0.1)"  # which pyYeti changes for a whole program
    again, _ = read_matrix(tests, "inboard_mk.op4", "stiffness")
    assert abs(again - K).max() == 0.0
    hz = modes_of(M, K, 12)[0] / (2.0 * np.pi)
    assert (hz[:6] < 1e-2).all()
    assert hz[6] > 1.0
    assert np.linalg.eigvalsh(M.toarray()).min() < 1e-9
    # the machine of this superelement and another, assembled, and the same model in one piece
    assembled, whole = (read_modes(tests.parent / name).frequency_hz
                        for name in ("nas2cam_csuper/assemble.op2", "nas2cam_extseout/full.op2"))
    assert (assembled[:6] < 1e-2).all()
    np.testing.assert_allclose(assembled[6:14], whole[6:14], rtol=0.01)


def test_universal_modes_with_masses_are_read(tmp_path: Path) -> None:
    """Dataset 55 as pyuff writes it, of modal masses; without them the scale is not known."""
    pyuff = pytest.importorskip("pyuff")
    rng = np.random.default_rng(0)
    shapes, masses, hz = rng.normal(size=(2, 3, 3)), (4.0, 0.25), (20.0, 10.0)
    for k in range(2):
        pyuff.UFF(str(tmp_path / "m.uff")).write_sets({
            "type": 55, "id1": "x", "id2": "x", "id3": "x", "id4": "x", "id5": "x",
            "model_type": 1, "analysis_type": 2, "data_ch": 2, "spec_data_type": 8, "data_type": 2,
            "n_data_per_node": 3, "load_case": 0, "mode_n": k + 1, "freq": hz[k],
            "modal_m": masses[k], "modal_damp_vis": 0.0, "modal_damp_his": 0.0,
            "node_nums": [3, 5, 8], **{f"r{i + 1}": shapes[k, :, i] for i in range(3)},
        }, "overwrite" if k == 0 else "add")  # fmt: skip
    found = read_modes(tmp_path / "m.uff")
    np.testing.assert_allclose(found.frequency_hz, [10.0, 20.0])
    np.testing.assert_allclose(found.displacements[5][:, :3],
                               [shapes[1, 1] / 0.5, shapes[0, 1] / 2.0], rtol=1e-4)  # fmt: skip
    foreign = Path(__file__).parents[1] / "data" / "foreign" / "uff55_translation.uff"
    with pytest.raises(PlantError, match="gives no modal mass"):
        read_modes(foreign)
