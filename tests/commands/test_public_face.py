"""The public face: every name is there, typed, documented with an example, and costs nothing."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

import ccd_casadi

NAMES = sorted(set(ccd_casadi.__all__) - {"__version__"})
HEAVY = ("numpy", "numba", "casadi", "matplotlib", "scipy")


# what a solve can do without until its page is drawn: a second and more to import together
LATER = ("matplotlib", "plotly", "pandas", "sklearn", "scipy.stats", "dask", "control", "gmsh")


@pytest.mark.parametrize(
    ("module", "heavy"), [("ccd_casadi", HEAVY), ("ccd_casadi.codesign.run", LATER)]
)
def test_importing_it_loads_nothing_that_can_wait(module: str, heavy: tuple[str, ...]) -> None:
    words = (
        f"import sys, json, {module}; print(json.dumps([m for m in {heavy} if m in sys.modules]))"
    )
    found = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, check=True
    )
    assert json.loads(found.stdout) == []


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_there_with_a_docstring(name: str) -> None:
    value = getattr(ccd_casadi, name)
    assert value is getattr(ccd_casadi, name)
    assert name == "HZ" or value.__doc__


def test_type_checkers_see_the_same_names() -> None:
    stub = ast.parse(Path(ccd_casadi.__file__).with_suffix(".pyi").read_text())
    imported = {
        a.asname: (n.module, a.name)
        for n in ast.walk(stub)
        if isinstance(n, ast.ImportFrom)
        for a in n.names
    }
    assert sorted(imported) == NAMES
    for name, (module, own) in imported.items():
        assert getattr(ccd_casadi, name) is getattr(sys.modules[str(module)], own)


def test_a_command_does_not_take_the_place_of_the_verb_of_its_name() -> None:
    words = (
        "import ccd_casadi, ccd_casadi.solve, sys; from ccd_casadi.solve import main; "
        "assert ccd_casadi.solve is not sys.modules['ccd_casadi.solve']; "
        "assert ccd_casadi.solve.__module__ == 'ccd_casadi.codesign.run'; "
        "assert main.__module__ == 'ccd_casadi.solve'"
    )
    subprocess.run([sys.executable, "-c", words], check=True)


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'solvent'"):
        _ = ccd_casadi.solvent  # type: ignore[attr-defined]
