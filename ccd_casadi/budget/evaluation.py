"""The error budget of a closed loop: RMS, MA and MSD of the error and RMS of the force by source.

Filters by Lyapunov's equation, tables by quadrature; the density over frequency of both. Where a
filter's densities are integrated too, the two have to agree: `disagreement`.
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.budget.derivatives import of_source
from ccd_casadi.budget.frequency import integrated
from ccd_casadi.budget.moving_average import average_gain
from ccd_casadi.budget.sources import ErrorBudget, Source
from ccd_casadi.lti.loop import Loop
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


@dataclass(frozen=True)
class SourceFigures:
    """One source: RMS error, MA, MSD (m; NaN without a window) and RMS force (N).

    `disagreement` (relative) is between Lyapunov's equation and the integral over frequency, or
    for a table the error estimate of the quadrature. `hz` and `cumulative` (m²): the variance of
    the error up to each frequency. Infinite where white noise passes undamped.
    """

    source: Source
    error: float
    average: float
    deviation: float
    force: float
    disagreement: float
    hz: Array
    cumulative: Array


@dataclass(frozen=True)
class BudgetFigures:
    """All sources and their root sum of squares: error, MA and MSD in m, force in N."""

    sources: tuple[SourceFigures, ...]
    error: float
    average: float
    deviation: float
    force: float
    window: float | None

    @property
    def disagreement(self) -> float:
        """The largest of any source."""
        return max(item.disagreement for item in self.sources)


def evaluate_budget(loop: Loop, budget: ErrorBudget) -> BudgetFigures | None:
    """The budget of a loop in SI, plant without feedthrough.

    With several channels errors and forces are those of the vectors. None for a loop that is not
    stable, which has no stationary error. Raises UserError for a plant with a feedthrough.

    >>> import numpy as np
    >>> from ccd_casadi.budget import ErrorBudget, Kind, ShapedSpectrum, Source
    >>> from ccd_casadi.lti.state_space import StateSpace
    >>> mass = StateSpace(np.array([[0.0, 1.0], [-1.0, -2.0]]), np.eye(2, 1, -1), np.eye(1, 2),
    ...                   np.zeros((1, 1)))
    >>> none = StateSpace(*(np.zeros((i, j)) for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))))
    >>> white = ErrorBudget((Source("cable", Kind.FORCE, ShapedSpectrum(1.0)),))
    >>> loop = Loop(mass, none)
    >>> round(evaluate_budget(loop, white).error ** 2, 12)  # 1/2 over 2 d k, d = 2, k = 1
    0.125
    """
    if np.any(loop.plant.D):
        raise UserError("the plant of an error budget has no feedthrough")
    if not loop.stable:
        return None
    found = tuple(_figures(loop, source, budget.window) for source in budget.sources)

    def total(name: str) -> float:
        return float(np.sqrt(sum(getattr(item, name) ** 2 for item in found)))

    return BudgetFigures(
        found, total("error"), total("average"), total("deviation"), total("force"), budget.window
    )


def _figures(loop: Loop, source: Source, window: float | None) -> SourceFigures:

    def weight(hz: Array) -> Array:
        return np.ones_like(hz) if window is None else average_gain(hz, window, loop.period)

    whole = integrated(loop, source, weight)
    if source.shaped:
        error, average, force = map(float, of_source(loop, source, window))
        ratio = whole.value[0] / error if error > 0.0 else 1.0
        disagreement = abs(float(ratio) - 1.0)
    else:
        error, force, average = map(float, whole.value)
        average = np.nan if window is None else average
        disagreement = float((whole.error / np.maximum(whole.value, 1e-300)).max())
    return SourceFigures(
        source, np.sqrt(error), np.sqrt(max(average, 0.0)), np.sqrt(max(error - average, 0.0)),
        np.sqrt(force), disagreement,
        whole.ends, whole.cumulative()[0],
    )  # fmt: skip
