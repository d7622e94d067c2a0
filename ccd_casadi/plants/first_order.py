"""A plant that its function gives in first order: ẋ = A(θ) x + B(θ) u, y = C(θ) x.

In `Mechanics` it has M = 0, D = 1 and K = -A. Its poles at 0 are parted from the others,

    T⁻¹ A T = diag(N, R),   N: q̇ = v, v̇ = 0 of free bodies, 0 of single integrators

so that they stay at exactly 0, as the free bodies of mechanics do. Off the model every complex pair
λ of R of a damping ratio below 0.3 moves alone, with a common shift s, its own s_i and a factor d
of the damping,

    λ' = (1 + s)(1 + s_i)(d Re λ + j Im λ),   residue' = residue/((1 + s)(1 + s_i)),

so that what a force accelerates stays as it is. All others stay: they are no resonances but coils
and lags, which ranges of parameters move.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from ccd_casadi.lti.state_space import (
    StateSpace,
    even_units,
    leading_term,
    state_scales,
    strictly_proper,
)
from ccd_casadi.lti.wiring import Slopes
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError


@dataclass(frozen=True)
class FirstOrderOptions:
    """Levels of rounding, all relative.

    Attributes
    ----------
    at_rest : float
        Singular value of A, in even scales, below which it is 0.
    on_axis : float
        |Re λ|/|λ| up to which a complex pair is undamped, and |Im λ|/|λ| up to which it is real.
    resonant : float
        Damping ratio below which a complex pair is a resonance.
    defective : float
        Condition of the eigenvectors, in even scales, beyond which A is not diagonalisable.
    """

    at_rest: float = 1e-13
    on_axis: float = 1e-10
    resonant: float = 0.3
    defective: float = 1e10


class FirstOrderModes(NamedTuple):
    """Poles in the words of mechanics: s² + damping s + stiffness, of a free body both 0."""

    stiffness: Array
    damping: Array
    drive: Array
    reading: Array
    rigid: np.ndarray
    resonances: np.ndarray


@dataclass(frozen=True)
class FirstOrderPlant:
    """The state space with its poles at 0 apart, SI.

    Attributes
    ----------
    system : StateSpace
        With the states (q, v, integrators, all others).
    slopes : Slopes
        ∂A, ∂B, ∂C to θ in the same states.
    bodies, integrators : int
        Numbers of q, and of single poles at 0.
    rates, V, W : arrays (r,), (r, r), (r, r)
        Poles of the others, eigenvectors, and their inverse.
    pairs : tuple of int
        Numbers in `rates` of complex pairs, each by its pole with Im λ > 0: resonances, then the
        others, the slowest first of both.
    resonances : int
        How many are.
    leading : int, array (p, m)
        n and C Aⁿ⁻¹ B, see `leading_term`, of A, B and C as given: the zeros in them are exact.
    """

    system: StateSpace
    slopes: Slopes
    bodies: int
    integrators: int
    rates: np.ndarray
    V: np.ndarray
    W: np.ndarray
    pairs: tuple[int, ...]
    resonances: int
    leading: tuple[int, Array]

    @property
    def at_rest(self) -> int:
        """The number of states of poles at 0."""
        return 2 * self.bodies + self.integrators

    @property
    def pushed(self) -> Array:
        """The displacements of the sensors by forces (p, m): a free body and an integrator as they
        go on, at rest what rests; of what goes away by itself first, C Aⁿ B."""
        A, B, C = self.system.A, self.system.B, self.system.C
        if not (self.rates.real < 0.0).all():
            return self.leading[1]
        n, r = self.bodies, self.at_rest
        if n:
            return C[:, :n] @ B[n : 2 * n]
        return C[:, :r] @ B[:r] if r else -C @ np.linalg.solve(A, B)

    def suspend(self, omega: float, damping_ratio: float) -> "FirstOrderPlant":
        """The same with free bodies held by springs of ω in rad/s, or integrators driven away with
        ω: a controller cannot cancel these. Raises PlantError where it has both, whose states at
        rest are not one alone."""
        n, r = self.bodies, self.at_rest
        if n and self.integrators:
            words = "mixed sensitivity cannot hold a free body and an integrator of one A"
            raise PlantError(f'{words}; use controller.structure = "sections"')
        held = np.zeros_like(self.system.A)
        q, v, single = np.arange(n), np.arange(n, 2 * n), np.arange(2 * n, r)
        held[v, q], held[v, v] = -(omega**2), -2.0 * damping_ratio * omega
        held[single, single] = omega
        (T, back), P, C = self._basis, self._turning(), self.system.C
        E, read = self.slopes.dA, C[:, r:] @ self.V @ P[:, r:, v]
        P[:, v[:, None], q], P[:, v[:, None], v] = -E[:, q[:, None], q], -E[:, q[:, None], v]
        P[:, q[:, None], v] = -np.linalg.pinv(C[:, q]) @ (self.slopes.dC[:, :, v] + read)
        dA = self.slopes.dA + (T @ (P @ held - held @ P) @ back).real
        system = replace(self.system, A=self.system.A + held)
        return replace(self, system=system, slopes=self.slopes._replace(dA=dA))

    @property
    def _basis(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvectors T of A but for the states at rest, and T⁻¹."""
        one = np.eye(self.at_rest)
        return scipy.linalg.block_diag(one, self.V), scipy.linalg.block_diag(one, self.W)

    def _turning(self) -> np.ndarray:
        """P of ∂T = T P, from diag(N, Λ) P - P diag(N, Λ) = -T⁻¹∂A T off the blocks that stay."""
        r, lam, (T, back) = self.at_rest, self.rates, self._basis
        N, E = self.system.A[:r, :r], back @ self.slopes.dA @ T
        gap, near = lam - lam[:, None], self._near
        P = np.zeros(E.shape, complex)
        P[:, r:, r:] = np.where(near, 0.0, E[:, r:, r:] / np.where(near, 1.0, gap))
        P[:, :r, r:] = (E[:, :r, r:] + N @ E[:, :r, r:] / lam) / lam
        P[:, r:, :r] = -(E[:, r:, :r] + E[:, r:, :r] @ N / lam[:, None]) / lam[:, None]
        return P

    @property
    def _near(self) -> np.ndarray:
        """Whether two poles (r, r) are one."""
        return np.abs(self.rates - self.rates[:, None]) <= 1e-9 * np.abs(self.rates)

    def scale_input(self, gain: Array) -> "FirstOrderPlant":
        """Multiply every column of B by its factor (m,)."""
        slopes = self.slopes._replace(dB=self.slopes.dB * gain)
        leading = self.leading[0], self.leading[1] * gain
        system = replace(self.system, B=self.system.B * gain)
        return replace(self, system=system, slopes=slopes, leading=leading)

    def off(
        self, shift: float, damping: float, single: Sequence[float], lost: float = 0.0
    ) -> "FirstOrderPlant":
        """Off the model, with the derivatives that it has there; see the head of the module.

        The pairs lose a damping of `lost` |Im λ|, with which a controller is synthesised.
        """
        if not shift and damping == 1.0 and not any(single) and not lost:
            return self
        lam, r = self.rates, self.at_rest
        ratio, decay, less = np.ones(len(lam)), np.ones(len(lam)), np.zeros(len(lam))
        resonant = self.pairs[: self.resonances]
        for i, own in zip(resonant, [*single, *[0.0] * len(resonant)], strict=False):
            both = self._both(i)
            ratio[both], decay[both] = (1.0 + shift) * (1.0 + own), damping
            less[both] = lost * np.sign(lam[both].imag)
        moved = ratio * (decay * lam.real + (less + 1j) * lam.imag)
        (T, back), P = self._basis, self._turning()
        after = scipy.linalg.block_diag(self.system.A[:r, :r], np.diag(moved))
        kept = np.append(np.ones(r), 1.0 / ratio)
        E = back @ self.slopes.dA @ T
        own = E[:, r:, r:]
        dA = P @ after - after @ P
        dA[:, :r, :r] = E[:, :r, :r]
        dA[:, r:, r:] += np.where(
            self._near, ratio * (decay * own.real + (less + 1j) * own.imag), 0.0
        )  # fmt: skip
        dB = (P * kept - kept[:, None] * P) @ back @ self.system.B
        dB = dB + kept[:, None] * (back @ self.slopes.dB)
        A, B = ((T @ part).real for part in (after @ back, kept[:, None] * (back @ self.system.B)))
        slopes = Slopes((T @ dA @ back).real, (T @ dB).real, self.slopes.dC)
        return replace(self, system=strictly_proper(A, B, self.system.C), slopes=slopes,
                       rates=moved)  # fmt: skip

    def _both(self, pair: int) -> np.ndarray:
        """The numbers of a pair's two poles."""
        return np.array([pair, np.abs(self.rates - self.rates[pair].conj()).argmin()])

    def to_point(self, name: str, value: float) -> tuple[Array, Array]:
        """∂A and ∂B to one of what `off` takes, by its name in a set, where it has a value."""
        word, _, number = name.partition(" ")
        moved = self.pairs[: self.resonances]
        moved = moved[int(number) - 1 : int(number)] if number else moved
        on = np.zeros(len(self.rates))
        for i in moved:
            on[self._both(i)] = 1.0
        r, dA, dB = self.at_rest, 0.0 * self.system.A, 0.0 * self.system.B
        if word == "damping":
            dA[r:, r:] = (self.V * (on * self.rates.real / value) @ self.W).real
            return dA, dB
        dA[r:, r:] = (self.V * (on * self.rates / (1.0 + value)) @ self.W).real
        dB[r:] = -(self.V * (on / (1.0 + value)) @ self.W @ self.system.B[r:]).real
        return dA, dB

    def modes(self, *, options: FirstOrderOptions = FirstOrderOptions()) -> FirstOrderModes:
        """Free bodies, complex pairs and real poles as modes; single integrators are none.

        A pair's residue is N₁ s + N₀, of which N₀ is taken; a real pole p is s² + 2|p| s + p²,
        an unstable one s² - p², with what it moves at rest. A mode is driven as much as measured.
        """
        n, r, lam = self.bodies, self.at_rest, self.rates
        B, C = self.W @ self.system.B[r:], self.system.C[:, r:] @ self.V
        turned = np.exp(-0.5j * np.angle((B**2).sum(axis=1)))  # in which a row of B is most real
        pairs = list(self.pairs)
        real = np.flatnonzero(lam.imag == 0.0)
        real = real[np.argsort(np.abs(lam[real]))]
        p, own = lam[real].real, lam[pairs]
        decay = np.where(np.abs(own.real) > options.on_axis * np.abs(own), -2.0 * own.real, 0.0)
        at_rest = -2.0 * (C[:, pairs] * (own.conj() / turned[pairs])).real
        sign = np.where(p < 0.0, -1.0, 1.0)
        drive = np.vstack([self.system.B[n : 2 * n], (turned[:, None] * B)[pairs].real,
                           np.abs(p)[:, None] * B[real].real])  # fmt: skip
        reading = np.hstack([self.system.C[:, :n], at_rest, C[:, real].real])
        sizes = np.linalg.norm(drive, axis=1), np.linalg.norm(reading, axis=0)
        seen = (sizes[0] > 0.0) & (sizes[1] > 0.0)
        even = np.sqrt(np.divide(sizes[0], sizes[1], out=np.ones(len(drive)), where=seen))
        return FirstOrderModes(
            np.concatenate([np.zeros(n), np.abs(own) ** 2, -sign * p**2]),
            np.concatenate([np.zeros(n), decay, np.where(p < 0.0, -2.0 * p, 0.0)]),
            drive / even[:, None],
            reading * even,
            np.arange(n + len(pairs) + len(real)) < n,
            n + np.arange(self.resonances),
        )  # fmt: skip


