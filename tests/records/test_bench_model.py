"""The record of the two-mass bench, simulated on its author's model: the estimate is not biased.

Of the real record the model is outside the spread on 88 % of lines: it was fitted to another record
of 2023 (0.11 kg, 269 Hz), and that of 2024 moves as 0.14 kg (least squares of force on
acceleration) and resonates at 385 Hz. Whether that is the estimator's doing is what this decides.
"""

import numpy as np
import pytest
from scipy.signal import bilinear, cont2discrete

from ccd_casadi.extensions.records.plant_estimate import estimate_plant
from ccd_casadi.extensions.records.time_series import TimeSeries

T, COUNT, LATE = 1.0 / 8000.0, 24_000, 3


def bench(mass: float, resonance: float) -> tuple[np.ndarray, ...]:
    """Collocated two masses, anti-resonance 147 Hz, friction 0.7 and 2.5 N s/m, held."""
    first = mass * (147.0 / resonance) ** 2
    M, D = np.diag([first, mass - first]), np.array([[3.2, -2.5], [-2.5, 2.5]])
    K = (2.0 * np.pi * 147.0) ** 2 * M[1, 1] * np.array([[1.0, -1.0], [-1.0, 1.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    B, C = np.array([[0.0], [0.0], [1.0 / first], [0.0]]), np.array([[1.0, 0.0, 0.0, 0.0]])
    return cont2discrete((A, B, C, np.zeros((1, 1))), T)[:3]


@pytest.mark.parametrize(("mass", "resonance"), [(0.11, 269.0), (0.16, 385.0)])
def test_the_plant_of_a_bench_lies_within_the_spread(mass: float, resonance: float) -> None:
    A, B, C = bench(mass, resonance)
    wb, rng = 2.0 * np.pi * 20.0, np.random.default_rng(1)
    gain = mass * wb**2 * np.polymul([3.0 / wb, 1.0], [1.0, wb / 10.0])
    b, a = bilinear(gain, np.polymul([1.0, 0.0], np.polymul([1 / (3 * wb), 1], [1 / (8 * wb), 1])),
                    fs=1.0 / T)  # fmt: skip
    injected = np.where(np.arange(COUNT) % 16_000 >= 8000, 0.1, 0.0)
    x, memory, late = np.zeros(4), np.zeros(len(a)), [0.0] * LATE
    rows, noise = np.zeros((2, COUNT)), 0.01 * rng.standard_normal(COUNT)
    for k in range(COUNT):
        y = 3.8e-9 * np.round((C @ x)[0] / 3.8e-9)  # counts of the encoder
        u = b[0] * -y + memory[0]
        memory[:-1] = memory[1:] + b[1:] * -y - a[1:] * u
        rows[:, k] = y, u + injected[k]
        late.append(rows[1, k])
        x = A @ x + B[:, 0] * (late.pop(0) + noise[k])
    found = estimate_plant(TimeSeries(T, injected, rows[1], rows[0])).used
    z = np.exp(2j * np.pi * found.hz * T)[:, None, None]
    G = (C @ np.linalg.solve(z * np.eye(4) - A, B.astype(complex)))[:, 0, 0] * z[:, 0, 0] ** -LATE
    band = (found.hz >= 5.0) & (found.hz <= 400.0)
    inside = np.abs(G - found.G) <= found.spread
    assert band.sum() > 700
    assert inside[band].mean() >= 0.95  # measured: 0.989 and 0.990
