"""The truth that a surrogate stands in for: what a retraining job needs of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ccd_casadi.support.arrays import Array
from surrogates import GaussianProcess


@dataclass(frozen=True, eq=False)
class Observations:
    """X (n, d); Y (n, k), a row of NaN where the truth has no value; dY (n, k, d) or None."""

    X: Array
    Y: Array
    dY: Array | None = None

    @property
    def known(self) -> NDArray[np.bool_]:
        """(n,) whether the truth has a value there."""
        finite = np.isfinite(self.Y).all(axis=1)
        if self.dY is not None:
            finite &= np.isfinite(self.dY).all(axis=(1, 2))
        return np.asarray(finite)

    def rows(self, mask: NDArray[Any]) -> "Observations":
        """The rows that a mask (n,) or indices select."""
        return Observations(self.X[mask], self.Y[mask], None if self.dY is None else self.dY[mask])


class Truth(Protocol):
    """min objective(x, y) s.t. constraints(x, y) <= 0, lower <= x <= upper, y = truth(x).

    outputs (k). objective, constraints: casadi.Function of x (d) and y (k), the
    constraints (m, may be empty) scaled so that `tolerance`, relative, is a small violation.
    describe: what is kept with every surrogate. spent: evaluations that the run knows of,
    whoever made them, in the units of a budget.
    """

    outputs: tuple[str, ...]
    lower: Array
    upper: Array
    tolerance: float
    objective: ca.Function
    constraints: ca.Function
    describe: dict[str, Any]

    @property
    def spent(self) -> int: ...

    def samples(self) -> Observations:
        """All that is known inside the box, oldest first, failures among it."""

    def evaluate(self, X: Array) -> Observations:
        """The truth at X (m, d), in order; kept as it comes, and nothing computed twice."""

    def finish(
        self, x: Array | None, surrogates: Sequence[GaussianProcess], version: str | None
    ) -> str:
        """Verify the design x (None: there is none), write the results, and return the status.

        Called again with nothing changed it computes nothing.
        """
