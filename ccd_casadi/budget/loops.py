"""One source in one closed loop as a stationary process, continuous or sampled, exactly.

    ẋ = A x + w                x_{k+1} = (1 + A) x_k + w_k
    e = C x,   u = F x + v

x holds the plant, the controller, the source's filter, and of a sampled loop the forces that are
under way. Sampled, the plant runs behind a hold and a delay with what disturbs it in continuous
time; its share of Q is

    ∫₀ᵀ e^{As} W W' e^{A's}/2 ds      (Van Loan 1978, of T/2ᵏ, then doubled k times)

and e is the error at the samples. White sensor noise is that of the samples: its density counts up
to half the rate. The controller is converted by Tustin's rule without prewarping. A sampled loop is
kept as its change over a period: slow poles would lose their digits next to 1.

Everything is analytic in the matrices of plant and controller, so that a step along the imaginary
axis gives derivatives to rounding (Squire and Trapp 1998).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import expm, matrix_balance

from ccd_casadi.budget.sources import Kind, Source
from ccd_casadi.plants.scaling import StateSpace

INSTANT = 1e-9  # share of a period that counts as none
Matrix = np.ndarray[Any, Any]  # real, or complex with a step along the imaginary axis


@dataclass(frozen=True)
class Hold:
    """A sampled loop: period T and delay from measurement to force in s."""

    period: float
    delay: float = 0.0

    @property
    def parts(self) -> tuple[int, float]:
        """Whole periods of the delay, and the rest in s."""
        whole = int(np.floor(self.delay / self.period + INSTANT))
        return whole, max(self.delay - whole * self.period, 0.0)


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


def process(G: StateSpace, K: StateSpace, source: Source, hold: Hold | None) -> Process:
    """The loop of a plant without feedthrough (SI) and a controller (e in, u out) under a source.

    Raises ValueError for a tabulated source, which has no state space.
    """
    if not source.shaped:
        raise ValueError("a tabulated source has no state space")
    channels = G.B.shape[1] if _is_force(source) else len(G.C)
    own, each = source.shaping(), np.eye(channels)
    shape = StateSpace(*(np.asarray(np.kron(each, getattr(own, name)), float) for name in "ABCD"))
    if hold is None:
        return _continuous(G, K, shape, source.kind)
    return _sampled(G, K, shape, source.kind, hold)


def _is_force(source: Source) -> bool:
    return source.kind in (Kind.FORCE, Kind.FLOOR_MOTION)


def _continuous(G: StateSpace, K: StateSpace, f: StateSpace, kind: Kind) -> Process:
    n, nk, nf = len(G.A), len(K.A), len(f.A)
    loop = _stack([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    force = np.hstack([-K.D @ G.C, K.C])
    C = np.hstack([-G.C, np.zeros((len(G.C), nk + nf))])
    if kind in (Kind.FORCE, Kind.FLOOR_MOTION):
        enters, direct = (
            np.vstack([G.B, np.zeros((nk, len(G.B.T)))]),
            np.zeros((len(K.C), len(G.B.T))),
        )
    else:
        sign = -1.0 if kind is Kind.SENSOR_NOISE else 1.0
        enters, direct = sign * np.vstack([G.B @ K.D, K.B]), sign * K.D
        if kind is Kind.SETPOINT:
            C = np.hstack([C[:, : n + nk], f.C])
    A = _stack([[loop, enters @ f.C], [np.zeros((nf, n + nk)), f.A]])
    W = np.vstack([enters @ f.D, f.B])
    F = np.hstack([force, direct @ f.C])
    white = direct @ f.D
    return Process(A, 0.5 * W @ W.T, C, F, np.zeros((len(A), 0)), np.zeros((len(F), 0)),
                   infinite_error=kind is Kind.SETPOINT and bool(np.any(f.D)),
                   infinite_force=bool(np.any(white)))  # fmt: skip


def _sampled(G: StateSpace, K: StateSpace, f: StateSpace, kind: Kind, hold: Hold) -> Process:
    A, B, C = G.A, G.B, G.C
    W = np.zeros((len(A), 1))
    disturbed = kind in (Kind.FORCE, Kind.FLOOR_MOTION)
    if disturbed:
        A = _stack([[A, B @ f.C], [np.zeros((len(f.A), len(A))), f.A]])
        W = np.vstack([B @ f.D, f.B])
        B = np.vstack([B, np.zeros((len(f.A), B.shape[1]))])
        C = np.hstack([C, np.zeros((len(C), len(f.A)))])
    change, gains = held(A, B, hold)
    k, k_change = tustin(K, hold.period), tustin_change(K, hold.period)
    m, n, nk = B.shape[1], len(A), len(k.A)
    nf = 0 if disturbed else len(f.A)
    kept = len(gains) - 1
    size = n + nk + nf + kept * m
    one = np.eye(size)
    x, c, z, old = np.split(one, np.cumsum([n, nk, nf]))
    e = -C @ x
    sign = -1.0 if kind is Kind.SENSOR_NOISE else 1.0
    if not disturbed:
        e = e + sign * f.C @ z
    u = k.C @ c + k.D @ e
    forces = [u, *np.split(old, kept)] if kept else [u]
    rows = [change @ x + sum(g @ force for g, force in zip(gains, forces, strict=True))]
    rows.append(k_change @ c + k.B @ e)
    Q = np.zeros((size, size))
    error, E, V = -C @ x, np.zeros((size, 0)), np.zeros((m, 0))
    if disturbed:
        Q = x.T @ noise_of_a_period(A, W, hold.period) @ x
    else:
        rows.append(held(f.A, np.zeros((nf, 1)), Hold(hold.period))[0] @ z)
        Q = z.T @ noise_of_a_period(f.A, f.B, hold.period) @ z
        if kind is Kind.SETPOINT:
            error = e
        # The white part, of variance density times half the rate, enters by way of e alone.
        white = sign * f.D / np.sqrt(2.0 * hold.period)
        by = [gains[0] @ k.D @ white, k.B @ white, np.zeros((nf, white.shape[1]))]
        if kept:
            by += [k.D @ white, np.zeros(((kept - 1) * m, white.shape[1]))]
        E = np.vstack(by)
        V = k.D @ white
    if kept:
        rows.append(np.vstack(forces[:kept]) - old)
    return Process(np.vstack(rows), Q, error, u, E, V, sampled=True)


def held(A: Matrix, B: Matrix, hold: Hold) -> tuple[Matrix, list[Matrix]]:
    """x_{k+1} = Φ x_k + Σ Γ_i u_{k-i} behind hold and delay: Φ - 1, and all Γ_i."""
    n, m = B.shape
    whole, rest = hold.parts
    late, late_in = _over(A, hold.period - rest)
    gains = [np.zeros((n, m))] * whole + [late_in @ B]
    if rest == 0.0:
        return late, gains
    early, early_in = _over(A, rest)
    moved = early_in + late @ early_in
    return late + early + late @ early, [*gains, moved @ B]


def _over(A: Matrix, h: float) -> tuple[Matrix, Matrix]:
    """e^{Ah} - 1 = A∫ and ∫₀ʰ e^{As} ds, to the digits of A h."""
    n = len(A)
    joint = _stack([[A * h, h * np.eye(n)], [np.zeros((n, 2 * n))]])
    integral = expm(joint)[:n, n:] if n else A
    return A @ integral, integral


def noise_of_a_period(A: Matrix, W: Matrix, T: float) -> Matrix:
    """∫₀ᵀ e^{As} W W'/2 e^{A's} ds by Van Loan's exponential of a short step and doublings.

    The exponential holds e^{-Ah}, so the step is short; Q(2h) = Q(h) + Φ(h) Q(h) Φ(h)' adds no
    error of cancellation.
    """
    n = len(A)
    if n == 0:
        return np.zeros((0, 0))
    doublings = max(0, int(np.ceil(np.log2(max(np.abs(A).sum(0).max() * T, 1e-300)))))
    h = T / 2.0**doublings
    whole = expm(h * _stack([[-A, 0.5 * W @ W.T], [np.zeros((n, n)), A.T]]))
    moved = whole[n:, n:].T
    Q = moved @ whole[:n, n:]
    for _ in range(doublings):
        Q, moved = Q + moved @ Q @ moved.T, moved @ moved
    return 0.5 * (Q + Q.T)


def tustin(K: StateSpace, T: float) -> StateSpace:
    """K at z by s = (2/T)(z - 1)/(z + 1)."""
    one = np.eye(len(K.A))
    inverse = np.linalg.inv(one - 0.5 * T * K.A)
    return StateSpace(
        inverse @ (one + 0.5 * T * K.A),
        T * inverse @ K.B,
        K.C @ inverse,
        K.D + 0.5 * T * K.C @ inverse @ K.B,
    )


def tustin_change(K: StateSpace, T: float) -> Matrix:
    """A of `tustin` less 1."""
    return T * np.linalg.solve(np.eye(len(K.A)) - 0.5 * T * K.A, K.A)


def _stack(blocks: list[list[Matrix]]) -> Matrix:
    return np.vstack([np.hstack(row) for row in blocks])
