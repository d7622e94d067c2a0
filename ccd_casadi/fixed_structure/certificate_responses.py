"""The loops as the judge closes them: hold and delay, Tustin's rule, σ_max of S, KS, T and GS.

With A = QTQᴴ, T upper triangular (Schur), C(s - A)⁻¹B is a back substitution, for all plants and
all s at once. Of the search's own rows and kernels nothing is used. The peaks of S that are found
so are confirmed by Hamiltonian matrices (`lti.norms`), which begin at them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm, matrix_balance, schur

from ccd_casadi.fixed_structure.bounds import Bounds, BrokenAt, ChannelBounds
from ccd_casadi.lti.loop import Sampling, with_delays
from ccd_casadi.lti.norms import hinf_norm
from ccd_casadi.lti.state_space import StateSpace, balance_system, sigma_max
from ccd_casadi.lti.wiring import ForcedPlant
from ccd_casadi.support.arrays import Array


def error_response(G: StateSpace, K: StateSpace) -> StateSpace:
    """S, r to e, of a plant without feedthrough; the judge's own, beside `lti.closed_loop`."""
    A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    B = np.vstack([G.B @ K.D, K.B])
    C = np.hstack([-G.C, np.zeros((len(G.C), len(K.A)))])
    return StateSpace(A, B, C, np.eye(len(G.C)))


def zoh(G: StateSpace, sampling: Sampling) -> StateSpace:
    """u_k to y_k with the delay as whole periods and a rest, in which the older force still acts.

    The judge's own, beside `lti.loop.zoh`.

    ẋ = A x + B u with u held is integrated over both parts of a period by one exponential of
    [[A, B, 0], [0, 0, 1/T], [0, 0, 0]]-like blocks each.
    """
    T, (n, m) = sampling.period, G.B.shape
    whole = int(np.floor(sampling.delay / T + 1e-9))
    rest = max(sampling.delay - whole * T, 0.0)
    if G.period:
        return with_delays(G.A, [0.0 * G.B] * whole + [G.B], G.C, G.period)
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
    loop = error_response(zoh(balanced_system(G), sampling), balanced_system(K))
    return bool(np.abs(np.linalg.eigvals(matrix_balance(loop.A)[0])).max() < 1.0)


def balanced_system(system: StateSpace) -> StateSpace:
    """The same in coordinates in which A, B and C are balanced."""
    A, B, C = balance_system(system.A, system.B, system.C)
    return replace(system, A=A, B=B, C=C)


@dataclass(frozen=True)
class LoopsAsRun:
    """Loops of one controller on plants of one size, as they run, in balanced coordinates.

    Attributes
    ----------
    plants, G : sequence of StateSpace
        Continuous; behind hold and delay where the loop is sampled.
    controller, K : StateSpace
        Continuous; as it runs.
    free, driven : sequence of StateSpace
        From disturbing forces; from u to what counts, empty where that is G's.
    S : sequence of StateSpace
        From references to errors.
    poles : sequence of (n,) array
        Of S.
    sampling : Sampling or None
        None: continuous.
    """

    plants: Sequence[StateSpace]
    G: Sequence[StateSpace]
    controller: StateSpace
    K: StateSpace
    free: Sequence[StateSpace]
    driven: Sequence[StateSpace]
    S: Sequence[StateSpace]
    poles: Sequence[np.ndarray]
    sampling: Sampling | None

    @property
    def growth(self) -> list[float]:
        """Largest real part of each loop's poles, 1/s; where they are sampled largest |z| - 1."""
        if self.sampling is None:
            return [float(p.real.max()) for p in self.poles]
        return [float(np.abs(p).max() - 1.0) for p in self.poles]

    def only(self, kept: Sequence[int]) -> "LoopsAsRun":
        """Some of them."""

        def some(part: Sequence[StateSpace]) -> list[StateSpace]:
            return [part[i] for i in kept] if part else []

        return replace(
            self, plants=some(self.plants), G=some(self.G), free=some(self.free),
            driven=some(self.driven), S=some(self.S), poles=[self.poles[i] for i in kept],
        )  # fmt: skip


