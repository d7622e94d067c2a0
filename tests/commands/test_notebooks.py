"""The notebooks run from top to bottom in an empty folder, and say what their text says."""

from pathlib import Path
from typing import Any

import pytest

nbformat = pytest.importorskip("nbformat", reason="nbclient is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")

FOLDER = Path(__file__).resolve().parents[2] / "examples/notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))


def outputs(notebook: Any) -> str:
    """All text and HTML that its cells left."""
    found = []
    for cell in notebook.cells:
        for item in cell.get("outputs", ()):
            data = item.get("data", {})
            found.append(item.get("text", "") + data.get("text/html", data.get("text/plain", "")))
    return "\n".join(found)


def executed(name: str, folder: Path) -> str:
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", 4)
    client = nbclient.NotebookClient(
        notebook, timeout=None, resources={"metadata": {"path": str(folder)}}
    )
    client.execute()  # raises where a cell does
    return outputs(notebook)


@pytest.mark.parametrize("name", NAMES)
def test_it_is_stored_without_outputs(name: str) -> None:
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", 4)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert cell.outputs == []
            assert cell.execution_count is None


@pytest.mark.filterwarnings("ignore")  # of zmq and the kernel, which are not ours
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("case_study_1", ("58.12", "✓ certified", "! verified", "71.932 Hz", "0.7071")),
        pytest.param(
            "own_stage",
            ("plate too thin for the motor", "verified", "20 % less: stable True"),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "robust_sections",
            ("-1.0 %: UNSTABLE", "stable and within every bound on 100 plants"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_it_runs_and_says_what_its_text_does(
    name: str, said: tuple[str, ...], tmp_path: Path
) -> None:
    found = executed(name, tmp_path).replace("\u00a0", " ")  # a unit stays with its number
    for words in said:
        assert words in found
