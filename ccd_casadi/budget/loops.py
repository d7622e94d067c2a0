"""One source in one closed loop as a stationary process, continuous or sampled, exactly.

    ẋ = A x + w                x_{k+1} = (1 + A) x_k + w_k
    e = C x,   u = F x + v

x holds the plant, of a sampled loop the forces that are under way, the controller, and the source's
filter. Sampled, e is the error at the samples, and white sensor noise that of the samples: its
density counts up to half the rate. The controller runs by Tustin's rule without prewarping. A loop
of changes over a period is that of the changes of plant and controller: transitions would lose the
digits of slow poles next to 1. Everything is analytic in the matrices of both, so that a step along
the imaginary axis gives derivatives to rounding (Squire and Trapp 1998).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import expm, matrix_balance

from ccd_casadi.budget.sources import Kind, Source
from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.hold import Sampling, delay_parts, delayed, tustin
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace

FORCES = (Kind.FORCE, Kind.FLOOR_MOTION)
Matrix = np.ndarray[Any, Any]  # real, or complex with a step along the imaginary axis


@dataclass(frozen=True)
class Process:
    """A (n, n), Q (n, n), C (p, n), F (m, n), and what is white: E (n, q), V (m, q).

        cov w = Q + E E',   v = V ν,   w = E ν + …

    Infinite: where e or u holds white noise of continuous time. `sampled`: A is the change.
    """

    A: Matrix
    Q: Matrix
    C: Matrix
    F: Matrix
    E: Matrix
    V: Matrix
    sampled: bool
    infinite_error: bool
    infinite_force: bool

    @property
    def noise(self) -> Matrix:
        """cov w."""
        return self.Q + self.E @ self.E.T

    def transformed(self, scale: Matrix) -> "Process":
        """The same process in states x/scale."""
        return replace(
            self,
            A=self.A * scale / scale[:, None],
            Q=self.Q / scale / scale[:, None],
            C=self.C * scale,
            F=self.F * scale,
            E=self.E / scale[:, None],
        )

    def scales(self) -> Matrix:
        """Powers of two that even out A."""
        _, (scale, _) = matrix_balance(self.A.real, permute=False, separate=True)
        return np.asarray(scale)

    def balanced(self) -> "Process":
        """In the states of `scales`."""
        return self.transformed(self.scales())


@dataclass(frozen=True)
class Disturbed:
    """A plant with a source, as they run: all of its process that no controller changes.

    Sampled, A of `plant` and `filter` are changes over a `period`. `plant` has the filter of a
    force among its states; `filter` is that of noise or setpoint. The states that the source
    drives, the first of the plant's or the filter's, have `noise` (Q) of a period, or in continuous
    time `enters` (E).
    """

    kind: Kind
    period: float | None
    plant: StateSpace
    filter: StateSpace
    noise: Matrix
    enters: Matrix


def disturbed(G: StateSpace, source: Source, hold: Sampling | None) -> Disturbed:
    """A plant without feedthrough (SI) under a source of white noise through a filter.

    Raises ValueError for a tabulated source, which has no state space.
    """
    if not source.shaped:
        raise ValueError("a tabulated source has no state space")
    is_force = source.kind in FORCES
    own, each = source.shaping(), np.eye(G.B.shape[1] if is_force else len(G.C))
    f = StateSpace(*(np.asarray(np.kron(each, getattr(own, name)), float) for name in "ABCD"))
    driven, W = f, f.B
    if is_force:
        none = np.zeros((len(f.A), len(G.A) + G.B.shape[1]))
        W = np.vstack([G.B @ f.D, f.B])
        G = driven = StateSpace(
            np.block([[G.A, G.B @ f.C], [none[:, : len(G.A)], f.A]]),
            np.vstack([G.B, none[:, len(G.A) :]]),
            np.hstack([G.C, np.zeros((len(G.C), len(f.A)))]),
            G.D,
        )
    if hold is None:
        return Disturbed(source.kind, None, G, f, 0.0 * driven.A, W / np.sqrt(2.0))
    T = hold.period
    noise, f = noise_of_a_period(driven.A, W, T), replace(f, A=over(f.A, T)[0])
    return Disturbed(source.kind, T, _held(G, hold), f, noise, 0.0 * W)


def closed(plant: Disturbed, K: StateSpace) -> Process:
    """The process of a disturbed plant with a controller around it."""
    f, kind, T = plant.filter, plant.kind, plant.period
    if T is not None and K.period:
        K = replace(K, A=K.A - np.eye(len(K.A)))
    elif T is not None:
        change: Matrix = T * np.linalg.solve(np.eye(len(K.A)) - 0.5 * T * K.A, K.A)
        K = replace(tustin(K, T), A=change)
    loop = closed_loop(plant.plant, K)
    A, C, F = loop.A, -loop.C_y, loop.C_u
    E, V, first = np.zeros((len(A), plant.enters.shape[1])), np.zeros((len(F), 1)), 0
    if kind not in FORCES:
        first, sign = len(A), -1.0 if kind is Kind.SENSOR_NOISE else 1.0
        A = np.block([[A, sign * loop.B_r @ f.C], [np.zeros((len(f.A), first)), f.A]])
        C = np.hstack([C, f.C * (kind is Kind.SETPOINT)])
        F = np.hstack([F, sign * loop.D_u @ f.C])
        # The white part enters by way of e alone; sampled, of variance density times half the rate.
        white = sign * f.D / np.sqrt(2.0 * (T or 1.0))
        E, V = np.vstack([loop.B_r @ white, 0.0 * f.B]), loop.D_u @ white
    Q, E = np.zeros_like(A), E.astype(A.dtype)
    at = slice(first, first + len(plant.noise))
    Q[at, at], E[at] = plant.noise, plant.enters
    white_error = T is None and kind is Kind.SETPOINT and bool(np.any(f.D))
    return Process(A, Q, C, F, E, V, T is not None, white_error, T is None and bool(np.any(V)))


def process(loop: Loop, source: Source) -> Process:
    """A loop whose plant has no feedthrough, under a source."""
    return closed(disturbed(loop.plant, source, loop.sampling), loop.controller)


def _held(G: StateSpace, hold: Sampling) -> StateSpace:
    """The plant behind hold and delay, states [x; u_{k-1}; …]; A their change over a period."""
    n, m = G.B.shape
    whole, rest = delay_parts(hold.period, hold.delay)
    (late, late_in), (early, early_in) = over(G.A, hold.period - rest), over(G.A, rest)
    gains = [np.zeros((n, m))] * whole + [late_in @ G.B, (early_in + late @ early_in) @ G.B]
    change = late + early + late @ early
    found = delayed(change, gains if rest > 0.0 else gains[:-1], G.C, hold.period)
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
