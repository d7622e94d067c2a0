"""Where the loop of several sensors on one actuator is broken, and what is left there."""

from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.lti.state_space import ClosedLoop


@dataclass(frozen=True)
class BreakPoint:
    """Where the loop of several sensors on one actuator is broken.

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

    def opened(self, G: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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

    def closed(self, loop: ClosedLoop) -> ClosedLoop:
        """The closed loop, whose S is that of the loop broken here."""
        if not self.output:
            none = np.zeros((1, 1))
            return replace(loop, B_r=loop.B_d, C_y=-loop.C_u, D_u=none)
        row, column = np.array([self.output]), np.array([self.reference]).T
        return replace(loop, B_r=loop.B_r @ column, C_y=row @ loop.C_y, D_u=loop.D_u @ column)
