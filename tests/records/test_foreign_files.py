"""30 example files of other programs: each is read as what it holds, or refused by its true cause.

Most come with pyYeti, ansys-mapdl-reader and SciPy as they are installed; the truth of each stands
beside it, from its name, its program's documents or another file of the same model.
"""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccd_casadi.extensions.imported.matrix_files import read_matrix
from ccd_casadi.extensions.imported.result_files import read_modes
from ccd_casadi.extensions.records.log_files import read_columns
from ccd_casadi.plants.measured import read_frequency_response
from ccd_casadi.support.errors import PlantError, UserError

KEPT = Path(__file__).parents[1] / "data" / "foreign"


def modes(path: Path) -> Any:
    found = read_modes(path)
    return len(found.frequency_hz), len(found.displacements), float(found.frequency_hz[-1])


def stiffness(path: Path) -> Any:
    found, rows = read_matrix(path.parent, path.name, "stiffness")
    return found.shape[0], found.nnz, rows is not None


def columns(path: Path) -> Any:
    found, rate, _ = read_columns(path)
    return len(found), max(map(len, found.values())), rate


YETI, MATLAB, SOUND = "pyyeti/tests", "scipy/io/matlab/tests/data", "scipy/io/tests/data"
ANSYS = "ansys/mapdl/reader/examples"
NONE = "holds no eigenvectors"
TABLE: list[tuple[str, Callable[[Path], Any], Any]] = [
    # modes: how many, at how many points, the highest frequency
    (f"{YETI}/nas2cam_csuper/assemble.op2", modes, (54, 9, None)),
    (f"{YETI}/nas2cam_extseout/full.op2", modes, (278, 49, None)),
    (f"{YETI}/nas2cam_extseout/inboard_v2007.op2", modes, (3, 2, 23.632)),
    (f"{YETI}/nastran_op2_data/rdop2gpwg_1.op2", modes, (18, 10, None)),
    (f"{YETI}/nas2cam_extseout/cant_beam.op2", modes, (4, 8222, None)),  # rigid motions alone
    (f"{YETI}/cla_test_data_2020/residual.op2", modes, "holds 2 sets of eigenvectors"),
    (f"{YETI}/nas2cam_extseout/assemble.op2", modes, "1 sets of eigenvectors and 2 of"),
    (f"{YETI}/nas2cam_extseout/cla_test_model.op2", modes, "no table LAMA of modal masses"),
    (f"{YETI}/nas2cam_extseout/nas2cam.op2", modes, NONE),  # geometry alone
    (f"{YETI}/nastran_dmig_data/matrix.op2", modes, NONE),  # matrices alone
    (f"{YETI}/nastran_op2_data/rdop2opg_1.op2", modes, NONE),  # loads alone
    (f"{ANSYS}/file.rst", modes, (6, 321, 20137.193)),
    ("uff55_translation.uff", modes, "gives no modal mass"),
    # matrices: rows, entries, whether nodes are named
    (f"{YETI}/nas2cam_csuper/inboard_mk.op4", stiffness, (32, 584, False)),
    (f"{YETI}/nas2cam_extseout/outboard.op4", stiffness, (46, 598, False)),
    (f"{YETI}/nas2cam_extseout/nas2cam.op4", stiffness, "matrices kaa, as of superelements"),
    (f"{YETI}/nastran_op4_data/ascii_fabiola.op4", stiffness, "holds maa, ll, dd"),
    (f"{YETI}/nastran_op4_data/rd.op4", stiffness, "holds r1, r2, r3"),
    (f"{YETI}/nastran_op4_data/x100000.op4", stiffness, "is (100000, 1), not square"),
    (f"{ANSYS}/file.full", stiffness, (900, None, True)),  # 963 without what is held
    (f"{MATLAB}/testsparse_7.4_GLNX86.mat", stiffness, "not square"),
    (f"{MATLAB}/testmulti_7.4_GLNX86.mat", stiffness, "save one matrix"),
    # records: signals, samples, the rate
    ("twincat_scope.csv", columns, (20, None, None)),
    (f"{SOUND}/test-8000Hz-le-2ch-1byteu.wav", columns, (2, 800, 8000.0)),
    (f"{SOUND}/test-44100Hz-2ch-32bit-float-le.wav", columns, (2, 441, 44100.0)),
    (f"{SOUND}/test-8000Hz-le-3ch-5S-24bit.wav", columns, (3, 5, 8000.0)),
    (f"{SOUND}/test-8000Hz-le-1ch-1byte-ulaw.wav", columns, "cannot be read as WAV"),
    (f"{MATLAB}/testdouble_7.4_GLNX86.mat", columns, (1, 9, None)),
    (f"{MATLAB}/test3dmatrix_7.4_GLNX86.mat", columns, "is not one signal"),
    (f"{MATLAB}/testcell_7.4_GLNX86.mat", columns, "holds no"),
    # responses for `tune`
    (f"{MATLAB}/testhdf5_7.4_GLNX86.mat", read_frequency_response, "name f_hz and re, im"),
    (f"{MATLAB}/teststruct_7.4_GLNX86.mat", read_frequency_response, "struct: holds no numbers"),
    ("twincat_scope.csv", read_frequency_response, "twincat_scope.csv"),
]  # fmt: skip


def place(name: str) -> Path:
    if "/" not in name:
        return KEPT / name
    package, _, rest = name.partition("/")
    spec = find_spec(package)
    if spec is None:
        pytest.skip(f"{package} is not installed")
    roots = [Path(root) for root in spec.submodule_search_locations or ()]
    path = next((root / rest for root in roots if (root / rest).exists()), None)
    if path is None:
        pytest.skip(f"{package} was installed without its examples")
    return path


def test_there_are_thirty() -> None:
    assert len({name for name, *_ in TABLE}) >= 30


@pytest.mark.parametrize(
    ("name", "read", "truth"), TABLE, ids=[f"{r.__name__}-{Path(n).name}" for n, r, _ in TABLE]
)
@pytest.mark.filterwarnings("ignore::scipy.io.wavfile.WavFileWarning")
def test_it_is_read_as_what_it_holds(name: str, read: Callable[[Path], Any], truth: Any) -> None:
    path = place(name)
    if "hdf5" in name:
        pytest.importorskip("h5py")
    if isinstance(truth, str):
        with pytest.raises((PlantError, UserError)) as caught:
            read(path)
        assert truth in str(caught.value)
        assert len(str(caught.value).splitlines()) == 1
        return
    for found, known in zip(read(path), truth, strict=True):
        assert known is None or found == (known if isinstance(known, int | bool) else
                                          pytest.approx(known, rel=1e-4))  # fmt: skip


def test_two_forms_of_one_matrix_are_one() -> None:
    """As text and as binary words, of another program's test."""
    folder = place(f"{YETI}/nastran_op4_data/rd.op4").parent
    text, binary = (read_matrix(folder, f"{name}_fabiola.op4:maa", "mass")[0]
                    for name in ("ascii", "binary"))  # fmt: skip
    np.testing.assert_allclose(text.toarray(), binary.toarray(), rtol=1e-7)
