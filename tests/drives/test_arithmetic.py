"""The program of a cascade is a simulation that is written apart, and its C, to the bit."""

import ctypes
import shutil
import subprocess
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from oracles import drive_simulation as oracle

from ccd_casadi.extensions.drives.cascade import (
    ArithmeticOptions,
    Cascade,
    Program,
    following_error,
    program_of,
)
from ccd_casadi.extensions.drives.drive_data import Number, read_drive
from ccd_casadi.lti.loop import zoh
from ccd_casadi.lti.state_space import StateSpace as Plant

RATE = 8000.0
GAINS = (250.0, 31.25, 0.02)
FILTERS = [(423.0, 0.61, 433.0, 0.7), (1089.0, 0.802, 1664.0, 0.555), (178.0, 0.5, 600.0, 0.6)]


def cascade(name: str) -> Cascade:
    drive = read_drive(name)
    slots = (*drive.places("current")[:2], *drive.places("setpoint")[:1])
    if len(slots) < 3:
        slots = drive.places("current")[:3]
    return Cascade(drive, 1.0 / RATE, slots, 1, 0, 2)


AHEAD = (0.97, 0.11)  # of the velocity, and kg


def program(name: str, slower: int = 1, ahead: tuple[float, float] = AHEAD) -> Program:
    own = replace(cascade(name), slower=slower)
    return program_of(own, np.array([*GAINS, *np.ravel(FILTERS)]), ahead)


def signals(count: int = 600) -> np.ndarray:
    rng = np.random.default_rng(3)
    moved = np.cumsum(rng.integers(-9, 10, (count, 3)), axis=0) * 3.8e-9 * 40.0  # counts
    moved[:, 0] = 1e-6 * (np.arange(count) > 20)
    return moved


def simulated(name: str, slower: int = 1) -> list:
    number = read_drive(name).number
    count = len(cascade(name).slots), len(read_drive(name).places("setpoint")[:1])
    real = np.float32 if number is Number.SINGLE else float
    made = []
    for f_Z, D_Z, f_N, D_N in FILTERS:
        c = oracle.coefficients((f_Z, D_Z), (f_N, D_N), RATE)
        if number is Number.FIXED_30:
            own = [oracle.exactly(x, 2**30) for x in c]
            made.append(oracle.fixed_filter(own, Fraction(1, 2**20)))
        else:
            made.append(oracle.float_filter([real(float(x)) for x in c]))
    split = count[0] - count[1]
    return oracle.force(GAINS, made[split:], made[:split], RATE, real, signals(), slower, AHEAD)


@pytest.mark.parametrize("slower", [1, 4])
@pytest.mark.parametrize("name", ["sinamics_s120", "beckhoff_ax5000"])
def test_it_is_the_simulation_to_the_bit(name: str, slower: int) -> None:
    assert program(name, slower).run(*signals().T) == simulated(name, slower)


def test_in_double_precision_it_is_the_simulation() -> None:
    found = np.array(program("generic").run(*signals().T))
    np.testing.assert_allclose(found, simulated("generic"), rtol=1e-9, atol=1e-12)


def test_coefficients_one_step_off_are_caught() -> None:
    for name in ("sinamics_s120", "beckhoff_ax5000"):
        given, expected = program(name), simulated(name)
        for place in range(10):
            which, at = divmod(place, 5)
            own = list(given.current[which])
            if given.kind is Number.FIXED_30:
                own[at] += 2**12  # 4e-6: less moves no integer of the signal in 600 samples
            else:
                own[at] = np.nextafter(own[at], np.float32(9.0))
            current = list(given.current)
            current[which] = tuple(own)
            mutant = replace(given, current=tuple(current))
            assert mutant.run(*signals().T) != expected, (name, place)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize(
    ("name", "slower"), [("generic", 3), ("sinamics_s120", 1), ("beckhoff_ax5000", 8)]
)
def test_the_C_code_is_the_program_to_the_bit(name: str, slower: int, tmp_path: Path) -> None:
    own = program(name, slower)
    (tmp_path / "cascade.c").write_text(own.code("a test"), "utf-8")
    library = tmp_path / "cascade.so"
    words = "cc -std=c99 -O2 -ffp-contract=off -Wall -Wextra -Werror -shared -fPIC -o"
    sources = [str(library), str(tmp_path / "cascade.c"), "-lm"]
    subprocess.run([*words.split(), *sources], check=True)
    loaded = ctypes.CDLL(str(library))
    real = ctypes.c_float if own.real is np.float32 else ctypes.c_double
    loaded.cascade_step.restype, loaded.cascade_step.argtypes = real, [ctypes.c_void_p, *[real] * 3]
    state = ctypes.create_string_buffer(4096)
    loaded.cascade_reset.argtypes = [ctypes.c_void_p]
    for size in (1.0, 5e4):  # of 300 N, and of 15 MN
        loaded.cascade_reset(state)
        given = size * signals()
        found = [loaded.cascade_step(state, *map(float, row)) for row in given.tolist()]
        assert found == [float(u) for u in own.run(*given.T)]


def test_the_program_answers_as_its_state_space() -> None:
    own = cascade("generic")
    values = np.array([*GAINS, *np.ravel(FILTERS)])
    K, rows = own.state_space(values), signals()
    errors = np.stack([-(rows[:, 2] - rows[0, 2]), rows[:, 0] - rows[:, 1]])  # motor, position
    x, found = np.zeros(len(K.A)), []
    for e in errors.T:
        found.append(float((K.C @ x + K.D @ e)[0]))
        x = K.A @ x + K.B @ e
    without = program("generic", ahead=(0.0, 0.0)).run(*rows.T)
    np.testing.assert_allclose(found, without, rtol=1e-8, atol=1e-12)


def test_feedforward_of_a_rigid_mass_leaves_what_its_fourth_derivative_makes() -> None:
    """Without, it is the velocity over Kv. At half the speed a jerk's would be an eighth."""
    mass = Plant(*map(np.array, ([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0 / 0.11]],
                                 [[1.0, 0.0], [1.0, 0.0]], np.zeros((2, 1)))))  # fmt: skip
    G, own = zoh(mass, 1.0 / RATE, 375e-6), replace(cascade("generic"), slots=())
    errors = []
    for seconds, ahead in ((0.4, (0.0, 0.0)), (0.4, (1.0, 0.11)), (0.8, (1.0, 0.11))):
        made = program_of(own, np.array(GAINS), ahead, ArithmeticOptions(seconds=seconds))
        errors.append(following_error(made, G, 1, 0))
    fastest = 35.0 / 16.0 * ArithmeticOptions().distance / 0.4
    assert errors[0] == pytest.approx(fastest / GAINS[0], rel=0.1)
    assert errors[1] < 0.02 * errors[0]
    assert errors[1] > 10.0 * errors[2]  # 11.5
