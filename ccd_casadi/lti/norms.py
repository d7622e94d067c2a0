"""The H∞ norm of any stable state space, from its frequency response and a Hamiltonian matrix.

Nothing here comes from the compiled kernels, so that the two may judge each other. (Boyd,
Balakrishnan & Kabamba 1989; Bruinsma & Steinbuch 1990.)
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigvals, solve

from ccd_casadi.lti.frequency_grid import root_flanks
from ccd_casadi.lti.loop import in_w
from ccd_casadi.lti.state_space import StateSpace, balance_system
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class NormOptions:
    """Numbers of the computation of the H∞ norm."""

    near_axis: float = 1e-3  # |Re λ|/|λ| of a candidate at most; a spurious one costs an evaluation
    resolution: float = 1e-10  # relative step of the level
    rounds: int = 40  # largest number of steps
    climbed: float = 0.1  # relative: how far below the largest a maximum is climbed, too
    climbs: int = 4  # maxima that are climbed
    divisions: int = 4  # times that the bracket of each is divided
    points: int = 41  # of the bracket at each division


def gains(system: StateSpace, omega: Array, *, memory: int = 1_000_000) -> Array:
    """Evaluate σ_max of C(jω - A)⁻¹B + D.

    Parameters
    ----------
    system : StateSpace
        Continuous.
    omega : array (k,)
        rad/s, infinity allowed.
    memory : int
        Complex numbers of the responses that are held at once.

    Returns
    -------
    array (k,)
        Infinite at a pole on the axis.
    """
    out = np.full(len(omega), np.linalg.norm(system.D, 2))
    finite = np.flatnonzero(np.isfinite(omega))
    size = max(1, memory // max(1, system.A.size))
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


def level_frequencies(
    system: StateSpace, level: float, *, options: NormOptions = NormOptions()
) -> Array:
    """Sorted ω >= 0 where a singular value of the response may equal `level` > σ_max(D).

    They are the imaginary eigenvalues of [[F, BR⁻¹Bᵀ], [-Cᵀ(I + DR⁻¹Dᵀ)C, -Fᵀ]], R = level² -
    DᵀD, F = A + BR⁻¹DᵀC.
    """
    A, B, C, D = system.A, system.B, system.C, system.D
    R = level**2 * np.eye(D.shape[1]) - D.T @ D
    RDC, RB = solve(R, D.T @ C, assume_a="sym"), solve(R, B.T, assume_a="sym")
    F = A + B @ RDC
    values = eigvals(np.block([[F, B @ RB], [-C.T @ C - C.T @ D @ RDC, -F.T]]))
    near = np.abs(values.real) <= options.near_axis * np.abs(values)
    return np.unique(values.imag[near & (values.imag >= 0.0)])


def hinf_norm(
    system: StateSpace, start: float | None = None, *, options: NormOptions = NormOptions()
) -> tuple[float, float]:
    """Compute the H∞ norm, the largest σ_max of the response over ω.

    The value is attained at the ω returned. It is raised until the Hamiltonian matrix has no higher
    level, each candidate confirmed on the frequency response. A system in discrete time is
    transformed to w, whose axis is its circle (`in_w`).

    Parameters
    ----------
    system : StateSpace
    start : float, optional
        ω near the maximum in rad/s, in place of a grid.
    options : NormOptions

    Returns
    -------
    norm : float
        Infinite where A has an eigenvalue with Re >= 0.
    omega : float
        rad/s.

    References
    ----------
    Boyd, Balakrishnan & Kabamba (1989); Bruinsma & Steinbuch (1990).
    """
    if T := system.period:
        near = None if start is None else 2.0 / T * np.tan(0.5 * start * T)
        norm, v = hinf_norm(in_w(system), near, options=options)
        return norm, float(2.0 / T * np.arctan(0.5 * v * T))
    if not len(system.A):
        return float(np.linalg.norm(system.D, 2)), 0.0
    A, B, C = balance_system(system.A, system.B, system.C)
    scaled = StateSpace(A, B, C, system.D)
    poles = np.linalg.eigvals(A)
    if not poles.real.max() < 0.0:
        return np.inf, float(abs(poles[np.argmax(poles.real)].imag))
    omega = _first_grid(poles) if start is None else np.array([start, np.inf])
    best, at = _climb(scaled, omega, options)
    for _ in range(options.rounds):
        level = best * (1.0 + options.resolution)
        if level == 0.0:
            break
        edges = level_frequencies(scaled, level, options=options)
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


def _climb(system: StateSpace, omega: Array, options: NormOptions) -> tuple[float, float]:
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
    tops = inside[
        (values[inside] > (1.0 - options.climbed) * best) & np.isfinite(omega[inside + 1])
    ]
    for top in tops[np.argsort(-values[tops])][: options.climbs]:
        low, high = omega[top - 1], omega[top + 1]
        for _ in range(options.divisions):
            fine = np.linspace(low, high, options.points)
            found = gains(system, fine)
            k = int(np.argmax(found))
            if found[k] > best:
                best, at = float(found[k]), float(fine[k])
            low, high = fine[max(k - 1, 0)], fine[min(k + 1, options.points - 1)]
    return best, at


def _first_grid(poles: np.ndarray) -> Array:
    """0, infinity, ten frequencies a decade around the poles, and every resonance with flanks."""
    size = np.abs(poles)
    low, high = 0.01 * size.min(), 100.0 * size.max()
    count = int(10 * np.log10(high / low)) + 2
    flanks = root_flanks(poles[poles.imag > 0.0], (-1.0, 0.0, 1.0))
    grid = np.concatenate([[0.0, np.inf], np.geomspace(low, high, count), flanks])
    return np.unique(grid[grid >= 0.0])
