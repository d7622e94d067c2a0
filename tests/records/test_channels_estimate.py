"""Several forces and positions: the plant of a closed loop with noise, one record a force."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete

from ccd_casadi.extensions.records import main
from ccd_casadi.extensions.records.plant_estimate import estimate_channels, read_channels
from ccd_casadi.extensions.records.time_series import SignalNames
from ccd_casadi.plants.measured import read_frequency_response
from ccd_casadi.support.errors import UserError

RATE, COUNT = 2000.0, 8000
FORCES, POSITIONS = ["f1", "f2"], ["y1", "y2", "y3"]


def plant() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two forces on a body that turns, with a mode of 120 Hz; three sensors; friction."""
    w = 2.0 * np.pi * 120.0
    A = np.zeros((6, 6))
    A[:3, 3:] = np.eye(3)
    A[3:, :3], A[3:, 3:] = -np.diag([0.0, 0.0, w**2]), -np.diag([8.0, 6.0, 0.04 * w])
    B = np.zeros((6, 2))
    B[3:] = [[0.5, 0.5], [0.6, -0.6], [0.4, 0.3]]
    C = np.zeros((3, 6))
    C[:, :3] = [[1.0, 0.9, 0.7], [1.0, -0.8, 0.5], [0.3, 0.2, -0.6]]
    return cont2discrete((A, B, C, np.zeros((3, 2))), 1.0 / RATE)[:3]


def response(hz: np.ndarray) -> np.ndarray:
    A, B, C = plant()
    z = np.exp(2j * np.pi * hz / RATE)[:, None, None]
    return np.asarray(C @ np.linalg.solve(z * np.eye(6) - A, B.astype(complex)))


def write_log(path: Path, which: int, seed: int, noise: float = 3e-6) -> None:
    """Both axes are closed by PD; force `which` is excited; noise disturbs what sensors read."""
    rng = np.random.default_rng(seed)
    A, B, C = plant()
    K = np.linalg.pinv(B[3:5] * RATE) @ np.eye(2)
    see = np.linalg.inv(C[:2, :2])
    r = rng.standard_normal((COUNT, 2)) * (np.arange(2) == which)
    x, before, rows = np.zeros(6), np.zeros(2), []
    for k in range(COUNT):
        y = C @ x + noise * rng.standard_normal(3)
        q = see @ y[:2]
        u = r[k] - K @ (400.0 * q + 30.0 * (q - before) * RATE * 0.05)
        before = q
        rows.append([k / RATE, r[k, which], *u, *y])
        x = A @ x + B @ u
    names = ["t", "injected", *FORCES, *POSITIONS]
    np.savez(path, **{n: np.array(rows)[:, i] for i, n in enumerate(names)})


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("channels")
    for i in range(2):
        write_log(folder / f"log{i}.npz", i, i)
    return [folder / f"log{i}.npz" for i in range(2)]


def test_the_plant_lies_within_the_spread(logs: list[Path]) -> None:
    records = [read_channels(path, SignalNames(), FORCES, POSITIONS) for path in logs]
    found = estimate_channels(records)
    assert found.G.shape[1:] == (3, 2)
    inside = np.abs(response(found.hz) - found.G) <= found.spread
    assert (inside.mean(axis=0) > 0.9).all()  # of 95 % (measured: 0.925 to 0.977)
    assert inside.mean() < 1.0
    band = (found.hz > 5.0) & (found.hz < 40.0)
    share = np.median((found.spread / np.abs(found.G))[band], axis=0)
    assert max(share[0, 0], share[1, 1]) < 0.1  # (measured: 0.03 and 0.05)


def test_the_command_writes_what_tune_reads(
    logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = [*map(str, logs), "--force", "f1,f2", "--position", "y1,y2,y3"]
    assert main([*own, "--out", str(tmp_path)]) == 0
    assert "3 positions by 2 forces" in capsys.readouterr().out
    read = read_frequency_response(tmp_path / "response.npz")
    assert read.matrix.shape[1:] == (3, 2)
    assert read.spread is not None
    assert main([own[0], *own[2:], "--out", str(tmp_path)]) == 2
    assert "2 forces need 2 records" in capsys.readouterr().err


def test_records_that_excite_alike_are_refused(logs: list[Path]) -> None:
    one = read_channels(logs[0], SignalNames(), FORCES, POSITIONS)
    with pytest.raises(UserError, match="excite the forces alike"):
        estimate_channels([one, one])
