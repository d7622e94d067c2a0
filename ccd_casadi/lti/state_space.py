"""State-space systems: response, poles, zeros, series connection, and the closed loop of two."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import eig, matrix_balance, schur, solve_sylvester

from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class StateSpace:
    """A linear system, in continuous or in discrete time.

        ẋ = A x + B v,   z = C x + D v;   with a period   x_{k+1} = A x_k + B v_k

    Parameters
    ----------
    A, B, C, D : array (n, n), (n, m), (p, n), (p, m)
        Its matrices.
    period : float
        s; 0: continuous.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    period: float = field(default=0.0, kw_only=True)

    def at(self, s: np.ndarray) -> np.ndarray:
        """C (s - A)⁻¹ B + D (k, p, m) at points s (k,) of its plane, s or z.

        Raises LinAlgError at a pole.
        """
        if not len(self.A):
            return np.broadcast_to(self.D, (len(s), *self.D.shape)).astype(complex)
        whole = s[:, None, None] * np.eye(len(self.A)) - self.A
        return np.asarray(self.C @ np.linalg.solve(whole, self.B + 0j) + self.D)

    def response(self, omega: Array) -> np.ndarray:
        """(k, p, m) at s = jω, or z = e^{jωT}, for ω (k,) in rad/s. Raises LinAlgError at a pole.

        >>> lag = StateSpace(*(np.array([[x]]) for x in (-1.0, 1.0, 1.0, 0.0)))
        >>> complex(lag.response(np.array([1.0]))[0, 0, 0])
        (0.5-0.5j)
        """
        return self.at(self.variable(omega))

    def sweep(self, omega: Array) -> np.ndarray:
        """`response` at many frequencies: by eigenvectors where these are sound (cond < 1e8).

        `off_poles`, so that loops of undamped plants have S, KS, T and GS there.
        """
        omega = self.off_poles(omega)
        if self.modes is None and self.at_rest is not None:
            rest, others = self.at_rest
            return rest.sweep(omega) + others.sweep(omega)
        if self.modes is None:
            return self.response(omega)
        poles, drive, reading = self.modes
        parts = reading / (self.variable(omega)[:, None] - poles)[:, None, :]
        return np.asarray(parts @ drive + self.D)

    def off_poles(
        self, omega: Array, period: float | None = None, *, beside: float = 1e-8
    ) -> Array:
        """ω (k,) in rad/s, a little more where a pole on the axis is nearer than `beside` of ω; of
        what is sampled with a `period` in s also where it shows as an alias."""
        fold, on_axis = np.pi / (period or np.inf), self.on_axis
        if period:
            on_axis = np.append(on_axis, np.abs((on_axis + fold) % (2.0 * fold) - fold))
        for on in on_axis:
            near = np.abs(omega - on) < beside * omega
            omega = np.where(near, (1.0 + 2.0 * beside) * omega, omega)
        return omega

    @cached_property
    def on_axis(self) -> Array:
        """Frequencies in rad/s of its poles on the axis, but for 0."""
        rates = self.rates
        on = (np.abs(rates.real) <= 1e-7 * np.abs(rates)) & (rates.imag > 0.0)
        return np.asarray(rates.imag[on])

    def variable(self, omega: Array) -> np.ndarray:
        """s or z (k,) at ω (k,) in rad/s."""
        s = 1j * np.asarray(omega, float)
        return s if not self.period else np.exp(s * self.period)

    @property
    def poles(self) -> np.ndarray:
        """The eigenvalues of A."""
        return np.linalg.eigvals(self.A)

    @property
    def rates(self) -> np.ndarray:
        """Poles in 1/s: ln(z)/T of a system in discrete time, those of a delay left out."""
        return self.rates_of(self.poles)

    def rates_of(self, roots: np.ndarray, *, decayed: float = 1e-6) -> np.ndarray:
        """Poles or zeros of this system in 1/s, without those |z| <= `decayed` of a delay."""
        if not self.period:
            return roots
        return np.log(roots[np.abs(roots) > decayed].astype(complex)) / self.period

    @property
    def stable(self) -> bool:
        """Whether every pole lies in the open left half plane, or inside the unit circle."""
        if not self.period:
            return bool(self.poles.real.max(initial=-np.inf) < 0.0)
        return bool(np.abs(self.poles).max(initial=0.0) < 1.0)

    @cached_property
    def modes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Poles (n,), V⁻¹B (n, m) and CV (p, n) with eigenvectors V; None where these are not
        sound.

        LAPACK balances A first. Where entries of A are rounding alone, as those of Tustin's rule
        are beside its poles at z = 0, that costs V six digits: AV = V diag(poles) shows it.
        """
        poles, V = np.linalg.eig(self.A)
        if len(V) and not np.linalg.cond(V) < 1e8:  # a response of fewer than 8 digits
            return None
        if not np.abs(self.A @ V - V * poles).max(initial=0.0) <= 1e-13 * np.abs(self.A).max(
            initial=0.0
        ):
            return None
        return poles, np.linalg.solve(V, self.B + 0j), self.C @ V

    @cached_property
    def at_rest(self) -> "tuple[StateSpace, StateSpace] | None":
        """The part of the poles at 0, free bodies whose eigenvectors are no basis, and the rest.

        With the first k Schur vectors U of these, A = U T Uᵀ and T₁₁ Y - Y T₂₂ = -T₁₂,
        C (s - A)⁻¹ B = C₁ (s - T₁₁)⁻¹ (B₁ - Y B₂) + (C₁ Y + C₂) (s - T₂₂)⁻¹ B₂. None without such
        poles, without others, and in discrete time.
        """
        own = self.balance()
        sizes = np.abs(own.poles)  # in these units two poles at 0 do not split by rounding
        if self.period or not 0 < (sizes == 0.0).sum() < len(sizes):
            return None
        T, U, k = schur(own.A, sort=lambda x, y: x == y == 0.0)
        if not 0 < k < len(sizes):
            return None
        Y = solve_sylvester(T[:k, :k], -T[k:, k:], -T[:k, k:])
        B, C = U.T @ own.B, own.C @ U
        return (
            StateSpace(T[:k, :k], B[:k] - Y @ B[k:], C[:, :k], self.D),
            strictly_proper(T[k:, k:], B[k:], C[:, :k] @ Y + C[:, k:]),
        )

    def zeros(self, unit: float = 1.0, *, infinite: float = 1e5) -> np.ndarray:
        """Finite invariant zeros of a square system, |z| < `infinite` `unit`; none of another.

        The eigenvalues of [[A, B], [C, D]] - z [[1, 0], [0, 0]], each part scaled to about one.
        """
        n, m = self.B.shape
        if len(self.C) != m or n == 0:
            return np.empty(0, complex)
        b = float(np.abs(self.B).max()) or 1.0
        D = self.D * (unit / b)
        c = max(float(np.abs(self.C).max()), float(np.abs(D).max())) or 1.0
        system = np.block([[self.A / unit, self.B / b], [self.C / c, D / c]])
        weight = np.zeros_like(system)
        weight[:n, :n] = np.eye(n)
        values = eig(system, weight, right=False)
        return np.asarray(values[np.isfinite(values) & (np.abs(values) < infinite)] * unit)

    def balance(self) -> "StateSpace":
        """The same in states of even scales (`balance_system`).

        The gains of leads multiply along a cascade of sections: its states lie up to 17 decades
        apart, and nothing is left of the digits of |S| in a closed loop.
        """
        A, B, C = balance_system(self.A, self.B, self.C)
        return StateSpace(A, B, C, self.D, period=self.period)

    def series(self, then: "StateSpace") -> "StateSpace":
        """`then` behind this system."""
        n, m = len(self.A), len(then.A)
        return StateSpace(
            np.block([[self.A, np.zeros((n, m))], [then.B @ self.C, then.A]]),
            np.vstack([self.B, then.B @ self.D]),
            np.hstack([then.D @ self.C, then.C]),
            then.D @ self.D,
            period=self.period,
        )

    def in_units(self, rate: float, gain: float) -> "StateSpace":
        """The system with its time in 1/`rate` and its output in `gain`: A/rate, B/rate, C/gain."""
        return StateSpace(
            self.A / rate, self.B / rate, self.C / gain, self.D / gain, period=self.period * rate
        )


def strictly_proper(A: Array, B: Array, C: Array, period: float = 0.0) -> StateSpace:
    """Make a system with D = 0.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)
    period : float
        s; 0: continuous.

    Returns
    -------
    StateSpace
    """
    return StateSpace(A, B, C, np.zeros((len(C), B.shape[1])), period=period)


def balance_system(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array]:
    """Balance a system: T⁻¹AT, T⁻¹B, CT with a diagonal T of powers of two.

    T evens out the states' scales. Inputs and outputs keep their units: balancing does not change
    what has an empty row or column.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)

    Returns
    -------
    A, B, C : arrays of the same shapes
    """
    t = state_scales(A, B, C)
    parts = A * t / t[:, None], B / t[:, None], C * t
    A, B, C = (np.ascontiguousarray(part) for part in parts)
    return A, B, C


def state_scales(A: Array, B: Array, C: Array) -> Array:
    """Find the T of `balance_system`.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)

    Returns
    -------
    array (n,)
        Powers of two.
    """
    n, m, p = len(A), B.shape[1], C.shape[0]
    system = np.zeros((n + m + p, n + m + p))
    system[:n, :n], system[:n, n : n + m], system[n + m :, :n] = A, B, C
    with np.errstate(invalid="ignore"):  # scales beyond 64 bits, as integers that nobody reads
        scales = matrix_balance(system, permute=False, separate=True)[1][0]
    return np.asarray(scales[:n], float)


def even_units(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array, float]:
    """Find units in which the entries that are not 0 have sizes near 1, in the logarithm's mean.

        min Σ (ln|aᵢⱼ| + tⱼ - tᵢ - ρ)² + Σ (ln|bᵢⱼ| + uⱼ - tᵢ - ρ)² + Σ (ln|cᵢⱼ| + tⱼ - yᵢ)²

    Whatever diagonal units A, B and C are given in, they are the same in these. `state_scales`
    leaves inputs and outputs as they are, and a cascade's couplings as small as it can.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)

    Returns
    -------
    t (n,), u (m,), y (p,), rate
        Of A t/t/rate, B u/t/rate and C t/y: powers of two.
    """
    n, m, p = len(A), B.shape[1], len(C)
    whole = np.zeros((n + m + p, n + m + p))
    whole[:n, :n], whole[:n, n : n + m], whole[n + m :, :n] = A, B, C
    there, timed = 1.0 * (whole != 0.0), np.arange(len(whole)) < n
    sizes = np.log2(np.where(whole, np.abs(whole), 1.0))
    mean = np.diag(there.sum(0) + there.sum(1)) - there - there.T
    own = (timed * there.T).T
    rate = own.sum(1) - own.sum(0)
    normal = np.block([[mean, rate[:, None]], [rate, own.sum()]])
    right = np.append(sizes.sum(1) - sizes.sum(0), sizes[:n].sum())
    units = np.exp2(np.round(np.linalg.lstsq(normal, right)[0]))
    return units[:n], units[n : n + m], units[n + m : -1], float(units[-1])


def leading_term(A: Array, B: Array, C: Array, *, rounding: float = 1e-13) -> tuple[int, Array]:
    """Find the leading term C Aⁿ⁻¹ B/sⁿ of a plant at high frequencies.

    A product is 0 where every entry is a rounding of the sum of its parts' sizes, |C||A|ⁿ⁻¹|B|:
    no unit of a state, an input or an output changes that.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)
    rounding : float
        Relative size below which a product is 0.

    Returns
    -------
    n : int
        2 where C A B is not zero, else the first n whose term is not; 0 where the plant is 0.
    term : array (p, m)
        C Aⁿ⁻¹ B.
    """
    found, power, sizes = {}, B, np.abs(B)
    for n in range(1, len(A) + 1):
        if (np.abs(C @ power) > rounding * np.abs(C) @ sizes).any():
            found[n] = C @ power
        power, sizes = A @ power, np.abs(A) @ sizes
    order = 2 if 2 in found else min(found, default=0)
    return order, found.get(order, C @ B)


def filter_outputs(system: StateSpace, filters: Array) -> StateSpace:
    """Filter each output of a continuous system: through (s + zero)/(s + pole).

    Parameters
    ----------
    system : StateSpace
        With p outputs.
    filters : array (p, 3)
        Rows of pole (1/s), feedthrough and zero (1/s).

    Returns
    -------
    StateSpace
    """
    pole, through, zero = filters.T
    A, B, C, D = system.A, system.B, system.C, system.D
    return StateSpace(
        np.block([[A, np.zeros((len(A), len(C)))], [C, -np.diag(pole)]]),
        np.vstack([B, D]),
        np.hstack([through[:, None] * C, np.diag(through * (zero - pole))]),
        through[:, None] * D,
    )


@dataclass(frozen=True)
class ClosedLoop:
    """ẋ = A x + B_r r + B_d d (x⁺ in discrete time), y = C_y x, u = C_u x + D_u r.

    x = [x_G; x_K]; sensor noise n enters as -r does.

    Attributes
    ----------
    A : array (n, n)
    B_r, B_d : arrays (n, p), (n, m)
        Of the reference and of a force that adds to u.
    C_y, C_u, D_u : arrays (p, n), (m, n), (m, p)
    period : float
        s; 0: continuous.
    counted : array (z, n), optional
        What a force moves, where that is not y.
    """

    A: Array
    B_r: Array
    B_d: Array
    C_y: Array
    C_u: Array
    D_u: Array
    period: float = 0.0
    counted: Array | None = None

    @cached_property
    def S(self) -> StateSpace:
        """r to e: (1 + GK)⁻¹."""
        return StateSpace(self.A, self.B_r, -self.C_y, np.eye(len(self.C_y)), period=self.period)

    @cached_property
    def T(self) -> StateSpace:
        """r to y: GK(1 + GK)⁻¹."""
        return strictly_proper(self.A, self.B_r, self.C_y, self.period)

    @cached_property
    def GS(self) -> StateSpace:
        """d to y: (1 + GK)⁻¹G; or to what counts."""
        C = self.C_y if self.counted is None else self.counted
        return strictly_proper(self.A, self.B_d, C, self.period)

    @cached_property
    def KS(self) -> StateSpace:
        """r to u: K(1 + GK)⁻¹."""
        return StateSpace(self.A, self.B_r, self.C_u, self.D_u, period=self.period)


def closed_loop(G: StateSpace, K: StateSpace) -> ClosedLoop:
    """Close the loop u = K(r - y).

    Parameters
    ----------
    G : StateSpace
        Plant without feedthrough, u to y.
    K : StateSpace
        Controller, e to u, of the same time.

    Returns
    -------
    ClosedLoop
    """
    m, p, k = G.B.shape[1], len(G.C), len(K.A)
    return ClosedLoop(
        A=np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]]),
        B_r=np.vstack([G.B @ K.D, K.B]),
        B_d=np.vstack([G.B, np.zeros((k, m))]),
        C_y=np.hstack([G.C, np.zeros((p, k))]),
        C_u=np.hstack([-K.D @ G.C, K.C]),
        D_u=K.D,
        period=G.period,
    )


def sensitivity(L: np.ndarray) -> np.ndarray:
    """Evaluate S = (1 + L)⁻¹.

    Parameters
    ----------
    L : complex array (k, p, p)
        Open loop GK.

    Returns
    -------
    complex array (k, p, p)
    """
    return 1.0 / (1.0 + L) if L.shape[-1] == 1 else np.linalg.inv(np.eye(L.shape[-1]) + L)


def equivalent_open_loop(L: np.ndarray, i: int) -> np.ndarray:
    """Evaluate 1/S_ii - 1, S = (1 + L)⁻¹: the open loop of channel i with the others closed.

    Parameters
    ----------
    L : complex array (k, p, p)
    i : int

    Returns
    -------
    complex array (k,)
    """
    return np.asarray(L[:, 0, 0] if L.shape[1] == 1 else 1.0 / sensitivity(L)[:, i, i] - 1.0)


def sigma_max(response: np.ndarray) -> Array:
    """Compute the largest singular value, the root of the largest eigenvalue of MMᴴ.

    Squaring keeps the precision of singular values and takes two thirds of their time.

    Parameters
    ----------
    response : complex array (..., p, m)

    Returns
    -------
    array (...)
    """
    if response.shape[-2:] == (1, 1):
        return np.abs(response[..., 0, 0])
    squared = response @ response.conj().swapaxes(-1, -2)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(squared)[..., -1]))


def responses_of(G: np.ndarray, K: np.ndarray) -> dict[str, np.ndarray]:
    """Evaluate S, KS, T and GS of a loop.

    Parameters
    ----------
    G, K : complex arrays (k, p, m), (k, m, p)

    Returns
    -------
    dict of str to complex array (k, ., .)
    """
    S = sensitivity(G @ K)
    return {"S": S, "KS": K @ S, "T": G @ K @ S, "GS": S @ G}
