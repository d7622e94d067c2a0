"""A system as a state space, continuous or in discrete time, with its response, poles and zeros.

The judge `fixed_structure.certificate` and the compiled kernels form loops of their own, and
`deployment.move` runs them sample by sample: it stays independent of this.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import eig, matrix_balance

from ccd_casadi.support.arrays import Array

SOUND = 1e8  # condition of eigenvectors up to which they give a response
GONE = 1e-6  # a pole z of a delay: it is gone after a sample, and has no frequency
REACH = 1e5  # size of the zeros, over the unit given, from which on they count as infinite


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

    def swept(self, omega: Array) -> np.ndarray:
        """`response` at many frequencies: by eigenvectors where these are sound (cond < 1e8)."""
        if self.modes is None:
            return self.response(omega)
        poles, drive, reading = self.modes
        parts = reading / (self.variable(omega)[:, None] - poles)[:, None, :]
        return np.asarray(parts @ drive + self.D)

    def variable(self, omega: Array) -> np.ndarray:
        """s or z (k,) at ω (k,) in rad/s."""
        s = 1j * np.asarray(omega, float)
        return s if not self.period else np.exp(s * self.period)

    @property
    def poles(self) -> np.ndarray:
        """Eigenvalues of A."""
        return np.linalg.eigvals(self.A)

    @property
    def rates(self) -> np.ndarray:
        """Poles in 1/s: ln(z)/T of a system in discrete time, those of a delay left out."""
        return self.rates_of(self.poles)

    def rates_of(self, roots: np.ndarray) -> np.ndarray:
        """Poles or zeros of this system in 1/s."""
        if not self.period:
            return roots
        return np.log(roots[np.abs(roots) > GONE].astype(complex)) / self.period

    @property
    def stable(self) -> bool:
        """Whether every pole lies in the open left half plane, or inside the unit circle."""
        if not self.period:
            return bool(self.poles.real.max(initial=-np.inf) < 0.0)
        return bool(np.abs(self.poles).max(initial=0.0) < 1.0)

    @cached_property
    def modes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Poles (n,), V⁻¹B (n, m) and CV (p, n) with eigenvectors V; None where these are not
        sound."""
        poles, V = np.linalg.eig(self.A)
        if len(V) and not np.linalg.cond(V) < SOUND:
            return None
        return poles, np.linalg.solve(V, self.B + 0j), self.C @ V

    def zeros(self, unit: float = 1.0) -> np.ndarray:
        """Finite invariant zeros of a square system, |z| < 1e5 `unit`; none of another.

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
        return np.asarray(values[np.isfinite(values) & (np.abs(values) < REACH)] * unit)

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
    """The system with D = 0."""
    return StateSpace(A, B, C, np.zeros((len(C), B.shape[1])), period=period)


def balanced(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array]:
    """T⁻¹AT, T⁻¹B, CT with a diagonal T of powers of two that evens out the states' scales.

    Inputs and outputs keep their units: balancing leaves alone what has an empty row or column.
    """
    n, m, p = len(A), B.shape[1], C.shape[0]
    system = np.zeros((n + m + p, n + m + p))
    system[:n, :n], system[:n, n : n + m], system[n + m :, :n] = A, B, C
    with np.errstate(invalid="ignore"):  # scales beyond 64 bits, as integers that nobody reads
        even, _ = matrix_balance(system, permute=False)
    parts = (even[:n, :n], even[:n, n : n + m], even[n + m :, :n])
    A, B, C = (np.ascontiguousarray(part) for part in parts)
    return A, B, C


def weighted(system: StateSpace, filters: Array) -> StateSpace:
    """Each output of a continuous system behind its own filter of one state, rows of pole,
    feedthrough and zero: feedthrough times (s + zero)/(s + pole)."""
    pole, through, zero = filters.T
    A, B, C, D = system.A, system.B, system.C, system.D
    return StateSpace(
        np.block([[A, np.zeros((len(A), len(C)))], [C, -np.diag(pole)]]),
        np.vstack([B, D]),
        np.hstack([through[:, None] * C, np.diag(through * (zero - pole))]),
        through[:, None] * D,
    )
