"""RMS error and force of a loop under disturbances by Lyapunov equations, and their split over a
moving window."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.linalg import block_diag, expm, matrix_balance

from ccd_casadi.budget.sources import ErrorSource, SourceKind
from ccd_casadi.lti.loop import Loop, Sampling, delay_parts, with_delays
from ccd_casadi.lti.ports import Ports
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array


def samples_of(window: float, period: float) -> int:
    """N of a window in a sampled loop, at least 1."""
    return max(1, round(window / period))


def average_gain(hz: Array, window: float, period: float | None) -> Array:
    """|MA|² at frequencies in Hz; MSD has what is left to 1."""
    if period is None:
        return np.asarray(np.sinc(hz * window) ** 2)
    N = samples_of(window, period)
    x = np.pi * hz * period
    bottom = N * np.sin(x)
    near = np.abs(bottom) < 1e-8 * N
    return np.where(near, 1.0, np.sin(N * x) / np.where(near, 1.0, bottom)) ** 2


def average_matrix(A: Array, window: float, period: float | None) -> Array:
    """F of σ²_MA = C F P C'; of a sampled process A is the change over a period."""
    n, one = len(A), np.eye(len(A))
    A = A if period is None else A + one
    none = np.zeros((n, n))
    if period is None:
        joint = np.block([[A * window, one, none], [none, none, one], [none, none, none]])
        return 2.0 * expm(joint)[:n, 2 * n :]
    N = samples_of(window, period)
    joint = np.block([[A, one, none], [none, one, one], [none, none, one]])
    # Σ_{j=0}^{N-2} (N - 1 - j) A^j: the block of a path of two steps right in N steps.
    power = np.linalg.matrix_power(joint, N)[:n, 2 * n :]
    return (N * one + 2.0 * A @ power) / N**2


FORCES = (SourceKind.FORCE, SourceKind.FLOOR_MOTION)
Rows = tuple[tuple[float, ...], ...]
Matrix = np.ndarray[Any, Any]  # real, or complex with a step along the imaginary axis


@dataclass(frozen=True)
class Process:
    """A (n, n), Q (n, n), C (p, n), F (m, n), and what is white: E (n, q), V (m, q).

        cov w = Q + E E',   v = V ν,   w = E ν + …

    `sampled`: A is the change over a period. The matrix M of a controller (`run_matrix`) is in it
    as A = … + L M R and E = … + L M W; L (n, m + o), R (p + o, n), W (p + o, q).
    """

    A: Matrix
    Q: Matrix
    C: Matrix
    F: Matrix
    E: Matrix
    V: Matrix
    L: Matrix
    R: Matrix
    W: Matrix
    sampled: bool

    @property
    def infinite_force(self) -> bool:
        """Whether u holds white noise of continuous time."""
        return not self.sampled and bool(np.any(self.V))

    @property
    def noise(self) -> Matrix:
        """The covariance of w."""
        return self.Q + self.E @ self.E.T

    def close(self, M: Matrix) -> "Process":
        """Close the loop of an open process with a controller M."""
        LM, of_u = self.L @ M, M[: len(self.F)]
        return replace(self, A=self.A + LM @ self.R, E=self.E + LM @ self.W, F=of_u @ self.R,
                       V=of_u @ self.W)  # fmt: skip

    def transform(self, scale: Matrix) -> "Process":
        """The same process in states x/scale."""
        return replace(
            self,
            A=self.A * scale / scale[:, None],
            Q=self.Q / scale / scale[:, None],
            C=self.C * scale,
            F=self.F * scale,
            E=self.E / scale[:, None],
            L=self.L / scale[:, None],
            R=self.R * scale,
        )

    def scales(self) -> Matrix:
        """Powers of two that even out A."""
        _, (scale, _) = matrix_balance(self.A.real, permute=False, separate=True)
        return np.asarray(scale)

    def balance(self) -> "Process":
        """Transform the process to the states of `scales`."""
        return self.transform(self.scales())


