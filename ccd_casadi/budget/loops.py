"""One source in one closed loop as a stationary process, continuous or sampled, exactly.

    ẋ = A x + w                x_{k+1} = (1 + A) x_k + w_k
    e = C x,   u = F x + v

x holds the plant, the controller, the source's filter, and of a sampled loop the forces that are
under way (`holding`). Sampled, e is the error at the samples, and white sensor noise that of the
samples: its density counts up to half the rate. The controller is converted by Tustin's rule
without prewarping. Everything is analytic in the matrices of plant and controller.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import matrix_balance

from ccd_casadi.budget.holding import Matrix, held, noise_of_a_period, over, stacked, tustin_change
from ccd_casadi.budget.sources import Kind, Source
from ccd_casadi.lti.closed_loop import closed_matrix
from ccd_casadi.lti.hold import Sampling, tustin
from ccd_casadi.lti.state_space import StateSpace

FORCES = (Kind.FORCE, Kind.FLOOR_MOTION)


@dataclass(frozen=True)
class Process:
    """A (n, n), Q (n, n), C (p, n), F (m, n), and what is white at the samples: E (n, q), V (m, q).

        cov w = Q + E E',   v = V ν,   w = E ν + …

    Infinite: where e or u holds white noise of continuous time. `sampled`: A is the change.
    """

    A: Matrix
    Q: Matrix
    C: Matrix
    F: Matrix
    E: Matrix
    V: Matrix
    sampled: bool = False
    infinite_error: bool = False
    infinite_force: bool = False

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
    """A plant with a source: all of its process that no controller changes.

    `system` is the plant with the filter of a force among its states, `filter` that of noise or
    setpoint. Sampled: `change` and `gains` of `system` over a period and `noise` (Q) of it, and
    the same of the filter; without a hold those are empty.
    """

    kind: Kind
    hold: Sampling | None
    system: StateSpace
    filter: StateSpace
    change: Matrix = field(default_factory=lambda: np.zeros((0, 0)))
    gains: tuple[Matrix, ...] = ()
    noise: Matrix = field(default_factory=lambda: np.zeros((0, 0)))
    filter_change: Matrix = field(default_factory=lambda: np.zeros((0, 0)))


def disturbed(G: StateSpace, source: Source, hold: Sampling | None) -> Disturbed:
    """A plant without feedthrough (SI) under a source of white noise through a filter.

    Raises ValueError for a tabulated source, which has no state space.
    """
    if not source.shaped:
        raise ValueError("a tabulated source has no state space")
    is_force = source.kind in FORCES
    own, each = source.shaping(), np.eye(G.B.shape[1] if is_force else len(G.C))
    f = StateSpace(*(np.asarray(np.kron(each, getattr(own, name)), float) for name in "ABCD"))
    if hold is None:
        return Disturbed(source.kind, None, G, f)
    T = hold.period
    if not is_force:
        change, gains = held(G.A, G.B, hold)
        return Disturbed(source.kind, hold, G, f, change, tuple(gains),
                         noise_of_a_period(f.A, f.B, T), over(f.A, T)[0])  # fmt: skip
    n, nf = len(G.A), len(f.A)
    A = stacked([[G.A, G.B @ f.C], [np.zeros((nf, n)), f.A]])
    B = np.vstack([G.B, np.zeros((nf, G.B.shape[1]))])
    C = np.hstack([G.C, np.zeros((len(G.C), nf))])
    change, gains = held(A, B, hold)
    noise = noise_of_a_period(A, np.vstack([G.B @ f.D, f.B]), T)
    return Disturbed(source.kind, hold, StateSpace(A, B, C, G.D), f, change, tuple(gains), noise)


def process(G: StateSpace, K: StateSpace, source: Source, hold: Sampling | None) -> Process:
    """The loop of a plant without feedthrough (SI), a controller (e in, u out) and a source."""
    return closed(disturbed(G, source, hold), K)


def closed(plant: Disturbed, K: StateSpace) -> Process:
    """The process of a disturbed plant with a controller around it."""
    return _continuous(plant, K) if plant.hold is None else _sampled(plant, K, plant.hold)


def _continuous(plant: Disturbed, K: StateSpace) -> Process:
    G, f, kind = plant.system, plant.filter, plant.kind
    n, nk, nf = len(G.A), len(K.A), len(f.A)
    m = G.B.shape[1]
    loop = closed_matrix(G, K)
    C = np.hstack([-G.C, np.zeros((len(G.C), nk + nf))])
    if kind in FORCES:
        enters, direct = np.vstack([G.B, np.zeros((nk, m))]), np.zeros((len(K.C), m))
    else:
        sign = -1.0 if kind is Kind.SENSOR_NOISE else 1.0
        enters, direct = sign * np.vstack([G.B @ K.D, K.B]), sign * K.D
        if kind is Kind.SETPOINT:
            C = np.hstack([C[:, : n + nk], f.C])
    A = stacked([[loop, enters @ f.C], [np.zeros((nf, n + nk)), f.A]])
    W = np.vstack([enters @ f.D, f.B])
    F = np.hstack([-K.D @ G.C, K.C, direct @ f.C])
    return Process(A, 0.5 * W @ W.T, C, F, np.zeros((len(A), 0)), np.zeros((len(F), 0)),
                   infinite_error=kind is Kind.SETPOINT and bool(np.any(f.D)),
                   infinite_force=bool(np.any(direct @ f.D)))  # fmt: skip


def _sampled(plant: Disturbed, K: StateSpace, hold: Sampling) -> Process:
    B, C, f, gains = plant.system.B, plant.system.C, plant.filter, plant.gains
    k, k_change = tustin(K, hold.period), tustin_change(K, hold.period)
    own = plant.kind not in FORCES  # whether the filter stands beside the plant
    m, n, nk, nf = B.shape[1], len(B), len(k.A), len(f.A) if own else 0
    kept = len(gains) - 1
    size = n + nk + nf + kept * m
    x, c, z, old = np.split(np.eye(size), np.cumsum([n, nk, nf]))
    sign = -1.0 if plant.kind is Kind.SENSOR_NOISE else 1.0
    e = -C @ x + sign * f.C @ z if own else -C @ x
    u = k.C @ c + k.D @ e
    forces = [u, *np.split(old, kept)] if kept else [u]
    rows = [plant.change @ x + sum(g @ force for g, force in zip(gains, forces, strict=True))]
    rows.append(k_change @ c + k.B @ e)
    driven = z if own else x
    E, V = np.zeros((size, 0)), np.zeros((m, 0))
    if own:
        rows.append(plant.filter_change @ z)
        # The white part, of variance density times half the rate, enters by way of e alone.
        white = sign * f.D / np.sqrt(2.0 * hold.period)
        V = k.D @ white
        E = np.vstack([gains[0] @ V, k.B @ white, np.zeros((nf, white.shape[1])),
                       np.eye(kept * m, m) @ V])  # fmt: skip
    if kept:
        rows.append(np.vstack(forces[:kept]) - old)
    error = e if plant.kind is Kind.SETPOINT else -C @ x
    Q = driven.T @ plant.noise @ driven
    return Process(np.vstack(rows), Q, error, u, E, V, sampled=True)
