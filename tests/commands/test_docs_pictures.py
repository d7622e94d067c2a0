"""The screenshots of the site: none is older than the page that it shows, none is large."""

import json
from importlib.util import module_from_spec, spec_from_file_location
from types import ModuleType

import pytest
from oracles.sources import ROOT

DOCS = ROOT / "docs"
LARGEST = 120_000  # bytes of a picture


@pytest.fixture(scope="module")
def pictures() -> ModuleType:
    """docs/pictures.py."""
    spec = spec_from_file_location("pictures", DOCS / "pictures.py")
    assert spec is not None
    assert spec.loader is not None
    made = module_from_spec(spec)
    import sys

    sys.modules["pictures"] = made  # of its dataclass
    spec.loader.exec_module(made)
    return made


def test_no_picture_is_older_than_its_page(pictures: ModuleType) -> None:
    """What fails here is drawn anew by `make pictures`."""
    stamps = json.loads((DOCS / "pictures.json").read_text())
    old = [name for name, shot in pictures.SHOTS.items()
           if stamps.get(name) != pictures.digest(shot)]  # fmt: skip
    assert old == [], f"draw them anew: python docs/pictures.py {' '.join(old)}"


def test_every_picture_is_there_small_and_shown(pictures: ModuleType) -> None:
    shown = "".join(page.read_text() for page in DOCS.glob("*.md"))
    for name in pictures.SHOTS:
        assert (DOCS / f"{name}.png").stat().st_size < LARGEST, name
        assert f"({name}.png)" in shown


def test_a_stamp_sees_what_is_drawn_and_no_comment(pictures: ModuleType, tmp_path) -> None:
    shot = pictures.Shot("", "", 0, ("one.py", "look.css"))
    (tmp_path / "look.css").write_text("a {}")

    def stamp(source: str) -> str:
        (tmp_path / "one.py").write_text(source)
        return pictures.digest(shot, tmp_path)

    first = stamp('"""Says."""\nx = 1\n')
    assert first == stamp('"""Says more."""\nx = 1  # a remark\n')
    assert first != stamp('"""Says."""\nx = 2\n')
    (tmp_path / "look.css").write_text("b {}")
    assert first != stamp('"""Says."""\nx = 1\n')