def first_order(
    A: Array, B: Array, C: Array, slopes: Slopes, *,
    options: FirstOrderOptions = FirstOrderOptions(),
) -> FirstOrderPlant:  # fmt: skip
    """Part the poles at 0 of a state space from the others.

    Parameters
    ----------
    A, B, C : arrays (n, n), (n, m), (p, n)
        SI.
    slopes : Slopes
        To θ.
    options : FirstOrderOptions

    Returns
    -------
    FirstOrderPlant

    Raises
    ------
    PlantError
        A has three integrators in a row, is not diagonalisable beside its poles at 0, or has a free
        body or an integrator that is not driven or not measured.
    """
    leading = leading_term(A, B, C)
    t, u, y, rate = even_units(A, B, C)
    A, B, C, *moved = (
        part
        for a, b, c in ((A, B, C), slopes)
        for part in (a * t / t[:, None] / rate, b * u / t[:, None] / rate, c * t / y[:, None])
    )
    slopes = Slopes(*moved)
    T, back, kept, n, k = _at_rest(A, C, options)
    r = 2 * n + k
    _require_seen(back[n:r] @ B, C @ np.delete(T[:, :r], np.s_[n : 2 * n], axis=1), B, C)
    A, N = np.hstack([T[:, :r], back @ A[:, kept]]), np.zeros((r, r))
    N[np.arange(n), np.arange(n, 2 * n)] = 1.0
    A[:r], A[:, :r], B, C = 0.0, 0.0, back @ B, C @ T
    A[:r, :r] = N
    s = state_scales(A, B, C)
    s[:r] = 1.0
    s[n : 2 * n] = 1.0 / rate
    A, B, C = A * s / s[:, None], B / s[:, None], C * s
    T, back = T * s, back / s[:, None]
    lam, V = np.linalg.eig(A[r:, r:])
    size = np.abs(lam)
    if len(lam) and not np.linalg.cond(V) < options.defective:
        words = "A is not diagonalisable: poles coincide and are coupled"
        raise PlantError(
            f"{words}; move one of them a little, such as a damping ratio of exactly 1"
        )
    lam = np.where(np.abs(lam.imag) <= options.on_axis * size, lam.real, lam)
    upper = np.flatnonzero(lam.imag > 0.0)
    light = np.abs(lam[upper].real) < options.resonant * size[upper]
    order = np.lexsort((size[upper], ~light))
    slopes = Slopes(
        rate * back @ slopes.dA @ T, rate * back @ slopes.dB / u, y[:, None] * slopes.dC @ T
    )  # fmt: skip
    return FirstOrderPlant(
        strictly_proper(rate * A, rate * B / u, y[:, None] * C), slopes, n, k, rate * lam, V,
        np.linalg.inv(V) if len(lam) else V,
        tuple(upper[order].tolist()), int(light.sum()), leading,
    )  # fmt: skip


