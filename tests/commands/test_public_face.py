"""The public face: every name is there, typed, documented with an example, and costs nothing."""

import ast
import inspect
import json
import subprocess
import sys
from enum import Enum
from pathlib import Path
from types import ModuleType

import griffe
import pytest

import ccd_casadi
import surrogates

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


def documented(module: ModuleType) -> list[tuple[str, object]]:
    """What of a package takes parameters: no enumerations and errors."""
    found = ((name, getattr(module, name)) for name in module.__all__)
    return [(name, each) for name, each in found if callable(each)
            and not (isinstance(each, type) and issubclass(each, Exception | Enum))]  # fmt: skip


@pytest.mark.parametrize("module", [ccd_casadi, surrogates])
def test_sections_of_a_docstring_name_what_the_signature_does(module: ModuleType) -> None:
    wrong = {}
    for name, each in documented(module):
        parsed = griffe.Docstring(inspect.getdoc(each) or "").parse("numpy", warnings=False)
        sections = {section.kind.value: section.value for section in parsed}
        signature = inspect.signature(each)
        named = sorted(item.name for item in sections.get("parameters", []))
        if named != sorted(signature.parameters):
            wrong[name] = f"{named} instead of {sorted(signature.parameters)}"
        elif inspect.isfunction(each) and signature.return_annotation is not None:
            wrong |= {} if "returns" in sections else {name: "no returns"}
    assert wrong == {}


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
