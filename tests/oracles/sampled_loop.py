"""A sampled loop judged from a plant's matrices, with nothing of the package but the controller's.

The plant is stepped through hold and a whole number of periods of delay by a matrix exponential, K
by Tustin's difference equation.
"""

import numpy as np
from scipy.linalg import expm

from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace


def sampled_loop(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, K: StateSpace, run: Sampling, points: int = 4000
) -> tuple[float, np.ndarray, np.ndarray]:
    """Spectral radius, ω (rad/s) and |S| there, of one input and output in SI."""
    n, m, T = len(A), len(K.A), run.period
    late = round(run.delay / T)
    assert abs(late * T - run.delay) < 1e-9
    held = expm(np.block([[A, B], [np.zeros((1, n + 1))]]) * T)
    Ad, Bd = held[:n, :n], held[:n, n:]
    left = np.linalg.inv(np.eye(m) - 0.5 * T * K.A)
    a, b = left @ (np.eye(m) + 0.5 * T * K.A), left @ K.B * T
    c, d = K.C @ left, K.D + 0.5 * T * K.C @ left @ K.B
    size = n + late + m  # plant, forces that wait, controller
    command = np.hstack([-d @ C, np.zeros((1, late)), c])
    loop = np.zeros((size, size))
    loop[:n, :n] = Ad
    if late:
        loop[:n, n : n + 1] += Bd  # the oldest force is at work
        loop[n + late - 1] = command[0]
        loop[range(n, n + late - 1), range(n + 1, n + late)] = 1.0
    else:
        loop[:n] += Bd @ command
    loop[n + late :, :n], loop[n + late :, n + late :] = -b @ C, a
    omega = np.geomspace(1e-5, 1.0, points) * np.pi / T
    z = np.exp(1j * omega * T)
    x = z[:, None, None]
    G = (C @ np.linalg.solve(x * np.eye(n) - Ad, Bd + 0j))[:, 0, 0] / z**late
    R = (c @ np.linalg.solve(x * np.eye(m) - a, b + 0j) + d)[:, 0, 0]
    return float(np.abs(np.linalg.eigvals(loop)).max()), omega, np.abs(1.0 / (1.0 + G * R))
