"""One closed loop of a plant and a controller, continuous or sampled with hold and delay.

    e = r - y,   u = K e,   y = G (u + d)

Sampled with period T the plant is held and delayed exactly, K runs by Tustin's rule:
K(z) = K(s) at s = (2/T)(z - 1)/(z + 1), which on the axis is s = (2j/T) tan(ωT/2).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import eig, expm

from ccd_casadi.fixed_structure.hold_and_delay import Sampling, sampled, transfer
from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.arrays import Array

SOUND = 1e8  # condition of eigenvectors up to which they give a response
FLANKS = np.array([-3.0, -1.0, -0.4, 0.0, 0.4, 1.0, 3.0])  # in half widths of a root
PER_DECADE = 60
GONE = 1e-6  # a pole z of a delay: it is gone after a sample, and has no frequency


@dataclass(frozen=True)
class Steps:
    """x⁺ = A x + B_r r + B_d d, y = C x of the closed loop over one step of `period` s."""

    A: Array
    B_r: Array
    B_d: Array
    C: Array
    period: float

    def outputs(self, drive: Array, count: int) -> Array:
        """y (p, count) from rest under the constant input B_r r or B_d d (n,), by doubling."""
        n = len(self.A)
        P = np.eye(n + 1)
        P[:n, :n], P[:n, n] = self.A, drive
        x = np.eye(n + 1)[:, n:]
        while x.shape[1] < count:
            x = np.hstack([x, P @ x])
            P = P @ P
        return np.asarray(self.C @ x[:n, :count])


@dataclass(frozen=True)
class Loop:
    """The plant G and the controller K in SI, both continuous; `sampling` None: so is the loop.

    G has no feedthrough.
    """

    plant: StateSpace
    controller: StateSpace
    sampling: Sampling | None = None

    def plant_response(self, omega: Array) -> np.ndarray:
        """G (k, p, m) at ω (k,) in rad/s, hold and delay in it."""
        if not np.linalg.cond(self._plant_modes[2]) < SOUND:
            return self._plant_by_solves(omega)
        period = None if self.sampling is None else self.sampling.period
        delay = 0.0 if self.sampling is None else self.sampling.delay
        poles, drive, V = self._plant_modes
        f, _ = transfer(poles, omega, period, delay)
        return np.asarray((self.plant.C @ V * f[:, None, :]) @ drive)

    def _plant_by_solves(self, omega: Array) -> np.ndarray:
        A, B, C = self.plant.A, self.plant.B, self.plant.C
        s = 1j * omega
        if self.sampling is not None:
            A, B, C = sampled(A, B, C, self.sampling.period, self.sampling.delay)
            s = np.exp(s * self.sampling.period)
        return np.asarray(C @ np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B + 0j))

    def controller_response(self, omega: Array) -> np.ndarray:
        """K (k, m, p) at ω (k,) in rad/s."""
        s = 1j * omega
        if self.sampling is not None:
            T = self.sampling.period
            s = 2j / T * np.tan(0.5 * T * omega)
        K, modes = self.controller, self._controller_modes
        if modes is None:
            shape = s[:, None, None] * np.eye(len(K.A)) - K.A
            return np.asarray(K.C @ np.linalg.solve(shape, K.B + 0j) + K.D)
        poles, drive, reading = modes
        return np.asarray((reading / (s[:, None] - poles)[:, None, :]) @ drive + K.D)

    def sensitivity(self, omega: Array) -> np.ndarray:
        """S = (I + GK)⁻¹ (k, p, p)."""
        L = self.plant_response(omega) @ self.controller_response(omega)
        return np.linalg.inv(np.eye(L.shape[1]) + L)

    def open_at_input(self, number: int, omega: Array) -> np.ndarray:
        """L (k,) of the loop that is cut at one input of the plant, the others closed."""
        L = self.controller_response(omega) @ self.plant_response(omega)
        if L.shape[1] == 1:
            return np.asarray(L[:, 0, 0])
        S = np.linalg.inv(np.eye(L.shape[1]) + L)
        return np.asarray(1.0 / S[:, number, number] - 1.0)

    def over_a_step(self, longest: float) -> Steps:
        """The closed loop over a sampling period, or over `longest` s where it is continuous."""
        G, K = self.plant, self.controller
        n, q = len(G.A), len(K.A)
        if self.sampling is None:
            both = np.block([[G.B @ K.D, G.B], [K.B, np.zeros((q, G.B.shape[1]))]])
            A, both = _held(self._closed(), both, longest)
            p = len(G.C)
            return Steps(A, both[:, :p], both[:, p:], np.hstack([G.C, np.zeros((p, q))]), longest)
        T = self.sampling.period
        Ad, Bd, Cd = sampled(G.A, G.B, G.C, T, self.sampling.delay)
        k = tustin(K, T)
        A = np.block([[Ad - Bd @ k.D @ Cd, Bd @ k.C], [-k.B @ Cd, k.A]])
        force = np.zeros((len(A), G.B.shape[1]))
        force[:n] = _held(G.A, G.B, T)[1]  # a disturbance is not delayed
        C = np.hstack([Cd, np.zeros((len(Cd), q))])
        return Steps(A, np.vstack([Bd @ k.D, k.B]), force, C, T)

    def poles(self) -> np.ndarray:
        """Closed-loop poles in rad/s; of a sampled loop ln(z)/T, those of a delay left out."""
        if self.sampling is None:
            return np.linalg.eigvals(self._closed())
        z = np.linalg.eigvals(self.over_a_step(self.sampling.period).A).astype(complex)
        return np.log(z[np.abs(z) > GONE]) / self.sampling.period

    def _closed(self) -> Array:
        G, K = self.plant, self.controller
        return np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])

    def grid(self) -> Array:
        """ω in rad/s from far below the slowest pole to far above the fastest, ascending.

        It runs through every pole of plant, controller and loop, and their flanks.
        """
        parts = [self.poles(), self._plant_modes[0], np.linalg.eigvals(self.controller.A)]
        roots = np.concatenate(parts)
        roots = roots[np.abs(roots) > 1e-9 * np.abs(roots).max()]
        low, high = 0.1 * np.abs(roots).min(), 10.0 * np.abs(roots).max()
        if self.sampling is not None:
            high = np.pi / self.sampling.period
        count = int(PER_DECADE * np.log10(high / low)) + 1
        near = np.abs(roots.imag)[:, None] + np.abs(roots.real)[:, None] * FLANKS
        grid = np.unique(np.concatenate([np.geomspace(low, high, count), near.ravel()]))
        return np.asarray(grid[(grid >= low) & (grid <= high)])

    @cached_property
    def _plant_modes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        poles, V = np.linalg.eig(self.plant.A)
        return poles, np.linalg.solve(V, self.plant.B + 0j), V

    @cached_property
    def _controller_modes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        poles, V = np.linalg.eig(self.controller.A)
        if not np.linalg.cond(V) < SOUND:
            return None
        return poles, np.linalg.solve(V, self.controller.B + 0j), self.controller.C @ V


def tustin(K: StateSpace, period: float) -> StateSpace:
    """K(z) with s = (2/T)(z - 1)/(z + 1)."""
    one, half = np.eye(len(K.A)), 0.5 * period
    inverse = np.linalg.inv(one - half * K.A)
    C = K.C @ inverse
    return StateSpace(inverse @ (one + half * K.A), period * inverse @ K.B, C, K.D + half * C @ K.B)


def zeros(K: StateSpace, unit: float) -> np.ndarray:
    """Finite zeros in rad/s of a square system, |z| up to 1e4 `unit`."""
    n, m = K.B.shape
    if len(K.C) != m or n == 0:
        return np.empty(0, complex)
    scale = max(float(np.abs(K.D).max()), float(np.abs(K.C).max()), 1e-300)
    system = np.block([[K.A / unit, K.B], [K.C / scale, K.D / scale]])
    weight = np.zeros_like(system)
    weight[:n, :n] = np.eye(n)
    values = eig(system, weight, right=False)
    return np.asarray(values[np.isfinite(values) & (np.abs(values) < 1e4)] * unit)


def _held(A: Array, B: Array, T: float) -> tuple[Array, Array]:
    n, m = B.shape
    joint = np.zeros((n + m, n + m))
    joint[:n, :n], joint[:n, n:] = A, B
    whole = expm(T * joint)
    return whole[:n, :n], whole[:n, n:]
