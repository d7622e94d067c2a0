"""Matrices of a slow plant while one drags: a model made of the θ that were solved so far.

It is true at these θ and nearly so beside them (`plants.plant.near`). Where a slider is let go the
model of the plant itself is solved, which tells how far off the other was there.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import eigh

from ccd_casadi.explorer.designs import Elements
from ccd_casadi.plants.plant import Evaluate, Mechanics, Plant, nearby_model

MOST = 6  # θ that the model is made of: more make it slower than a drag
FLEXIBLE = 1e-6  # of the largest eigenvalue: what is below is a rigid motion's, rounded

Theta = tuple[float, ...]


@dataclass
class KnownPlant:
    """Exact matrices by θ in the order of their solution, and the model made of the newest ones.

    `checked`: share of the box from the nearest θ known, and relative error of a frequency, where
    the model was last compared with the plant itself.
    """

    plant: Plant
    lower: Theta
    upper: Theta
    exact: dict[Theta, Mechanics] = field(default_factory=dict)
    model: Evaluate | None = None
    used: tuple[Theta, ...] = ()
    checked: tuple[float, float] = (0.0, np.inf)

    def learn(self, theta: Theta, system: Mechanics) -> float | None:
        """Take the plant's own matrices at θ; how far off the model was, if there was one."""
        off = None
        if theta not in self.exact and self.model is not None:
            off = frequency_error(self.model(theta), system)
            self.checked = (self._nearest(theta), off)
        self.exact[theta] = system
        return off

    def renew(self) -> None:
        """Make the model of the θ known nearest to the newest: seconds, for a thread of its own."""
        known = list(self.exact)
        most = 1 if self.plant.nearby is None else MOST  # to first order: of the newest alone
        close = sorted(known, key=lambda theta: self.distance(theta, known[-1]))[:most]
        used = tuple(theta for theta in known if theta in close)  # a basis grows in one order
        self.model, self.used = nearby_model(self.plant, used, known[-1]), used

    def at(self, theta: Theta) -> Elements:
        """What there is at θ without solving the plant.

        The error is the one last measured, infinite farther away than that or before any.
        """
        if theta in self.exact:
            return Elements(self.exact[theta])
        if self.model is None:
            nearest = min(self.exact, key=lambda other: self.distance(theta, other))
            share = 100.0 * self.distance(theta, nearest)
            words = f"those of the nearest solved θ, {share:.2g} % of the box away"
            return Elements(self.exact[nearest], np.inf, words)
        away, (reached, off) = self._nearest(theta), self.checked
        words = (
            f"a model made of {len(self.used)} solved θ, the nearest {100.0 * away:.2g} % of the "
            "box away"
        )
        if np.isfinite(off):
            words += f"; {100.0 * reached:.2g} % away it was off by {100.0 * off:.2g} %"
        return Elements(self.model(theta), off if away <= reached else np.inf, words)

    def _nearest(self, theta: Theta) -> float:
        return min(self.distance(theta, other) for other in self.used)

    def distance(self, one: Theta, other: Theta) -> float:
        """Largest difference as a share of the box."""
        width = np.array(self.upper) - np.array(self.lower)
        return float(np.abs((np.array(one) - np.array(other)) / width).max())


def frequency_error(one: Mechanics, exact: Mechanics) -> float:
    """Largest relative difference of the flexible frequencies of two plants."""
    a, b = (eigh(system.K, system.M, eigvals_only=True) for system in (one, exact))
    flexible = b > FLEXIBLE * b.max()
    return float(np.abs(np.sqrt(np.maximum(a, 0.0)[flexible] / b[flexible]) - 1.0).max())