def _at_rest(
    A: Array, C: Array, options: FirstOrderOptions
) -> tuple[Array, Array, np.ndarray, int, int]:
    """T and T⁻¹ with the states (q, v, integrators, others), which states the others are, and how
    many q and integrators.

    v null on the left and q null on the right where the one does not see the other are a body:
    A u = q for its velocity u. Where they see each other it is an integrator. The others stay as
    given, but for their part in these, and all is solved by elimination: zeros stay zeros.
    """
    n = len(A)
    size = np.linalg.svd(A, compute_uv=False)
    count = int((size <= options.at_rest * n * size.max(initial=0.0)).sum())
    if not count:
        return np.eye(n), np.eye(n), np.arange(n), 0, 0
    right, left = _null(A, count), _null(A.T, count).T
    P, seen, Qt = np.linalg.svd(left @ right)
    if not (seen > 1e-9).any() or (seen > 1e-9).all():
        P, Qt = np.eye(count), np.eye(count)
    bodies, single = np.flatnonzero(seen <= 1e-9), np.flatnonzero(seen > 1e-9)
    q, v = right @ Qt[bodies].T, P[:, bodies].T @ left
    whole = np.block([[A, left.T], [right.T, np.zeros((count, count))]])
    rates = np.linalg.solve(whole, np.vstack([q, 0.0 * right.T @ q]))[:n]
    places = np.linalg.solve(whole.T, np.vstack([v.T, 0.0 * left @ v.T]))[:n].T
    rates -= q @ (np.linalg.pinv(C @ q) @ (C @ rates))  # sensors see positions, no velocities
    columns = np.hstack([q, rates, right @ Qt[single].T])
    rows = np.vstack([places, v, P[:, single].T @ left])
    pairing = rows @ columns
    if np.linalg.cond(pairing) > 1e9:
        words = (
            "A has three integrators in a row, or poles so near 0 that they cannot be distinguished"
        )
        raise PlantError(f"{words}; give all others a rate, or use mass, damping and stiffness")
    rows = np.linalg.solve(pairing, rows)
    given, kept = _choose(columns.T)
    T = np.hstack([columns, np.eye(n)[:, kept] - columns @ rows[:, kept]])
    parted = np.eye(n)[kept] - columns[kept] @ np.linalg.solve(columns[given], np.eye(n)[given])
    return T, np.vstack([rows, parted]), kept, len(bodies), len(single)