def process_of_plant(
    G: StateSpace, sources: Sequence[ErrorSource], hold: Sampling | None, order: int,
    ports: Ports | None = None,
) -> Process:  # fmt: skip
    """A plant without feedthrough (SI) under independent sources of white noise through filters,
    with the states of a controller of this order that does nothing yet. `ports`: those of G where
    forces do not act, or the error does not count, at its own inputs and outputs.

    Raises ValueError for a tabulated source, which has no state space.
    """
    (p, n), m, T = G.C.shape, G.B.shape[1], 0.0 if hold is None else hold.period
    own = ports or Ports(G.B, G.C, np.eye(p), np.eye(p), np.eye(p))
    force, _ = _join(tuple(one for one in sources if one.kind in FORCES), own.drive.shape[1])
    rows = [tuple(map(tuple, part.tolist())) for part in (own.reference, own.wanted) if ports]
    f, true = _join(tuple(one for one in sources if one.kind not in FORCES), p, *rows)
    drive, driven = np.vstack([own.drive @ force.D, force.B]), n + len(force.A)
    G = StateSpace(
        np.block([[G.A, own.drive @ force.C], [np.zeros((driven - n, n)), force.A]]),
        np.vstack([G.B, np.zeros((driven - n, m))]),
        np.hstack([G.C, np.zeros((p, driven - n))]),
        G.D,
    )
    enters, noise = [drive / np.sqrt(2.0), f.B / np.sqrt(2.0)], [0.0 * G.A, 0.0 * f.A]
    if hold is not None:
        enters = [0.0 * part for part in enters]
        noise = [noise_of_a_period(G.A, drive, T), noise_of_a_period(f.A, f.B, T)]
        G, f = _hold(G, hold), replace(f, A=over(f.A, T)[0])
    held = len(G.A)
    first = held + order  # of the filters that the controller reads
    count, q, kind = first + len(f.A), drive.shape[1], np.result_type(G.A, G.B, G.C)
    A, Q = np.zeros((2, count, count), kind)
    E, L = np.zeros((count, q + f.B.shape[1]), kind), np.zeros((count, m + order), kind)
    R, W = np.zeros((p + order, count), kind), np.zeros((p + order, E.shape[1]))
    A[:held, :held], A[first:, first:] = G.A, f.A
    Q[:driven, :driven], Q[first:, first:] = noise
    E[:driven, :q], E[first:, q:] = enters
    L[:held, :m], L[held:first, m:] = G.B, np.eye(order)
    R[:p, :held], R[:p, first:], R[p:, held:first] = -G.C, f.C, np.eye(order)
    W[:p, q:] = f.D / np.sqrt(2.0 * (T or 1.0))  # of samples: the density times half the rate
    counted = np.zeros((len(own.counted), first), kind)
    counted[:, :n] = -own.counted
    C = np.hstack([counted, true])
    return Process(
        A, Q, C, np.zeros((m, count)), E, np.zeros((m, len(W.T))), L, R, W, hold is not None
    )


@lru_cache(64)  # every plant of a set has the same
def _join(
    sources: tuple[ErrorSource, ...], channels: int, reference: Rows = (), wanted: Rows = ()
) -> tuple[StateSpace, Matrix]:
    """The filters side by side, each in every channel, with their sum as the controller reads it;
    and C of what of it is true. A setpoint enters by `reference` and requires `wanted`."""
    one_each = np.eye(channels)
    R, W = (np.array(rows) if rows else one_each for rows in (reference, wanted))
    none, out = np.zeros((0, 0)), np.zeros((channels, 0))
    parts: list[list[Matrix]] = [[none], [none], [out], [out], [np.zeros((len(W), 0))]]
    for one in sources:
        if not one.shaped:
            raise ValueError("a tabulated source has no state space")
        own, sign = one.shaping(), -1.0 if one.kind is SourceKind.SENSOR_NOISE else 1.0
        setpoint = one.kind is SourceKind.SETPOINT
        enters = R if setpoint else one_each
        A, B = (np.kron(np.eye(enters.shape[1]), part) for part in (own.A, own.B))
        C, D = (sign * np.kron(enters, part) for part in (own.C, own.D))
        true = np.kron(W, own.C) if setpoint else np.zeros((len(W), len(A)))
        added = (A, B, C, D, true)
        for part, own_part in zip(parts, added, strict=True):
            part.append(own_part)
    A, B = (block_diag(*part) for part in parts[:2])
    return StateSpace(A, B, np.hstack(parts[2]), np.hstack(parts[3])), np.hstack(parts[4])


