"""Discs around what modes are over frequencies and boxes, and the largest norm of matrices over
such discs."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.affine import Affine, inverse
from ccd_casadi.fixed_structure.boxes import FrequencyAxis, Pair
from ccd_casadi.fixed_structure.uncertainty import ModalSum
from ccd_casadi.lti.state_space import sigma_max
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class Discs:
    """The discs of n modes over N boxes: `middle`, `radius` (n, N), and what each coordinate adds
    to the latter (n, 1 + n_p, N)."""

    middle: np.ndarray
    radius: Array
    shares: Array


def discs_of(
    plant: ModalSum, names: tuple[str, ...], low: Array, high: Array, axis: FrequencyAxis,
    free: bool,
) -> tuple[Discs, Discs, np.ndarray]:  # fmt: skip
    """Enclose all modes as the loop has them, and where `free` as a force on the mechanics has
    them, without hold, delay and low passes; where all flexible modes stay damped (N,)."""
    free &= axis.period is not None or bool(axis.low_pass)
    count = (len(plant.omega), 1 + len(names), low.shape[1])
    held, bare = (
        Discs(np.zeros(count[::2], complex), np.zeros(count[::2]), np.zeros(count))
        for _ in range(2)
    )
    moved: Sequence[Sequence[Affine | None]] = [(None, None)] * count[0]
    q, known = sum(name.startswith("theta.") for name in names), np.ones(count[2], bool)
    if plant.moving is not None:
        moved, known = plant.moving(low[-q:], high[-q:])
    damped = known
    for i in range(count[0]):
        own = [k for k, name in enumerate(names)
               if name == plant.shift_of(i) or not name.startswith("mode_shift")]  # fmt: skip
        rows = [0, *(1 + k for k in own)]
        w, strength = (f and f.of(len(rows), len(rows) - q) for f in moved[i])
        if plant.rigid[i]:
            gain = plant.strength(tuple(names[k] for k in own), low[own], high[own])
            gain = gain if strength is None else gain * strength
            _fill_form(held, i, rows, axis.free_body.of(len(rows)) * gain)
            if free:
                _fill_form(bare, i, rows, axis.free_body_unheld.of(len(rows)) * gain)
            continue
        if plant.away[i]:
            on = tuple(names[k] for k in own), low[own], high[own]
            gain, (square, least) = plant.strength(*on), plant.rate_squared(i, *on)
            damped = damped & (least > 0.0)  # one pole on each side of the axis
            _fill_form(held, i, rows, axis.driven_away(square) * gain)
            if free:
                _fill_form(bare, i, rows, axis.driven_away_unheld(square) * gain)
            continue
        poles, decay = plant.poles(i, tuple(names[k] for k in own), low[own], high[own], w)
        damped = damped & (decay >= 0.0)
        T = axis.period  # of Re D, what it is not below
        least = decay * axis.x.lowest if T is None else -np.expm1(-decay * T)
        factors, beside = [axis.factor(*pole) for pole in poles], axis.lagged_of(poles)
        _fill(held, i, rows, factors, least, strength, beside)
        if free:
            plain = [(axis.s.of(len(rows)) - p, N) for p, N in poles]
            plain = [axis.plain.factor(*pole) for pole in poles] if T is None else plain
            _fill(bare, i, rows, plain, least if T is None else decay, strength)
    if q:  # where modes are not enclosed their parameters are divided before anything else
        held.shares[:, -q:] = np.where(known, held.shares[:, -q:], 1e30 * (high - low)[-q:])
    return held, bare if free else held, damped


def _fill_form(discs: Discs, i: int, rows: list[int], form: Affine) -> None:
    """The disc of a mode that has one form."""
    discs.middle[i], discs.radius[i] = form.centre, (form.reach + form.rest) * (1.0 + 1e-12)
    discs.shares[i, rows] = form.reaches


def _fill(
    discs: Discs, i: int, rows: list[int], poles: list[Pair], least: Array,
    strength: Affine | None, beside: Affine | None = None,
) -> None:  # fmt: skip
    """Mode i's disc: of both poles as one form, since far above a resonance they nearly cancel, or
    a disc of each, and of what lies `beside` them; times its strength, which may pass through 0."""
    (D, N), (E, M) = poles
    first, second = inverse(D), inverse(E)
    whole = N * first + M * second
    one, two = quotient(N, D, least, first), quotient(M, E, least, second)
    middle, apart = one[0] + two[0], one[1] + two[1]
    moves = one[2] + two[2]
    if beside is not None:
        whole, middle = whole + beside, middle + beside.centre
        apart, moves = apart + beside.reach + beside.rest, moves + beside.reaches
    if strength is not None:
        whole, size, most = whole * strength, strength.middle, np.abs(middle) + apart
        apart = size * apart + (strength.reach + strength.rest) * most
        middle, moves = strength.centre * middle, size * moves + strength.reaches * most
    radius = whole.reach + whole.rest
    near = ~(radius <= apart) | np.isinf(radius)
    discs.middle[i] = np.where(near, middle, whole.centre)
    discs.radius[i] = np.where(near, apart, radius) * (1.0 + 1e-12)
    # Where the first order cancels, as at rest, and the rest is a thousand times as large, what is
    # left is due to what moves the poles.
    beyond = whole.rest * moves / np.maximum(moves.sum(axis=0), 1e-300)
    beyond = np.where(whole.rest > 1e3 * whole.reach, beyond, 0.0)
    discs.shares[i, rows] = np.where(near, moves, whole.reaches + beyond)


def quotient(
    N: Affine, D: Affine, least: Array | float = 0.0, form: Affine | None = None
) -> tuple[np.ndarray, Array, Array]:
    """Centre and radius of a disc around N/D, and how each variable moves it (n, N); Re D >= least.

    1/D lies in that of 1/D as a `form`, or where Re e^{-jθ}D >= d, θ = -π/2, -π/4, …, π/2, in the
    disc of diameter 1/d that touches 0; N then turns and scales the latter, which keeps 0 on its
    edge. Around 0, |N|/d holds.
    """
    form = inverse(D) if form is None else form
    turns = np.exp(1j * np.pi * np.arange(-2, 3) / 4)  # e^{jθ}
    x, y = turns.real[:, None], turns.imag[:, None]
    along = x[..., None] * D.slope.real + y[..., None] * D.slope.imag
    d = x * D.centre.real + y * D.centre.imag - np.abs(along).sum(1) - D.rest
    d[len(turns) // 2] = np.maximum(d[len(turns) // 2], least)
    best = np.argmax(d, axis=0)
    d = d[best, np.arange(len(best))]
    half = np.where(d > 0.0, 0.5 / np.where(d > 0.0, d, 1.0), np.inf) * (1.0 + 1e-15)
    centre, radius = form.centre, form.reach + form.rest
    size = N.middle
    spread = N.reach + N.rest
    outer = size * radius + spread * (np.abs(centre) + radius)
    along = N.slope / np.where(size == 0.0, 1.0, N.centre)
    longer, aside = (np.abs(part).sum(0) + N.rest / size for part in (along.real, along.imag))
    grown = np.hypot(1.0 + longer, aside)
    bending = np.where(longer < 1.0, aside / np.where(longer < 1.0, 1.0 - longer, 1.0), np.inf)
    touching = size * half * grown * (1.0 + bending)
    chosen = ~(outer <= touching)
    edge = N.centre * turns[best].conj() * half * grown
    moves = D.reaches / np.where(chosen, d, D.middle) + np.abs(along)
    middle, radius = np.where(chosen, edge, N.centre * centre), np.where(chosen, touching, outer)
    plain = 2.0 * N.size * half
    middle, radius = np.where(plain < radius, 0.0, middle), np.fmin(plain, radius)
    # where nothing is bounded the relative ones say what to divide
    return middle, radius, moves * np.where(np.isinf(radius), 1.0, np.abs(middle) + radius)


GUARD = 64.0 * 2.2e-16  # several times what products, inverses and norms of a few rows lose


@dataclass(frozen=True)
class RankOneDiscs:
    """Σ δ_i c_i q_iᵀ, |δ_i| <= radius_i, of n terms on N boxes.

    Attributes
    ----------
    columns, rows : array (n, p), (N, n, p)
        c and q.
    radius : array (N, n)
    inputs : array (n, m), optional
        b, where a term adds δ_i c_i b_iᵀ; q or b is 0, by default b is.
    """

    columns: Array
    rows: np.ndarray
    radius: Array
    inputs: Array | None = None

    def pushes(self, B: np.ndarray, Z: np.ndarray) -> Array:
        """Bound how far each moves e of `largest` per radius, to first order (N, n): |B
        c_i|(|q_iᵀZ| + |b_i|)."""
        return _lengths(B @ self.columns.T, 1) * self._seen(self.rows @ Z)

    def largest(self, A: np.ndarray, B: np.ndarray, Z: np.ndarray) -> Array:
        """Bound ‖e‖ <= γ‖f‖ over all discs, of

            e = Af + Bu,   u = Σ w_i c_i,   w_i = δ_i(q_iᵀ(Zf + u) + b_iᵀf),   |δ_i| <= r_i

        so that with D = Σ δ_i c_i q_iᵀ and b = 0, e = (A + B(1 - D)⁻¹DZ)f. For every τ > 0 the sum
        of τ_i(r_i²|q_iᵀ(Zf + u) + b_iᵀf|² - |w_i|²) is not negative. Added to ‖e‖² - γ²‖f‖², whose
        largest value over w and u is to be 0 (S-procedure), it gives, where P⁻¹ > N,

            γ² = λ_max(AᴴA + ZᴴQZ + Q_b + Xᴴ(P⁻¹ - N)⁻¹X),   X = BᴴA + QZ,   N = BᴴB + Q,
            P = Σ c_i c_iᵀ/τ_i,   Q = Σ τ_i r_i² q̄_i q_iᵀ,   Q_b = Σ τ_i r_i² b_i b_iᵀ

        as Σ τ_i|w_i|² >= uᴴP⁻¹u. With p = 1, |D| <= R = Σ r_i |c_i| |q_i| < 1, and D/(1 - D) lies
        in the disc of centre R²/(1 - R²) and radius R/(1 - R²).

        Parameters
        ----------
        A, B, Z : array (N, k, m), (N, k, p), (N, p, m)

        Returns
        -------
        array (N,)
            γ with its rounding; infinite where no τ is found with P⁻¹ > N.

        References
        ----------
        S. Boyd, L. El Ghaoui, E. Feron and V. Balakrishnan, Linear Matrix Inequalities in System
        and Control Theory, SIAM 1994, section 2.6.3.
        """
        if B.shape[2] == 1:
            R = (_lengths(self.rows, 2) * np.abs(self.columns[:, 0]) * self.radius).sum(axis=1)
            good, BZ = R < 1.0, B @ Z
            R = np.where(good, R, 0.0)
            left, beside = 1.0 - R * R, self.pushes(B, 0.0 * Z) * self.radius
            value = norm(A + (R * R / left)[:, None, None] * BZ) + norm(BZ) * R / left
            value += beside.sum(axis=1) / (1.0 - R)
            return np.asarray(np.where(good, value * (1.0 + GUARD / (1.0 - R)), np.inf))
        sizes = [norm(part, loosely=True)[:, None] for part in (A, B, Z)]
        gain, seen = _lengths(B @ self.columns.T, 1), self._seen(self.rows @ Z)
        first, tau = self._level(A, B, Z, self._guess(gain, seen, sizes[0]))
        # where these lengths lead to no τ, those of c and q do if any do
        gain = sizes[1] * _lengths(self.columns, 1)
        plain = self._guess(gain, self._seen(sizes[2][..., None] * self.rows), sizes[0])
        tau = np.where(np.isinf(first)[:, None], plain, tau)
        return np.fmin(first, self._level(A, B, Z, tau)[0])

    def _seen(self, rows: np.ndarray) -> Array:
        """The lengths of what each sees of f (N, n)."""
        return _lengths(rows, 2) + (0.0 if self.inputs is None else _lengths(self.inputs, 1))

    def _guess(self, gain: Array, seen: Array, size: Array, *, nearest: float = 0.05) -> Array:
        """τ (N, n) where each term moves e, of `size`, by its radius times `gain` and `seen`; not
        closer than `nearest` to where P⁻¹ - N is singular."""
        total = size + (gain * seen * self.radius).sum(axis=1, keepdims=True)
        tau = _share(total * gain, self.radius * seen)
        P, Q, _ = self._sums(tau)
        near = np.sqrt(np.abs(np.einsum("Nab,Nba->N", P, Q)))[:, None]
        return tau * np.where(near < np.inf, 1.0 / np.maximum(1.0 - near, nearest), 1.0)

    def _sums(self, tau: Array) -> tuple[Array, np.ndarray, Array | float]:
        """P, Q and Q_b (N, ·, ·)."""
        weight = tau * self.radius**2
        Q_b = 0.0 if self.inputs is None else _products(weight, self.inputs)
        return (
            _products(1.0 / tau, self.columns),
            _adjoint(self.rows) @ (weight[..., None] * self.rows),
            Q_b,
        )

    def _level(
        self, A: np.ndarray, B: np.ndarray, Z: np.ndarray, tau: Array
    ) -> tuple[Array, Array]:
        """γ (N,) with these τ, infinite where P⁻¹ is not above N; and better τ, those with which
        the worst f and w lie on the edges of all discs."""
        P, Q, Q_b = self._sums(tau)
        one, back = np.eye(P.shape[1]), _adjoint(B)
        P += (1e-13 * _trace(P) + 1e-250)[:, None, None] * one
        good = np.asarray(np.isfinite(P).all(axis=(1, 2)))
        L = np.linalg.cholesky(np.where(good[:, None, None], P, one))
        back_L = L.transpose(0, 2, 1)
        X, N = back_L @ (back @ A + Q @ Z), back @ B + Q
        left = one - back_L @ N @ L
        good &= np.isfinite(left).all(axis=(1, 2))
        values, V = np.linalg.eigh(np.where(good[:, None, None], left, one))
        lost = GUARD * (1.0 + _trace(P) * _trace(N))
        good &= values[:, 0] > 2.0 * lost
        values = np.where(good[:, None], values - lost[:, None], 1.0)
        Y = _adjoint(V) @ X
        square = _adjoint(A) @ A + _adjoint(Z) @ Q @ Z + Q_b + _adjoint(Y) @ (Y / values[..., None])
        good &= np.isfinite(square).all(axis=(1, 2))
        squares, F = np.linalg.eigh(np.where(good[:, None, None], square, np.eye(A.shape[2])))
        a, b, z, held = norm(A, True), norm(B, True), norm(Z, True), _trace(Q)
        lost = a * a + held * z * z + squares.sum(axis=1)
        lost += _trace(P) * (a * b + held * z) ** 2 / values[:, 0]
        value = np.where(good, np.sqrt(squares[:, -1] + 2.0 * GUARD * lost), np.inf)
        f = F[:, :, -1:]
        inner = V @ ((Y @ f) / values[..., None])  # u = -L times it
        w = np.abs(self.columns @ np.linalg.solve(back_L, inner))[..., 0] / tau
        seen = np.abs(self.rows @ (Z @ f + L @ inner))[..., 0]
        if self.inputs is not None:
            seen += np.abs(self.inputs @ f)[..., 0]
        return value, tau * _share(w, self.radius * seen)


@dataclass(frozen=True)
class Fraction:
    """N/D of V uncertain numbers δ_v, |δ_v| <= r_v, on boxes.

    N = N_c + Σ α_v δ_v and D = D_c + Σ β_v δ_v.

    Attributes
    ----------
    above, below : array (B,)
        N_c and D_c.
    of_above, of_below, radius : array (B, V)
        α, β and r.
    beside : array (B,)
        What bounds everything else in D, and in N at most as much.
    """

    above: np.ndarray
    below: np.ndarray
    of_above: np.ndarray
    of_below: np.ndarray
    radius: Array
    beside: Array

    def enclose(self) -> tuple[Array, Array, Array, np.ndarray]:
        """Enclose |N/D|.

            N/D - S = (N - S D)/D = Σ δ_v (α_v - S β_v)/D,   S = N_c/D_c
            |D| >= |D_c|(1 - R),   R = (Σ r_v |β_v| + ρ)/|D_c|,   ρ what is beside
            ||N/D| - |S|| <= (Σ r_v |α_v - S β_v| + ρ(1 + |S|))/(|D_c|(1 - R))   where R < 1

        Returns
        -------
        upper, lower : array (B,)
            |N/D| is at most and at least this.
        moved : array (B, V)
            By how much each δ_v moves it per radius, to first order.
        good : bool array (B,)
            Where R < 1: D has no zero; elsewhere nothing is known.
        """
        good = np.abs(self.below) > 0.0
        size = np.where(good, np.abs(self.below), 1.0)
        S = self.above / np.where(good, self.below, 1.0)
        R = ((self.radius * np.abs(self.of_below)).sum(axis=1) + self.beside) / size
        good &= R < 1.0
        left = np.where(good, 1.0 - R, 1.0)
        moved = np.abs(self.of_above - S[:, None] * self.of_below) / size[:, None]
        off = ((self.radius * moved).sum(axis=1) + self.beside * (1.0 + np.abs(S)) / size) / left
        upper, lower = np.abs(S) + off, np.maximum(np.abs(S) - off, 0.0)
        return np.where(good, upper, np.inf), np.where(good, lower, 0.0), moved, good


def norm(M: np.ndarray, loosely: bool = False) -> Array:
    """σ_max of matrices (..., p, q); `loosely` the root of the sum of squares, which it is where
    the rank is one and else not above."""
    if loosely or 1 in M.shape[-2:]:
        if M.shape[-2:] == (1, 1):
            return np.asarray(np.abs(M[..., 0, 0]))
        return np.asarray(np.sqrt((np.abs(M) ** 2).sum(axis=(-2, -1))))
    return sigma_max(M)


def _share(above: Array, below: Array, *, least: float = 1e-3) -> Array:
    """The quotient; a term counts as the share `least` of the largest at least."""
    parts = (part + least * part.max(axis=1, keepdims=True) + 1e-300 for part in (above, below))
    above, below = parts
    found = above / below
    return np.where(np.isfinite(found), np.clip(found, 1e-100, 1e100), 1.0)


def _products(weights: Array, rows: Array) -> Array:
    """Σ w_i r_i r_iᵀ (N, p, p) of w (N, n) and r (n, p)."""
    p = rows.shape[1]
    return (weights @ (rows[:, :, None] * rows[:, None]).reshape(-1, p * p)).reshape(-1, p, p)


def _adjoint(M: np.ndarray) -> np.ndarray:
    return np.asarray(M.conj().transpose(0, 2, 1))


def _trace(M: np.ndarray) -> Array:
    return np.asarray(np.trace(M, axis1=1, axis2=2).real)


def _lengths(M: np.ndarray, axis: int) -> Array:
    return np.asarray(np.linalg.norm(M, axis=axis))
