"""What a user's plant depends on is part of what it is: no store outlives a change of it."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.inner_problem.plant_source import PlantSource, digest_of, files_of, plant_from
from ccd_casadi.support.errors import UserError

PLANT = """
import numpy as np
from pathlib import Path
from helper_of_plant import stiffness
import parts_of_plant.masses

def stage(theta):
    scale = float((Path(__file__).parent / "scale.txt").read_text())
    M = scale * parts_of_plant.masses.matrix(float(theta["m"]))
    K = stiffness() * np.array([[1.0, -1.0], [-1.0, 1.0]])
    one = np.array([[1.0], [0.0]])
    return {"mass": M, "stiffness": K, "damping_ratio": 0.01, "input": one, "output": one.T,
            "hardware_cost": float(theta["m"])}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    (tmp_path / "plant.py").write_text(PLANT)
    (tmp_path / "helper_of_plant.py").write_text("def stiffness(): return 4e7\n")
    (tmp_path / "parts_of_plant").mkdir()
    (tmp_path / "parts_of_plant/__init__.py").write_text("")
    (tmp_path / "parts_of_plant/masses.py").write_text(
        "import numpy as np\ndef matrix(m): return np.diag([m, 60.0])\n"
    )
    (tmp_path / "scale.txt").write_text("1.0")
    (tmp_path / "apart.py").write_text("raise RuntimeError\n")
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def source(folder: Path) -> PlantSource:
    return PlantSource(None, str(folder / "plant.py"), "stage", ())


def test_every_file_that_it_imports_or_names_counts(folder: Path) -> None:
    names = {file.name for file in files_of(folder / "plant.py")}
    assert names == {"plant.py", "helper_of_plant.py", "__init__.py", "masses.py", "scale.txt"}
    (folder / "data").mkdir()
    (folder / "data/table.csv").write_text("1")
    assert folder / "data/table.csv" in files_of(folder / "plant.py", ["data"])
    (folder / "data/samples.sqlite").touch()  # the folder of a run, written meanwhile
    assert folder / "data/table.csv" not in files_of(folder / "plant.py", ["data"])


@pytest.mark.parametrize("name", ["plant.py", "helper_of_plant.py", "parts_of_plant/masses.py",
                                  "parts_of_plant/__init__.py", "scale.txt"])  # fmt: skip
def test_a_change_of_any_is_another_plant(folder: Path, name: str) -> None:
    before = source(folder).identity()
    place = folder / name
    place.write_text(place.read_text() + ("0" if name == "scale.txt" else "\n"))
    assert source(folder).identity() != before


def test_what_it_does_not_name_is_no_part_of_it(folder: Path) -> None:
    before = source(folder).identity()
    (folder / "apart.py").write_text("")
    (folder / "case.toml").write_text("")
    assert source(folder).identity() == before


def test_a_plant_of_one_file_keeps_the_hash_that_stores_know(folder: Path) -> None:
    import hashlib

    alone = folder / "apart.py"
    assert digest_of(files_of(alone)) == hashlib.sha256(alone.read_bytes()).hexdigest()


def test_an_edited_helper_takes_effect_in_the_same_process(folder: Path) -> None:
    def stiffness() -> float:
        plant = plant_from(source(folder), ("m",), (50.0,), (60.0,))
        return float(np.array(plant.evaluate((55.0,)).matrices[2])[0, 0])

    assert stiffness() == pytest.approx(4e7)
    (folder / "helper_of_plant.py").write_text("def stiffness(): return 5e7\n")
    assert stiffness() == pytest.approx(5e7)


def test_an_import_that_no_text_shows_is_refused(folder: Path) -> None:
    words = "import importlib\nhelper = importlib.import_module('ap' + 'art')\n"
    (folder / "apart.py").write_text("")
    (folder / "plant.py").write_text(words + PLANT)
    with pytest.raises(UserError, match=r"apart\.py by a way that its text does not show"):
        plant_from(source(folder), ("m",), (50.0,), (60.0,))