def loops_as_run(
    plants: Sequence[StateSpace], controller: StateSpace, sampling: Sampling | None
) -> LoopsAsRun:
    """Close the loops of one controller on plants of one size, SI."""
    own, K = [balanced_system(plant) for plant in plants], balanced_system(controller)
    G, held = own, K
    if sampling is not None:
        G, held = [zoh(one, sampling) for one in own], as_run(K, sampling)
    free = [balanced_system(getattr(plant, "mechanics", plant)) for plant in plants]
    others = [getattr(plant, "counted", None) for plant in plants]
    driven = [balanced_system(one) for one in others if one is not None]
    if sampling is not None:
        driven = [zoh(one, sampling) for one in driven]
    if plants[0].period:  # what acts on it between its instants is not known
        free = G
    S = [error_response(one, held) for one in G]
    poles = [np.linalg.eigvals(one.A) for one in S]
    return LoopsAsRun(own, G, K, held, free, driven, S, poles, sampling)


class Triangular:
    """State spaces of one shape by their Schur forms; one alone counts for every plant."""

    def __init__(self, systems: Sequence[StateSpace]) -> None:
        forms = [_schur(x.A) for x in systems]
        self.T = np.array([T for T, _ in forms])
        coupled = np.triu((self.T != 0.0).any(axis=0), 1)
        self.coupled = [np.flatnonzero(row) for row in coupled]  # few states of a modal plant are
        self.B = np.array([Q.conj().T @ x.B for (_, Q), x in zip(forms, systems, strict=True)])
        self.C = np.array([x.C @ Q for (_, Q), x in zip(forms, systems, strict=True)])
        self.D = np.array([x.D for x in systems])

    def at(self, which: np.ndarray, s: np.ndarray) -> np.ndarray:
        """C(s - A)⁻¹B + D (N, k, p, m) of the systems `which` (N,) at points s (N, k)."""
        own = which if len(self.T) > 1 else np.zeros_like(which)
        p, m = self.D.shape[1:]
        found = np.empty((*s.shape, p, m), complex)
        step = max(1, 8192 // (s.shape[1] * m))  # numbers that stay in a processor's cache
        for first in range(0, len(s), step):
            part = slice(first, first + step)
            found[part] = self._substitute(own[part], s[part])
        return found

    def _substitute(self, own: np.ndarray, s: np.ndarray) -> np.ndarray:
        T, B, C, (N, k) = self.T[own], self.B[own], self.C[own], s.shape
        n, m = B.shape[1:]
        X = np.empty((N, n, k * m), complex)  # (s - T)⁻¹B
        for i in reversed(range(n)):
            right, j = B[:, i, None, :], self.coupled[i]
            if len(j):
                right = right + (T[:, i, j][:, None] @ X[:, j]).reshape(N, k, m)
            X[:, i] = (right / (s - T[:, i, i, None])[..., None]).reshape(N, k * m)
        total = (C @ X).reshape(N, C.shape[1], k, m).transpose(0, 2, 1, 3)
        return np.asarray(self.D[own, None] + total)


class LoopResponses:
    """The loops of a set of plants: `free` as a disturbing force moves them, `G` as the loop has
    them, with hold and delay; K of the controller, which may have an `integrator`. Where something
    else than the outputs is `counted`, from u as the loop has it, it is below these in `free`, too.

    At a pole of G on the axis S, KS, T and GS have limits, which are taken a little beside it.
    """

    def __init__(
        self,
        free: Sequence[StateSpace],
        G: Sequence[StateSpace],
        K: StateSpace,
        sampling: Sampling | None,
        bounds: Bounds,
        integrator: bool = True,
        counted: Sequence[StateSpace] = (),
    ) -> None:
        self.G, self.K = Triangular(G), Triangular([K])
        self.counted = Triangular(counted) if counted else None
        alike = free[0].period or (sampling is None and not isinstance(G[0], ForcedPlant))
        self.free = None if alike else Triangular(free)
        self.period = None if sampling is None else sampling.period
        self.bounds, self.integrator = bounds, integrator
        self.plants = free

    def at(self, which: np.ndarray, omega: Array) -> dict[str, Array]:
        """Every curve (N, k) of the plants `which` (N,) at ω (N, k) in rad/s."""
        return self._curves(self._matrices(which, omega), omega)

    def with_lesser(
        self, which: np.ndarray, omega: Array
    ) -> tuple[dict[str, Array], dict[str, Array]]:
        """Every curve, and all singular values (N, k, p) of S, KS, T and GS, the least first."""
        matrices = self._matrices(which, omega)
        sizes = {name: _singular(M) for name, M in matrices.items()}
        largest = {name: each[..., -1] for name, each in sizes.items()}
        return self._curves(matrices, omega, largest), sizes

    def weights(self, omega: Array) -> dict[str, Array]:
        """|W_KS| and |W_T| by what they weigh, where there are any."""
        if self.bounds.weights is None:
            return {}
        sizes = np.abs(self.bounds.weights.responses(omega.ravel())).reshape(3, *omega.shape)
        return {"KS": sizes[1], "T": sizes[2]}

    def _curves(
        self, matrices: dict[str, np.ndarray], omega: Array, sizes: dict[str, Array] | None = None
    ) -> dict[str, Array]:
        if self.bounds.error is not None:
            return self._break_loops(matrices, omega)
        found = sizes or {name: sigma_max(M) for name, M in matrices.items()}
        weights = self.weights(omega)
        found |= {f"weighted {name}": W * found[name] for name, W in weights.items()}
        for own in self.bounds.channels:
            if own.given:
                found[f"S of {own.name}"] = _length(own.output, matrices["S"])
            if own.M_K is not None and self.bounds.weights is not None:
                W = self.bounds.weights.M_K / own.M_K * weights["KS"]
                found[f"weighted KS of {own.name}"] = W * _length(own.force, matrices["KS"])
        return found

    def _break_loops(self, matrices: dict[str, np.ndarray], omega: Array) -> dict[str, Array]:
        """Compute for sensors that share an actuator S, T and GS of the one whose error counts, and
        S of the loop that is broken at each place."""
        own = self.bounds.channels[self.bounds.error or 0]
        entry = entry_of(own, matrices["S"])
        found = {"S": np.abs(entry), "KS": sigma_max(matrices["KS"]), "T": np.abs(1.0 - entry),
                 "GS": _length(own.output, matrices["GS"])}  # fmt: skip
        for one in self.bounds.channels:
            at_sensor = one.place is BrokenAt.SENSOR
            broken = matrices["S"] if at_sensor else matrices["S at the actuator"]
            found[f"S of {one.name}"] = np.abs(entry_of(one, broken))
        weights = self.weights(omega)
        return found | {f"weighted {name}": W * found[name] for name, W in weights.items()}

    def sensitivity(
        self, which: np.ndarray, omega: Array, row: Sequence[float] | None = None
    ) -> Array:
        """σ_max(S), or ‖rᵀS‖ of a row r, as `at`."""
        S = self._loops(which, omega)[0]
        if self.bounds.error is not None:
            return np.asarray(np.abs(entry_of(self.bounds.channels[self.bounds.error], S)))
        return sigma_max(S) if row is None else _length(row, S)

    def open_loops(self, which: np.ndarray, omega: Array) -> Array:
        """All singular values (N, k, p) of L = GK, the least first, as `at`."""
        _, g, k = self._loops(which, omega)
        return np.asarray(np.linalg.svd(_product(g, k), compute_uv=False)[..., ::-1])

    def _off_poles(self, which: np.ndarray, omega: Array) -> Array:
        """ω (N, k), at poles on the axis a little more."""
        if not any(len(one.on_axis) for one in self.plants):
            return omega
        pairs = zip(which, omega, strict=True)
        return np.array([self.plants[i].off_poles(each, self.period) for i, each in pairs])

    def _matrices(self, which: np.ndarray, omega: Array) -> dict[str, np.ndarray]:
        omega = self._off_poles(which, omega)
        S, g, k = self._loops(which, omega)
        free = g if self.free is None else self.free.at(which, 1j * omega)
        KS, p = _product(k, S), g.shape[-2]
        found = {"S": S, "KS": KS, "T": _product(g, KS), "GS": _product(S, free[..., :p, :])}
        if self.counted is not None:
            driven = self.counted.at(which, self._points(omega))[..., p:, :]
            found["GS"] = free[..., p:, :] - driven @ KS @ free[..., :p, :]
        if self.bounds.error is not None:
            found["S at the actuator"] = np.linalg.inv(np.eye(k.shape[-2]) + k @ g)
        return found

    def _loops(self, which: np.ndarray, omega: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s = self._points(self._off_poles(which, omega))
        g, k = self.G.at(which, s), self.K.at(which, s)
        open_ = np.eye(g.shape[-2]) + _product(g, k)
        return (1.0 / open_ if open_.shape[-1] == 1 else np.linalg.inv(open_)), g, k

    def _points(self, omega: Array) -> np.ndarray:
        """s, of a sampled loop z."""
        return 1j * omega if self.period is None else np.exp(1j * omega * self.period)

    def lost(self, which: np.ndarray, omega: Array) -> Array:
        """How many times larger than what forces move is what they move without K (N, k), where
        that is subtracted: rounding of the latter is that of the former."""
        if self.counted is None:
            return np.zeros(omega.shape)
        assert self.free is not None
        omega = self._off_poles(which, omega)
        alone = sigma_max(self.free.at(which, 1j * omega)[..., self.G.C.shape[1] :, :])
        return np.asarray(alone / sigma_max(self._matrices(which, omega)["GS"]))


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Multiply matrices (..., p, q) and (..., q, m)."""
    return np.asarray(a * b if a.shape[-1] == 1 else a @ b)


def _schur(A: Array) -> tuple[np.ndarray, np.ndarray]:
    """T and Q of A = QTQᴴ, each part of A that is coupled to no other by itself: channels of a
    controller and modes of a plant stay apart in T."""
    joined = (A != 0.0) | (A.T != 0.0) | np.eye(len(A), dtype=bool)
    for _ in range(len(A).bit_length()):
        joined = joined @ joined
    first = np.array([row.argmax() for row in joined], int)  # of the states each is coupled to
    T, Q, done = (*np.zeros((2, *A.shape), complex), 0)
    for part in np.unique(first):
        own = np.flatnonzero(first == part)
        place = slice(done, done + len(own))
        T[place, place], Q[own, place] = schur(A[np.ix_(own, own)], output="complex")
        done += len(own)
    return T, Q


def _singular(M: np.ndarray) -> Array:
    """All singular values (..., p) of matrices (..., p, m), the least first, as `sigma_max`."""
    squared = np.linalg.eigvalsh(M @ M.conj().swapaxes(-1, -2))
    return np.sqrt(np.maximum(squared, 0.0))


def entry_of(bounds: ChannelBounds, M: np.ndarray) -> np.ndarray:
    """uᵀ M r of a sensor, wᵀ M w of an actuator, of matrices (..., p, m)."""
    at_sensor = bounds.place is BrokenAt.SENSOR
    left, right = (bounds.output, bounds.reference) if at_sensor else (bounds.force, bounds.force)
    return np.asarray(np.array(left) @ M @ np.array(right))


def _length(row: Sequence[float], M: np.ndarray) -> Array:
    """‖rᵀM‖ of a row r and matrices (..., p, m)."""
    return np.asarray(np.linalg.norm(np.array(row) @ M, axis=-1))


def norms(
    loops: Sequence[StateSpace], period: float | None, peak: Array, at: Array,
    *, tolerance: float = 1e-6,
) -> tuple[Array, np.ndarray]:  # fmt: skip
    """‖S‖∞ (P,) of every plant's loop, and whether `peak` (P,) at ω (P,) is it, to `tolerance`.

    `loops` are S, or a row of it, of sampled loops in z.
    """
    run = (replace(loop, period=period or 0.0) for loop in loops)
    each = [hinf_norm(loop, omega)[0] for loop, omega in zip(run, at, strict=True)]
    found = np.maximum(peak, each)
    return found, np.abs(found / peak - 1.0) <= tolerance
