"""Kernels are compiled once, with words, and nothing that a command needs is left out."""

import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core import event, types
from oracles.helpers import HZ, OMEGA_LOW, PAPER, flexible_case, two_mass

from ccd_casadi.kernels import compilation
from ccd_casadi.kernels.gamma import plant_gain
from ccd_casadi.kernels.riccati_synthesis import synthesise as search
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.derivatives import sensitivities
from ccd_casadi.synthesis.synthesis import sweep, synthesise


class Compiled(event.Listener):
    """Kernels of the package that are compiled, not read from disk."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def on_start(self, event: Any) -> None:
        pass

    def on_end(self, event: Any) -> None:
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("ccd_casadi"):
            self.names.append(f"{function.__module__}.{function.__name__}")


def test_what_the_set_up_compiles_is_all_that_the_library_calls() -> None:
    """One channel and several, each layer that calls a kernel, and the second attempt."""
    compilation.ensure_compiled()
    with event.install_listener("numba:compile", Compiled()) as found:
        weights = PAPER.at(300.0 * HZ, 60.0 * HZ)
        for plant in (two_mass(57.0, 61.0), flexible_case(3).plant):
            design = synthesise(plant, weights, omega_low=OMEGA_LOW)
            sensitivities(plant, weights, omega_low=OMEGA_LOW)
            sweep(plant, weights, np.array([200.0, 300.0]) * HZ, np.array([60.0]) * HZ,
                  omega_low=OMEGA_LOW)  # fmt: skip
            measure(plant, design.controller, weights, gamma=2.0, omega_low=OMEGA_LOW)
            numbers = (plant.grid, plant_gain(plant.A, plant.B, plant.C, plant.grid), 1.02, 0.0)
            search(plant.A, plant.B, plant.C, weights.scale(plant.omega_0), *numbers, True)
    assert isinstance(design.controller, StateSpace)
    assert found.names == []


def _parts(made: types.Type) -> list[types.Type]:
    parts = [*made] if isinstance(made, types.BaseTuple) else []
    return [made, *(part for inside in parts for part in _parts(inside))]


def test_no_kernel_returns_a_named_tuple_to_python() -> None:
    """Numba asks Python for its class and does not look whether Ctrl-C came first: signal 11."""
    for part in compilation.PARTS:
        compilation.compile_part(part)
    returned = {
        (name, part)
        for name, kernel in compilation._kernels().items()
        for made in kernel.overloads.values()
        for part in _parts(made.signature.return_type)
    }
    assert "ccd_casadi.kernels.riccati_synthesis._prepare" in {name for name, _ in returned}
    assert {name for name, part in returned if isinstance(part, types.BaseNamedTuple)} == set()


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place on disk that holds no kernel; what would compile them says how often it was asked."""
    monkeypatch.setattr(compilation, "_folder", lambda: tmp_path / "place")
    monkeypatch.setattr(compilation, "_kernels", dict)
    return tmp_path / "place"


def test_the_first_to_come_compiles_with_words_and_the_second_does_not(
    empty: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    required: list[int] = []
    monkeypatch.setattr(compilation, "_compile", lambda *given: required.append(given[-1]) or True)
    compilation.ensure_compiled()
    said = capsys.readouterr().err
    assert "compiling" in said
    assert " s on " in said
    assert said.count("\n") == 1
    compilation.ensure_compiled()
    assert len(required) == 1
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(compilation, "_state", lambda: "another version of numba")
    compilation.ensure_compiled()
    assert len(required) == 2


def test_a_job_compiles_the_group_that_it_needs_and_the_other_when_that_is_needed(
    empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    required: list[tuple[str, ...]] = []
    monkeypatch.setattr(compilation, "_compile", lambda *given: required.append(given[2]) or True)
    compilation.ensure_compiled("synthesis")
    assert compilation.is_compiled("synthesis")
    assert not compilation.is_compiled("loops")
    compilation.ensure_compiled()
    compilation.ensure_compiled("loops")
    assert required == [*compilation.GROUPS.values()]


def test_the_parts_of_a_group_call_every_kernel_of_its_modules() -> None:
    """And none of the other group, which would be compiled twice."""
    groups = {compilation.group_of(name.rpartition(".")[0]) for name in compilation._kernels()}
    assert groups == {*compilation.GROUPS, ""}
    assert {f"ccd_casadi.kernels.{name}" for name in compilation.LOOPS} <= {
        name.rpartition(".")[0] for name in compilation._kernels()
    }


@pytest.mark.parametrize("how", ["ends badly", "interrupted", "no process"])
def test_what_was_not_finished_is_not_taken_for_finished(
    how: str, empty: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ended(*_: object) -> bool:
        if how == "interrupted":
            raise KeyboardInterrupt
        if how == "no process":
            raise OSError("no memory")
        return False

    monkeypatch.setattr(compilation, "_compile", ended)
    if how == "interrupted":
        with pytest.raises(KeyboardInterrupt):
            compilation.ensure_compiled()
    else:
        compilation.ensure_compiled()
    assert ("no memory" in capsys.readouterr().err) == (how == "no process")
    required: list[int] = []
    monkeypatch.setattr(compilation, "_compile", lambda *given: required.append(given[-1]) or True)
    compilation.ensure_compiled()
    assert len(required) == 1


def test_two_programs_do_not_compile_the_same(
    empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, waits, go = threading.Event(), threading.Event(), threading.Event()
    required: list[object] = []

    def slowly(*reported: object) -> bool:
        required.append(reported[-1])
        started.set()
        return go.wait(30.0)

    def hear(words: str) -> None:
        if "waiting" in words:
            waits.set()

    monkeypatch.setattr(compilation, "_compile", slowly)
    monkeypatch.setattr(compilation, "_say", hear)
    first = threading.Thread(target=compilation.ensure_compiled)
    second = threading.Thread(target=compilation.ensure_compiled)
    first.start()
    assert started.wait(30.0)
    second.start()
    assert waits.wait(20.0)
    assert second.is_alive()
    go.set()
    first.join(30.0)
    second.join(30.0)
    assert len(required) == 1


def test_a_source_that_changes_meanwhile_is_compiled_again(
    empty: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stamp named the sources as they were at the end: what was compiled were others."""
    state, required = ["before"], []

    def edited(*reported: int) -> bool:
        required.append(reported[-1])
        state[0] = "after"
        return True

    monkeypatch.setattr(compilation, "_state", lambda: state[0])
    monkeypatch.setattr(compilation, "_compile", edited)
    for _ in range(3):
        compilation.ensure_compiled()
    assert len(required) == 2


COUNTED = """
from importlib import import_module
from pkgutil import iter_modules
from ccd_casadi import kernels
from ccd_casadi.kernels import compilation

counted = set(compilation._kernels())
for module in iter_modules(kernels.__path__):
    if module.name != "__main__":
        import_module(f"{kernels.__name__}.{module.name}")
print(*sorted(set(compilation._kernels()) - counted))
"""


def test_the_bar_counts_every_kernel_of_the_package() -> None:
    """In a process of its own: one that only other imports bring would pass here unseen."""
    done = subprocess.run(
        [sys.executable, "-c", COUNTED], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == ""
