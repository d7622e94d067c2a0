"""The loop as the judge closes it: hold and delay, Tustin's rule and S, by its own matrices."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import expm, matrix_balance

from ccd_casadi.lti.loop import Sampling, delayed
from ccd_casadi.lti.state_space import StateSpace, balanced

if TYPE_CHECKING:
    pass


def error_response(G: StateSpace, K: StateSpace) -> StateSpace:
    """S, r to e, of a plant without feedthrough; the judge's own, beside `lti.closed_loop`."""
    A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    B = np.vstack([G.B @ K.D, K.B])
    C = np.hstack([-G.C, np.zeros((len(G.C), len(K.A)))])
    return StateSpace(A, B, C, np.eye(len(G.C)))


def sampled(G: StateSpace, sampling: Sampling) -> StateSpace:
    """u_k to y_k with the delay as whole periods and a rest, in which the older force still acts.

    The judge's own, beside `lti.loop.sampled`.

    ẋ = A x + B u with u held is integrated over both parts of a period by one exponential of
    [[A, B, 0], [0, 0, 1/T], [0, 0, 0]]-like blocks each.
    """
    T, (n, m) = sampling.period, G.B.shape
    whole = int(np.floor(sampling.delay / T + 1e-9))
    rest = max(sampling.delay - whole * T, 0.0)
    if G.period:
        return delayed(G.A, [0.0 * G.B] * whole + [G.B], G.C, G.period)
    held = np.zeros((n + m, n + m))
    held[:n, :n], held[:n, n:] = G.A, G.B
    first, second = expm(held * rest), expm(held * (T - rest))
    age = m * (whole + 1)  # u_{k-1} … of these periods are kept
    A, B = np.zeros((n + age, n + age)), np.zeros((n + age, m))
    A[:n, :n] = second[:n, :n] @ first[:n, :n]
    A[:n, n + m * whole : n + m * (whole + 1)] = second[:n, :n] @ first[:n, n:]
    if whole:
        A[:n, n + m * (whole - 1) : n + m * whole] += second[:n, n:]
    else:
        B[:n] = second[:n, n:]
    B[n : n + m] = np.eye(m)
    A[n + m :, n : n + age - m] = np.eye(age - m)
    return StateSpace(A, B, np.hstack([G.C, np.zeros((len(G.C), age))]), np.zeros((len(G.C), m)))


def as_run(K: StateSpace, sampling: Sampling) -> StateSpace:
    """K(z) with s = (2/T)(z - 1)/(z + 1); in discrete time it runs as it is."""
    if K.period:
        return K
    one, half = np.eye(len(K.A)), 0.5 * sampling.period
    inverse = np.linalg.inv(one - half * K.A)
    C, D = K.C @ inverse, K.D + half * K.C @ inverse @ K.B
    A, B = inverse @ (one + half * K.A), sampling.period * inverse @ K.B
    return StateSpace(A, B, C, D, period=sampling.period)


def holds(G: StateSpace, K: StateSpace, sampling: Sampling) -> bool:
    """Whether a controller in discrete time makes the loop stable, by its eigenvalues."""
    loop = error_response(sampled(balanced_system(G), sampling), balanced_system(K))
    return bool(np.abs(np.linalg.eigvals(matrix_balance(loop.A)[0])).max() < 1.0)


def balanced_system(system: StateSpace) -> StateSpace:
    """The same in coordinates in which A, B and C are balanced."""
    A, B, C = balanced(system.A, system.B, system.C)
    return replace(system, A=A, B=B, C=C)
