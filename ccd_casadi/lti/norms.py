"""The H∞ norm of any stable state space, from its frequency response and a Hamiltonian matrix.

Nothing here comes from the compiled kernels, so that the two may judge each other. (Boyd,
Balakrishnan & Kabamba 1989; Bruinsma & Steinbuch 1990.)
"""

import numpy as np
from scipy.linalg import eigvals, solve

from ccd_casadi.lti.loop import in_w
from ccd_casadi.lti.state_space import StateSpace, balanced, root_flanks
from ccd_casadi.support.arrays import Array

NEAR_AXIS = 1e-3  # |Re λ|/|λ| of a candidate: a spurious one costs an evaluation, no more
RESOLUTION = 1e-10  # relative step of the level
ROUNDS = 40
CLIMBED = 0.1  # relative: how far below the largest a maximum of the grid is climbed, too
MOST_CLIMBS, DIVISIONS, POINTS = 4, 4, 41  # maxima, times that each is divided, into how many
MEMORY = 1_000_000  # complex numbers at once


def gains(system: StateSpace, omega: Array) -> Array:
    """σ_max of C(jω - A)⁻¹B + D at every ω in rad/s; infinite at a pole on the axis."""
    out = np.full(len(omega), np.linalg.norm(system.D, 2))
    finite = np.flatnonzero(np.isfinite(omega))
    size = max(1, MEMORY // max(1, system.A.size))
    for first in range(0, len(finite), size):
        part = finite[first : first + size]
        try:
            out[part] = _gains(system, omega[part])
        except np.linalg.LinAlgError:  # of some of them
            single = len(part) == 1
            out[part] = np.inf if single else [gains(system, omega[[i]])[0] for i in part]
    return out


def _gains(system: StateSpace, omega: Array) -> Array:
    response = system.at(1j * omega)
    known = np.asarray(np.isfinite(response).all(axis=(1, 2)))
    sizes = np.linalg.norm(np.where(known[:, None, None], response, 0.0), 2, axis=(1, 2))
    return np.where(known, sizes, np.inf)


def level_frequencies(system: StateSpace, level: float) -> Array:
    """Sorted ω >= 0 where a singular value of the response may equal `level` > σ_max(D).

    They are the imaginary eigenvalues of [[F, BR⁻¹Bᵀ], [-Cᵀ(I + DR⁻¹Dᵀ)C, -Fᵀ]], R = level² -
    DᵀD, F = A + BR⁻¹DᵀC.
    """
    A, B, C, D = system.A, system.B, system.C, system.D
    R = level**2 * np.eye(D.shape[1]) - D.T @ D
    RDC, RB = solve(R, D.T @ C, assume_a="sym"), solve(R, B.T, assume_a="sym")
    F = A + B @ RDC
    values = eigvals(np.block([[F, B @ RB], [-C.T @ C - C.T @ D @ RDC, -F.T]]))
    near = np.abs(values.real) <= NEAR_AXIS * np.abs(values)
    return np.unique(values.imag[near & (values.imag >= 0.0)])


def hinf_norm(system: StateSpace, start: float | None = None) -> tuple[float, float]:
    """sup over ω of σ_max(C(jω - A)⁻¹B + D), and the ω in rad/s where it is; A is stable.

    The value is attained at that ω. It is raised until the Hamiltonian shows no higher level,
    each candidate confirmed on the frequency response; infinite where A has an eigenvalue with
    Re >= 0. `start` is an ω near it, in place of a grid. Of a system in discrete time the same over
    w, whose axis is its circle (`in_w`).
    """
    if T := system.period:
        near = None if start is None else 2.0 / T * np.tan(0.5 * start * T)
        norm, v = hinf_norm(in_w(system), near)
        return norm, float(2.0 / T * np.arctan(0.5 * v * T))
    if not len(system.A):
        return float(np.linalg.norm(system.D, 2)), 0.0
    A, B, C = balanced(system.A, system.B, system.C)
    scaled = StateSpace(A, B, C, system.D)
    poles = np.linalg.eigvals(A)
    if not poles.real.max() < 0.0:
        return np.inf, float(abs(poles[np.argmax(poles.real)].imag))
    omega = _first_grid(poles) if start is None else np.array([start, np.inf])
    best, at = _climbed(scaled, omega)
    for _ in range(ROUNDS):
        level = best * (1.0 + RESOLUTION)
        if level == 0.0:
            break
        edges = level_frequencies(scaled, level)
        inner = edges[edges > 0.0]
        if not inner.size:
            break
        between = np.sqrt(inner[:-1] * inner[1:])
        trials = np.concatenate([[0.0, 0.5 * inner[0], 2.0 * inner[-1]], between, inner])
        found = gains(scaled, trials)
        i = int(np.argmax(found))
        if found[i] <= level:
            break
        best, at = float(found[i]), float(trials[i])
    return best, at


def _climbed(system: StateSpace, omega: Array) -> tuple[float, float]:
    """The largest gain, and its ω, on ascending frequencies and on finer ones beside its maxima.

    A flat maximum far below the other poles is an eigenvalue of the Hamiltonian that rounding moves
    off the axis; the climb does not depend on it.
    """
    values = gains(system, omega)
    i = int(np.argmax(values))
    best, at = float(values[i]), float(omega[i])
    if not 0.0 < best < np.inf:
        return best, at
    inside = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
    tops = inside[(values[inside] > (1.0 - CLIMBED) * best) & np.isfinite(omega[inside + 1])]
    for top in tops[np.argsort(-values[tops])][:MOST_CLIMBS]:
        low, high = omega[top - 1], omega[top + 1]
        for _ in range(DIVISIONS):
            fine = np.linspace(low, high, POINTS)
            found = gains(system, fine)
            k = int(np.argmax(found))
            if found[k] > best:
                best, at = float(found[k]), float(fine[k])
            low, high = fine[max(k - 1, 0)], fine[min(k + 1, POINTS - 1)]
    return best, at


def _first_grid(poles: np.ndarray) -> Array:
    """0, infinity, ten frequencies a decade around the poles, and every resonance with flanks."""
    size = np.abs(poles)
    low, high = 0.01 * size.min(), 100.0 * size.max()
    count = int(10 * np.log10(high / low)) + 2
    flanks = root_flanks(poles[poles.imag > 0.0], np.array([-1.0, 0.0, 1.0]))
    grid = np.concatenate([[0.0, np.inf], np.geomspace(low, high, count), flanks])
    return np.unique(grid[grid >= 0.0])
