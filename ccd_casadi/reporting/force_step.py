"""The position after a step of force on a loop with a controller of fixed structure."""

import numpy as np
from scipy.linalg import expm

from ccd_casadi.fixed_structure import Sampling
from ccd_casadi.plants.scaling import ScaledPlant, StateSpace
from ccd_casadi.support.arrays import Array


def force_step(
    plant: ScaledPlant, K: StateSpace, sampling: Sampling | None, times: Array
) -> tuple[Array, Array]:
    """Times in s near the given ones, and y in m after a step of 1 N, exact at them.

        y_n = C (I - A)⁻¹ (I - Aⁿ) B

    of the loop over one step: a period, or where the loop is continuous the first of the times.
    """
    step = float(times[0]) if sampling is None else sampling.period
    A, B, C = _over_a_step(plant.plant_si(), K, sampling, step)
    counts = np.unique(np.maximum(np.round(times / step), 1.0).astype(int))
    final = np.linalg.solve(np.eye(len(A)) - A, B)
    y = [float(C @ (final - np.linalg.matrix_power(A, int(n)) @ final)) for n in counts]
    return np.asarray(step * counts, float), np.array(y)


def _over_a_step(
    G: StateSpace, K: StateSpace, sampling: Sampling | None, T: float
) -> tuple[Array, Array, Array]:
    """The loop from a force to y in discrete time, the delay's whole periods and rest exact.

    u_k reaches the plant after the delay: over the first part of a period an older one still acts.
    """
    n, m = len(G.A), len(K.A)
    if sampling is None:
        A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
        A, B = _held(A, np.vstack([G.B, np.zeros((m, 1))]), T)
        return A, B[:, 0], np.append(G.C[0], np.zeros(m))
    whole = int(np.floor(sampling.delay / T + 1e-9))
    rest = max(sampling.delay - whole * T, 0.0)
    first, second = _held(G.A, G.B, rest), _held(G.A, G.B, T - rest)
    inverse = np.linalg.inv(np.eye(m) - 0.5 * T * K.A)  # Tustin
    Ak, Bk = inverse @ (np.eye(m) + 0.5 * T * K.A), T * inverse @ K.B
    Ck, Dk = K.C @ inverse, K.D + 0.5 * T * K.C @ inverse @ K.B

    def moved(state: Array, force: float) -> Array:
        x, k, old = state[:n], state[n : n + m], state[n + m :]
        e = -G.C @ x
        u = np.concatenate([Ck @ k + Dk @ e, old])  # u_k, u_{k-1}, …
        x = first[0] @ x + first[1][:, 0] * (u[whole + 1] + force)
        x = second[0] @ x + second[1][:, 0] * (u[whole] + force)
        return np.concatenate([x, Ak @ k + Bk @ e, u[:-1]])

    size = n + m + whole + 1
    A = np.array([moved(row, 0.0) for row in np.eye(size)]).T
    return A, moved(np.zeros(size), 1.0), np.append(G.C[0], np.zeros(size - n))


def _held(A: Array, B: Array, T: float) -> tuple[Array, Array]:
    n = len(A)
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n], joint[:n, n:] = A, B
    whole = expm(T * joint)
    return whole[:n, :n], whole[:n, n:]