def run_matrix(parts: Sequence[Matrix], period: float | None) -> Matrix:
    """Make M = [[D, C], [B, A]] of continuous controllers as they run.

    Parameters
    ----------
    parts : A, B, C, D (..., ., .)
        SI.
    period : float or None
        s: sampled by Tustin's rule, A is then the change over a period.

    Returns
    -------
    array (..., m + o, p + o)
    """
    A, B, C, D = parts
    if period is not None:
        inverse = np.linalg.inv(np.eye(A.shape[-1]) - 0.5 * period * A)
        C = C @ inverse
        A, B, D = period * inverse @ A, period * inverse @ B, D + 0.5 * period * C @ B
    return np.block([[D, C], [B, A]])


def process(loop: Loop, source: ErrorSource) -> Process:
    """Make the state space of a loop, whose plant has no feedthrough, under a source.

    Parameters
    ----------
    loop : Loop
    source : ErrorSource
        With a shaping filter.

    Returns
    -------
    Process
    """
    K, T = loop.controller, loop.period
    if K.period:
        K, T = replace(K, A=K.A - np.eye(len(K.A))), None
    M = run_matrix((K.A, K.B, K.C, K.D), T)
    found = process_of_plant(loop.plant, (source,), loop.sampling, len(K.A), loop.ports).close(M)
    if (force := loop.ports.force) is None:
        return found
    given = np.pad(force, [(0, 0), (0, len(found.A) - force.shape[1])])
    return replace(found, F=given, V=0.0 * found.V)


def _hold(G: StateSpace, hold: Sampling) -> StateSpace:
    """The plant behind hold and delay, states [x; u_{k-1}; …]; A their change over a period."""
    n, m = G.B.shape
    whole, rest = delay_parts(hold.period, hold.delay)
    (late, late_in), (early, early_in) = over(G.A, hold.period - rest), over(G.A, rest)
    gains = [np.zeros((n, m))] * whole + [late_in @ G.B, (early_in + late @ early_in) @ G.B]
    change = late + early + late @ early
    found = with_delays(change, gains if rest > 0.0 else gains[:-1], G.C, hold.period)
    found.A[n:, n:] -= np.eye(len(found.A) - n)
    return found


def over(A: Matrix, h: float) -> tuple[Matrix, Matrix]:
    """e^{Ah} - 1 = A∫ and ∫₀ʰ e^{As} ds, to the digits of A h."""
    n = len(A)
    joint = np.block([[A * h, h * np.eye(n)], [np.zeros((n, 2 * n))]])
    integral = expm(joint)[:n, n:] if n else A
    return A @ integral, integral


def noise_of_a_period(A: Matrix, W: Matrix, T: float) -> Matrix:
    """∫₀ᵀ e^{As} W W'/2 e^{A's} ds: Van Loan's exponential (1978) of a short step, then doublings.

    It holds e^{-Ah}, so the step is short; Q(2h) = Q(h) + Φ(h) Q(h) Φ(h)' adds no
    error of cancellation.
    """
    n = len(A)
    if n == 0:
        return np.zeros((0, 0))
    doublings = max(0, int(np.ceil(np.log2(max(np.abs(A).sum(0).max() * T, 1e-300)))))
    h = T / 2.0**doublings
    whole = expm(h * np.block([[-A, 0.5 * W @ W.T], [np.zeros((n, n)), A.T]]))
    moved = whole[n:, n:].T
    Q = moved @ whole[:n, n:]
    for _ in range(doublings):
        Q, moved = Q + moved @ Q @ moved.T, moved @ moved
    return 0.5 * (Q + Q.T)
