"""One closed loop of a plant and a controller, continuous or sampled with hold and delay.

    e = r - y,   u = K e,   y = G (u + d)

Sampled with period T the plant is held and delayed exactly, K runs by Tustin's rule:
K(z) = K(s) at s = (2/T)(z - 1)/(z + 1), which on the axis is s = (2j/T) tan(ωT/2).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ccd_casadi.lti.closed_loop import ClosedLoop, closed_loop, sensitivity, sigma_max
from ccd_casadi.lti.grid import frequency_grid, root_flanks, zoomed
from ccd_casadi.lti.hold import Sampling, sampled, transfer, tustin
from ccd_casadi.lti.state_space import StateSpace, strictly_proper
from ccd_casadi.support.arrays import Array

PER_DECADE = 60
APART = 1e-7  # relative: closer points of the grid differ in gain by rounding alone
NEAR = 0.9  # of the largest gain on the grid: local maxima below it lie below it between points too


@dataclass(frozen=True)
class Loop:
    """The plant G and the controller K in SI, both continuous; `sampling` None: so is the loop.

    G has no feedthrough. A controller in discrete time runs as it is, at the rate of `sampling`.
    """

    plant: StateSpace
    controller: StateSpace
    sampling: Sampling | None = None

    def responses(self, omega: Array) -> tuple[np.ndarray, np.ndarray]:
        """G (k, p, m), hold and delay in it, and K (k, m, p) as they run, at ω (k,) in rad/s."""
        G, K = self.as_run
        if self.sampling is None or self.plant.modes is None:
            return G.swept(omega), K.swept(omega)
        poles, drive, reading = self.plant.modes
        f = transfer(poles, omega, self.sampling.period, self.sampling.delay)
        return np.asarray((reading * f[:, None, :]) @ drive), K.swept(omega)

    def sensitivity(self, omega: Array) -> np.ndarray:
        """S = (I + GK)⁻¹ (k, p, p)."""
        G, K = self.responses(omega)
        return sensitivity(G @ K)

    @cached_property
    def closed(self) -> ClosedLoop:
        """The closed loop, sampled at its instants; a disturbing force is held, and not delayed."""
        found = closed_loop(*self.as_run)
        if self.sampling is None:
            return found
        force = np.zeros((len(found.A), self.plant.B.shape[1]))
        force[: len(self.plant.A)] = sampled(self.plant, self.sampling.period, 0.0).B
        return replace(found, B_d=force)

    @property
    def period(self) -> float | None:
        """T in s of a sampled loop."""
        return None if self.sampling is None else self.sampling.period

    @property
    def stable(self) -> bool:
        """Whether every pole of the loop is."""
        return self.closed.S.stable

    def over_a_step(self, longest: float) -> ClosedLoop:
        """The closed loop over a sampling period, or over `longest` s where it is continuous."""
        return self.closed if self.sampling is not None else at_instants(self.closed, longest)

    @property
    def poles(self) -> np.ndarray:
        """Closed-loop poles in rad/s; of a sampled loop ln(z)/T, those of a delay left out."""
        return self.closed.S.rates

    def grid(self) -> Array:
        """ω in rad/s from far below the slowest pole to far above the fastest, ascending.

        It runs through every pole of plant, controller and loop, and their flanks.
        """
        roots = np.concatenate([self.poles, self.plant.rates, self.controller.rates])
        roots = roots[np.abs(roots) > 1e-9 * np.abs(roots).max()]
        low, high = 0.1 * np.abs(roots).min(), 10.0 * np.abs(roots).max()
        if self.sampling is not None:
            high = np.pi / self.sampling.period
        count = int(PER_DECADE * np.log10(high / low)) + 1
        return frequency_grid(low, high, count, root_flanks(roots), apart=APART)

    @cached_property
    def peak(self) -> float:
        """‖S‖∞ of a stable loop: every local maximum on the grid near the largest closed in on."""

        def gain(omega: Array) -> Array:
            return sigma_max(self.sensitivity(omega.ravel())).reshape(omega.shape)

        grid = self.grid()
        S = gain(grid)
        at = np.flatnonzero((S[1:-1] >= S[:-2]) & (S[1:-1] >= S[2:])) + 1
        at = at[S[at] > NEAR * S.max()]
        return float(max(S.max(), *zoomed(gain, grid[at - 1], grid[at + 1])[1]))

    @cached_property
    def as_run(self) -> tuple[StateSpace, StateSpace]:
        """Plant and controller of the loop, in discrete time where it is sampled."""
        if self.sampling is None:
            return self.plant, self.controller
        T, K = self.sampling.period, self.controller
        K = K if K.period else tustin(K, T)
        K = K if K.period == T else replace(K, period=T)
        return sampled(self.plant, T, self.sampling.delay), K


def at_instants(loop: ClosedLoop, period: float) -> ClosedLoop:
    """A continuous loop at instants `period` s apart, r and d constant in between; exact."""
    both = np.hstack([loop.B_r, loop.B_d])
    held = sampled(strictly_proper(loop.A, both, loop.C_y), period, 0.0)
    count = loop.B_r.shape[1]
    return replace(loop, A=held.A, B_r=held.B[:, :count], B_d=held.B[:, count:], period=period)


def constant_drive(loop: ClosedLoop, drive: Array, count: int) -> Array:
    """y (p, count) at the instants, from rest under the constant input B_r r or B_d d (n,).

    By doubling: the states of 2n instants are those of n, and Aⁿ times them.
    """
    n = len(loop.A)
    P = np.eye(n + 1)
    P[:n, :n], P[:n, n] = loop.A, drive
    x = np.eye(n + 1)[:, n:]
    while x.shape[1] < count:
        x = np.hstack([x, P @ x])
        P = P @ P
    return np.asarray(loop.C_y @ x[:n, :count])
