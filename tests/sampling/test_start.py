"""What a command loads before it knows that it is asked to compute, and what it writes first."""

import ast
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import surrogates
from ccd_casadi.__main__ import commands
from ccd_casadi.solve import main

ROOT = Path(__file__).parents[2]
HEAVY = ("numpy", "numba", "casadi", "scipy", "matplotlib", "sklearn", "dask", "control")
COMMANDS = sorted(commands())


def loaded(words: str) -> list[str]:
    """Which of the heavy libraries are loaded after these words."""
    words += f"\nimport json, sys; print(json.dumps([m for m in {HEAVY} if m in sys.modules]))"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    found: list[str] = json.loads(done.stdout.splitlines()[-1])
    return found


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("option", ["--help", "--workers=0"])
def test_options_are_read_before_any_library_is_loaded(command: str, option: str) -> None:
    assert loaded(f"from ccd_casadi.__main__ import main; main(['{command}', '{option}'])") == []


def test_the_names_of_surrogates_come_when_they_are_used() -> None:
    assert loaded("import surrogates") == []
    assert "scipy" not in loaded("from surrogates import latin_hypercube")


def test_type_checkers_see_the_names_of_surrogates() -> None:
    stub = ast.parse(Path(surrogates.__file__).with_suffix(".pyi").read_text())
    imported = {
        a.asname: (n.module, a.name)
        for n in ast.walk(stub)
        if isinstance(n, ast.ImportFrom)
        for a in n.names
    }
    assert sorted(imported) == sorted(surrogates.__all__)
    for name, (module, own) in imported.items():
        value = getattr(surrogates, name)
        assert value is getattr(sys.modules[str(module)], own)


def test_a_module_does_not_take_the_place_of_the_function_of_its_name() -> None:
    words = (
        "import surrogates.quality; from surrogates import extrapolation; "
        "assert callable(extrapolation)"
    )
    subprocess.run([sys.executable, "-c", words], check=True)


def test_the_result_is_reported_and_on_disk_before_the_report_is_drawn(
    two_mass_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    seen = []
    shutil.copy(two_mass_run / "samples.sqlite", tmp_path)  # nothing is sampled anew

    def drawn(folder: Path, *rest: object, **more: object) -> None:
        seen.append(((folder / "result.json").exists(), "status" in capsys.readouterr().out))

    monkeypatch.setattr("ccd_casadi.reporting.solve_page.write_report", drawn)
    case = str(ROOT / "runs" / "two_mass.toml")
    assert main([case, "--formulation", "lifted", "--workers", "1", "--out", str(tmp_path)]) == 0
    assert seen == [(True, True)]


def test_kernels_are_compiled_while_other_packages_are_installed() -> None:
    """Set-up compiles them as soon as Numba and SciPy are there: they import nothing else."""
    words = "from ccd_casadi.kernels import compilation; compilation._kernels()"
    later = {"casadi", "control", "slycot", "sklearn", "matplotlib", "jinja2", "threadpoolctl"}
    words += f"\nimport json, sys; print(json.dumps(sorted({later} & set(sys.modules))))"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout.splitlines()[-1]) == []


def test_a_solve_of_full_order_imports_no_search_of_sections() -> None:
    """What belongs to another kind, to moves or to lists is imported where it is dispatched."""
    other = (
        "codesign.catalogue", "codesign.outer_structured", "fixed_structure.local_search",
        "inner_problem.structured_search", "sampling.structured_units", "analysis.motor",
        "analysis.driven_plant", "cases.run_folder", "budget.evaluation",
    )  # fmt: skip
    words = "import sys, ccd_casadi.codesign.run, ccd_casadi.reporting.solve_page\n"
    words += f"found = {{'ccd_casadi.' + name for name in {other}}} & set(sys.modules)\n"
    subprocess.run([sys.executable, "-c", f"{words}assert not found, found"], check=True)
