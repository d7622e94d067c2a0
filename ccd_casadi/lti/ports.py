"""Where a loop is broken, what follows a setpoint, where forces enter, where its error counts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.lti.state_space import ClosedLoop, StateSpace
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class BreakPoint:
    """A place where the loop of several sensors on one actuator is broken.

    Attributes
    ----------
    name : str
    output, reference : tuple of float (p,)
        uᵀe is what the channel of a sensor sees, r the reference that it alone sees; empty: at the
        actuator.
    """

    name: str
    output: tuple[float, ...] = ()
    reference: tuple[float, ...] = ()

    def open_loop(self, G: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The loop that is left, as a plant and a controller of one channel.

            L_i = G_i K_i/(1 + Σ_{j≠i} G_j K_j) at sensor i,   L = Σ_j G_j K_j at the actuator

        Parameters
        ----------
        G, K : array (k, p, 1), (k, 1, p)

        Returns
        -------
        tuple of array (k, 1, 1)
        """
        L = K @ G
        if not self.output:
            return L, np.ones_like(L)
        own, gain = np.array([self.output]) @ G, K @ np.array([self.reference]).T
        return own / (1.0 + L - own * gain), gain

    def close_loop(self, loop: ClosedLoop) -> ClosedLoop:
        """The closed loop, whose S is that of the loop broken here."""
        if not self.output:
            none = np.zeros((1, 1))
            return replace(loop, B_r=loop.B_d, C_y=-loop.C_u, D_u=none)
        row, column = np.array([self.output]), np.array([self.reference]).T
        return replace(loop, B_r=loop.B_r @ column, C_y=row @ loop.C_y, D_u=loop.D_u @ column)


@dataclass(frozen=True)
class Ports:
    """The ports of a plant: where forces d act, what z counts, and what a setpoint s requires of
    them.

        ẋ = A x + B u + E d,   y = C x,   z = F x = W U y + N x,   e = W s - z,   r = R s,   f = P x

    Attributes
    ----------
    drive, counted : array (n, q), (z, n)
        E and F, in the plant's states.
    rows, reference, wanted : array (s, p), (p, s), (z, s)
        U, R with U R = 1, and W.
    beyond : array (z, n) or None
        N: what the sensors do not see of z; None: nothing.
    force : array (m, n) or None
        P: the force that the machine gets of its actuators, N; None: u itself.
    """

    drive: Array
    counted: Array
    rows: Array
    reference: Array
    wanted: Array
    beyond: Array | None = None
    force: Array | None = None


def course(
    plant: StateSpace, axis: int = 0, places: Sequence[BreakPoint] = ()
) -> tuple[Array, Array]:
    """Find what follows a setpoint, uᵀy, and the reference r of every output per setpoint.

    One output has its own setpoint. Of several sensors on one actuator that follows it whose error
    counts, and all have what they read of a force that moves the plant slowly: r = G/(uᵀG).

    Parameters
    ----------
    plant : StateSpace
        G, continuous, SI.
    axis : int
        The output, from 0; of several sensors on one actuator it is given by the first place.
    places : sequence of BreakPoint

    Returns
    -------
    u, r : array (p,)
    """
    if not places:
        unit = np.eye(len(plant.C))[axis]
        return unit, unit
    output, G = np.array(places[0].output), moved_slowly(plant)[..., 0]
    return output, np.asarray((G / (G @ output)[:, None]).mean(axis=0))


def moved_slowly(plant: StateSpace, *, slow: float = 1e-5) -> Array:
    """G (2, p, m) at a real s, `slow` of the slowest pole but those of a free body, and at -s.

    Of ratios in it the mean has no term of first order, as of a sensor's lag.
    """
    rates = np.abs(plant.poles)
    moving = rates[rates > slow**2 * rates.max()]
    s = slow * moving.min(initial=rates.max())
    return np.asarray(plant.at(np.array([s, -s])).real)


def ports_of(
    plant: StateSpace, places: Sequence[BreakPoint] = (), drive: Array | None = None,
    counted: Array | None = None, force: Array | None = None,
) -> Ports:  # fmt: skip
    """Find the ports of a plant.

    Parameters
    ----------
    plant : StateSpace
        Continuous, SI.
    places : sequence of BreakPoint
        Of several sensors on one actuator.
    drive, counted : array (n, q), (z, n), optional
        E and F; left out, forces act at the actuators, and the outputs count, or of several sensors
        on one actuator the one of the first place. W is then what a slow force moves z by while it
        moves what follows the setpoint by one.
    force : array (m, n), optional
        P, where actuators make it of u.

    Returns
    -------
    Ports
    """
    rows = reference = np.eye(len(plant.C))
    if places:
        output, r = course(plant, 0, places)
        rows, reference = output[None], r[:, None]
    E = plant.B if drive is None else drive
    if counted is None:
        return Ports(E, rows @ plant.C, rows, reference, np.eye(len(rows)), None, force)
    read = np.vstack([rows @ plant.C, counted])
    G = moved_slowly(StateSpace(plant.A, plant.B, read, np.zeros((len(read), plant.B.shape[1]))))
    q = len(rows)
    wanted = (G[:, q:] @ np.linalg.pinv(G[:, :q])).mean(axis=0)
    return Ports(E, counted, rows, reference, wanted, counted - wanted @ read[:q], force)
