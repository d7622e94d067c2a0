"""The deployed controller as an FMU: FMPy finds nothing wrong, and it computes what the C does."""

import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from test_deploy_code import of_one_channel, random_controller

from ccd_casadi.deploy import main
from ccd_casadi.deployment.realisation import Realisation, difference_equation, with_anti_windup
from ccd_casadi.deployment.source_code import c_files
from ccd_casadi.extensions.formats.code_formats import FLAGS, compile_library, write_fmu
from ccd_casadi.support.errors import UserError

fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed")
from fmpy.fmi2 import FMU2Slave  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

with_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
PERIOD = 1e-4


def controller(share: float | None = None) -> Realisation:
    """Three channels, limited to a share of its largest force."""
    plain = of_one_channel(random_controller(5, 3, 2, 3))
    if share is None:
        return plain
    errors = 1e-6 * np.random.default_rng(7).normal(size=(200, 3))
    limit = share * float(np.abs(difference_equation(plain, errors)).max())
    return with_anti_windup(Realisation(plain.system, plain.blocks, limit), 500.0)


def written(folder: Path, found: Realisation) -> Path:
    files = c_files(found, title="a <stage>", delay=PERIOD, verified=True)
    assert write_fmu(folder / "controller.fmu", found, files, "a <stage>")
    return folder / "controller.fmu"


@with_compiler
@pytest.mark.parametrize("steps", [1, 4], ids=["a period", "a quarter of it"])
@pytest.mark.parametrize("share", [None, 0.3])
def test_it_computes_what_the_difference_equation_does(
    tmp_path: Path, steps: int, share: float | None
) -> None:
    """Inputs change between samples: only those at the instants count."""
    found = controller(share)
    path = written(tmp_path, found)
    assert not validate_fmu(str(path))
    described = fmpy.read_model_description(str(path))
    number = {v.name: v.valueReference for v in described.modelVariables}
    e, f, u = ([number[f"{letter}{i}"] for i in (1, 2, 3)] for letter in "efu")
    rng = np.random.default_rng(1)
    errors = 1e-6 * rng.normal(size=(steps * 300, 3))
    forward = rng.normal(size=errors.shape)
    slave = FMU2Slave(
        guid=described.guid, modelIdentifier=described.coSimulation.modelIdentifier,
        unzipDirectory=fmpy.extract(str(path), str(tmp_path / "fmu")), instanceName="K",
    )  # fmt: skip
    slave.instantiate()
    start = 0.7  # s
    for _ in range(2):  # and again after a reset
        slave.setupExperiment(startTime=start)
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        forces = []
        for k in range(len(errors)):
            slave.setReal(e, errors[k].tolist())
            slave.setReal(f, forward[k].tolist())
            slave.doStep(start + k * PERIOD / steps, PERIOD / steps)
            forces.append(slave.getReal(u))
        expected = difference_equation(found, errors[::steps], forward[::steps])
        np.testing.assert_array_equal(forces, np.repeat(expected, steps, axis=0))
        slave.reset()
    slave.terminate()
    slave.freeInstance()


@with_compiler
def test_another_tool_simulates_it_with_long_steps(tmp_path: Path) -> None:
    found = controller()
    path = written(tmp_path, found)
    t = np.arange(0.0, 0.0205, 0.001)
    error = 1e-6
    signals = np.array([(time, error) for time in t], dtype=[("time", float), ("e2", float)])
    result = fmpy.simulate_fmu(
        str(path), stop_time=0.02, output_interval=0.001, input=signals, output=["u1", "u2", "u3"]
    )
    constant = np.tile([0.0, error, 0.0], (200, 1))
    expected = difference_equation(found, constant)[9::10]
    forces = np.array([result[name] for name in ("u1", "u2", "u3")]).T
    np.testing.assert_array_equal(forces[1:], expected)


@with_compiler
def test_it_compiles_without_a_warning_and_is_always_the_same(tmp_path: Path) -> None:
    path = written(tmp_path, controller(0.3))
    first = path.read_bytes()
    assert written(tmp_path, controller(0.3)).read_bytes() == first
    with zipfile.ZipFile(path) as file:
        file.extractall(tmp_path / "again")
    made = subprocess.run(
        ["cc", *FLAGS, "-Wall", "-Wextra", "-pedantic", "-Werror", "controller.c", "fmu.c"],
        cwd=tmp_path / "again/sources", capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr


def test_without_a_compiler_the_sources_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = controller()
    files = c_files(found, title="x", delay=PERIOD, verified=True)
    monkeypatch.setenv("CC", "no-such-compiler")
    assert not write_fmu(tmp_path / "controller.fmu", found, files, "x")
    with zipfile.ZipFile(tmp_path / "controller.fmu") as file:
        names = set(file.namelist())
    assert {"modelDescription.xml", "sources/controller.c", "sources/fmu.c"} < names
    assert not any(name.startswith("binaries") for name in names)


@with_compiler
def test_a_compiler_that_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(UserError, match="does not compile the FMU"):
        compile_library({"controller.c": "int x"})


@with_compiler
def test_deploy_leaves_one_when_required(two_mass_run: Path, tmp_path: Path) -> None:
    options = [str(two_mass_run), "--rate-hz", "16000", "--quiet"]
    assert main([*options, "--out", str(tmp_path / "with"), "--fmu"]) == 0
    assert not validate_fmu(str(tmp_path / "with/controller.fmu"))