def _choose(rows: Array) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of columns in which rows (r, n) are best known, and of the others."""
    order = scipy.linalg.qr(rows, mode="r", pivoting=True)[1]
    return order[: len(rows)], np.sort(order[len(rows) :])


def _null(A: Array, count: int) -> Array:
    """x (n, count) of A x = 0: some of its entries are chosen, the others are solved for."""
    n = len(A)
    free = np.sort(scipy.linalg.qr(A, mode="r", pivoting=True)[1][n - count :])
    bound, rows = np.delete(np.arange(n), free), np.sort(_choose(np.delete(A, free, axis=1).T)[0])
    x = np.zeros((n, count))
    x[free] = np.eye(count)
    x[bound] = -np.linalg.solve(A[np.ix_(rows, bound)], A[np.ix_(rows, free)])
    return x / np.linalg.norm(x, axis=0)


def _require_seen(
    drive: Array, reading: Array, B: Array, C: Array, *, hidden: float = 1e-9
) -> None:
    """Raise PlantError unless all that A leaves at rest is driven and measured apart."""
    words = "a pole at 0 of A is not {}: no controller holds it; {}, or leave its states out of A"
    for gains, whole, what, remedy in (
        (drive, B, "driven", "add an input that moves it"),
        (reading, C, "measured", "add an output that sees it"),
    ):
        if np.linalg.matrix_rank(gains, hidden * np.abs(whole).max()) < len(drive):
            raise PlantError(words.format(what, remedy))
