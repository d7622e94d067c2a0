"""Matrices in discrete time are known as such where no sampling period is given."""

from pathlib import Path

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few
from scipy.io import savemat
from scipy.linalg import expm

from ccd_casadi.extensions.measured.tuned_plants import read_plant
from ccd_casadi.support.errors import UserError
from ccd_casadi.synthesis.interchange import from_control, read_mat
from ccd_casadi.synthesis.matlab_systems import appears_discrete

MODES = st.lists(st.floats(1.0, 1e4), min_size=0, max_size=4, unique=True)  # rad/s


def plant(modes: list[float], damping: float) -> np.ndarray:
    """A of a free mass with flexible modes, continuous."""
    A = np.zeros((2 + 2 * len(modes), 2 + 2 * len(modes)))
    A[0, 1] = 1.0
    for i, w in enumerate(modes, 1):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0.0, 1.0], [-w * w, -2.0 * damping * w]]
    return A


@few(max_examples=80)
@given(modes=MODES, damping=st.floats(0.0, 0.2), times=st.floats(7.0, 100.0))
def test_a_plant_is_seen_in_its_own_time(
    modes: list[float], damping: float, times: float
) -> None:
    """Sampled fast enough for its modes it appears discrete, and continuous it does not."""
    A = plant(modes, damping)
    period = 2.0 * np.pi / (times * max([*modes, 1.0]))
    assert appears_discrete(expm(A * period))
    assert not appears_discrete(A)


@few(max_examples=60)
@given(
    root=st.floats(0.01, 1.0), damping=st.floats(-0.3, 0.9), w=st.floats(0.01, 50.0),
    more=st.integers(0, 2),
)  # fmt: skip
def test_an_unstable_plant_in_odd_units_is_not_taken_for_discrete(
    root: float, damping: float, w: float, more: int
) -> None:
    """A pendulum that stands, with an oscillation that is damped or grows slowly."""
    blocks = [np.array([[0.0, 1.0], [root**2, 0.0]])]
    blocks += [np.array([[0.0, 1.0], [-w * w, -2.0 * abs(damping) * w]])] * more
    A = np.zeros((2 * len(blocks), 2 * len(blocks)))
    for i, block in enumerate(blocks):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
    assert not appears_discrete(A)


@pytest.fixture
def discrete() -> dict[str, np.ndarray]:
    A = expm(plant([300.0], 0.02) * 1e-3)
    B, C = np.array([[0.0], [1e-3], [0.0], [1e-3]]), np.array([[1.0, 0.0, 1.0, 0.0]])
    return {"A": A, "B": B, "C": C, "D": np.zeros((1, 1))}


def test_a_file_without_a_period_is_refused_with_the_remedy(
    tmp_path: Path, discrete: dict[str, np.ndarray]
) -> None:
    path = tmp_path / "plant.mat"
    savemat(path, discrete)
    with pytest.raises(UserError, match=r"Ts: is missing.* appear discrete.*give Ts.*d2c"):
        read_mat(path)
    savemat(path, {"G": discrete})
    with pytest.raises(UserError, match=r"G\.Ts: is missing"):
        read_mat(path)
    savemat(path, {**discrete, "Ts": 1e-3})
    assert next(iter(read_mat(path).systems.values())).system.period == 1e-3
    savemat(path, {**discrete, "Ts": 0.0})  # stated: believed, and named
    assert "appear discrete" in next(iter(read_mat(path).systems.values())).words
    savemat(path, {**discrete, "A": plant([300.0], 0.02)})
    assert "discrete" not in next(iter(read_mat(path).systems.values())).words


def test_a_system_of_python_control_is_named_too(discrete: dict[str, np.ndarray]) -> None:
    parts = [discrete[name] for name in "ABCD"]
    with pytest.raises(UserError, match=r"dt is None.* appear discrete.*give dt"):
        from_control(control.ss(*parts, None))
    reported: list[str] = []
    read_plant(control.ss(*parts), 0.0, reported.append)
    assert len(reported) == 1
    assert "appear discrete" in reported[0]
    read_plant(control.ss(*parts, 1e-3), 0.0, reported.append)
    read_plant(control.ss(plant([300.0], 0.02), *parts[1:]), 0.0, reported.append)
    assert len(reported) == 1
