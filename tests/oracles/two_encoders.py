"""The axis of `examples/two_encoders` with controllers by hand, in coordinates of its own.

|S| wherever the loop may be broken is by fractions, hold and delay by matrix exponentials.
"""

from functools import cache
from pathlib import Path

import numpy as np
from scipy.linalg import expm

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import FinishedRun, _measure
from ccd_casadi.inner_problem.problem import scaled_plant
from ccd_casadi.inner_problem.structured_plant_set import structure_of
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.text import HZ

EXAMPLE = Path(__file__).parents[2] / "examples" / "two_encoders"
THETA = (30.4, 25.0)  # mm
RATE, DELAY = 8000.0, 187.5e-6
# gain, then lags and leads, then two biquads (Hz and damping) and a roll-off
MOTOR = (2.2e7, 266, 14.9, 14.8, 2550, 78.9, 1.83, 222, 0.86, 307, 0.3, 444, 0.3, 2550)
TABLE = (5.7e7, 51.9, 24, 25, 51.9, 703, 195, 0.74, 303, 1.38, 154, 0.3, 475, 0.31, 1600)
DAMPED = {6, 8, 10, 12}


def kappa_of(harder: float = 1.0) -> np.ndarray:
    """ln κ in SI; the motor's gain `harder` times."""
    motor = [v if i == 0 or i in DAMPED else HZ * v for i, v in enumerate(MOTOR)]
    table = [v if i == 0 or i - 1 in DAMPED else HZ * v for i, v in enumerate(TABLE)]
    return np.log([harder * motor[0], *motor[1:], *table])


def by_hand(folder: Path, S_max: float = 2.1, harder: float = 1.0, **other: str) -> FinishedRun:
    """A run whose controllers are tuned by hand."""
    text = (EXAMPLE / "case.toml").read_text().replace("S_max = 2.0", f"S_max = {S_max}")
    for old, new in other.values():  # type: ignore[misc]
        assert old in text
        text = text.replace(old, new)
    (folder / "plant.py").write_text((EXAMPLE / "plant.py").read_text())
    (folder / "case.toml").write_text(text)
    case = load_case(folder / "case.toml")
    problem, kappa = problem_of(case), kappa_of(harder)
    K, plant = structure_of(problem).state_space(kappa), scaled_plant(problem, THETA)
    figures = _measure(problem, plant, K, problem.weights)
    result = {"status": "verified", "theta": dict(zip(problem.names, THETA, strict=True))}
    return FinishedRun(folder, case, problem, THETA, plant, problem.weights, K, figures, result,
                       kappa=kappa)  # fmt: skip


def axis(shift: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A and B of motor and table at THETA in their own coordinates [x; v], as plant.py has them."""
    d, lead = 1e-3 * np.array(THETA)
    motor = (2e-3 + 7850.0 * np.pi * d**4 / 32.0 * 0.9) * (2.0 * np.pi / lead) ** 2
    screw = 210e9 * np.pi * (0.85 * d) ** 2 / 4.0 / 0.9
    k = (1.0 + shift) ** 2 / (1.0 / screw + 1.0 / (1.2e10 * d) + 1.0 / 3e8)
    m = np.array([motor, 120.0])
    reduced = motor * 120.0 / m.sum()
    c = 2.0 * 0.02 * np.sqrt(k * reduced)  # of the damping ratio
    link = np.array([[1.0, -1.0], [-1.0, 1.0]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-k * link / m[:, None], -c * link / m[:, None]]])
    return A, np.array([[0.0], [0.0], [1.0 / motor], [0.0]])


@cache
def held(
    shift: float, period: float, delay: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """x⁺ = F x + now u_{k-d} + before u_{k-d-1}."""
    A, B = axis(shift)
    d = int(delay / period + 1e-9)
    rest = delay - d * period

    def over(t: float) -> tuple[np.ndarray, np.ndarray]:
        whole = expm(np.block([[A, B], [np.zeros((1, 5))]]) * t)
        return whole[:4, :4], whole[:4, 4:]

    (F, _), (late, now), (_, early) = over(period), over(period - rest), over(rest)
    return F, now, late @ early, d


def broken(
    K: StateSpace, delay: float, shift: float = 0.0, points: int = 20_000
) -> tuple[np.ndarray, np.ndarray]:
    """ω and |S| (3, k) with the loop broken at motor, table and actuator, of K(z)."""
    T, (F, now, before, d) = K.period, held(shift, K.period, delay)
    omega = np.geomspace(1.0, 0.9999 * np.pi / T, points)
    z = np.exp(1j * omega * T)
    drive = now[None] * (z**-d)[:, None, None] + before[None] * (z ** -(d + 1))[:, None, None]
    G = np.linalg.solve(z[:, None, None] * np.eye(4) - F, drive)[:, :2, 0]
    gains = (K.C @ np.linalg.solve(z[:, None, None] * np.eye(len(K.A)) - K.A, K.B + 0j) + K.D)[:, 0]
    L = G * gains
    D = 1.0 + L.sum(axis=1)
    return omega, np.abs([(D - L[:, 0]) / D, (D - L[:, 1]) / D, 1.0 / D])
