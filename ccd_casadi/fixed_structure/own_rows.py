"""Rows of the loop's matrices that single channels keep within bounds of their own.

    uᵀS, wᵀKS      1 x p,   u and w of `ChannelBounds`

The only singular value of each is its length. Among a plant's rows they come after the singular
values of the whole: that of channel i has the number p + i (see `mimo_figures`).
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.loop_problem import Curve
from ccd_casadi.fixed_structure.mimo_loop import MatrixPlantSet
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class OwnRows:
    """The first `first` numbers are singular values of the whole, the others channels.

    By number: `ln_S_max`, `ln_level` of KS with the weights' M_K (NaN: no such bound), and `lead`,
    ln of ω_i/ω_b. By channel: `error` uᵀ (c, p) and `force` wᵀ (c, m) in the plants' coordinates.
    """

    first: int
    ln_S_max: Array
    ln_level: Array
    lead: Array
    error: Array
    force: Array

    @property
    def count(self) -> int:
        """How many channels."""
        return len(self.error)

    def bounded(self, curve: Curve) -> np.ndarray:
        """The channels with a bound of their own on a curve."""
        given = {
            Curve.S_MAX: ~np.isnan(self.ln_S_max),
            Curve.LEVEL: self.lead > 0.0,
            Curve.SHAPE: self.lead > 0.0,
            Curve.CROSSING: self.lead > 0.0,
            Curve.KS: ~np.isnan(self.ln_level),
        }
        if curve not in given:
            return np.zeros(0, int)
        return np.flatnonzero(given[curve][self.first :])

    def of_curve(self, curve: Curve) -> Array:
        """uᵀ, or wᵀ of KS, of every channel."""
        return self.force if curve is Curve.KS else self.error

    def picked(self, curve: np.ndarray, number: np.ndarray, size: int) -> Array | None:
        """L (M, size, size) such that L M has only the channel's row of M, as its first.

        The identity where a number is of the whole; None where all are.
        """
        single = number >= self.first
        if not single.any():
            return None
        found = np.tile(np.eye(size), (len(number), 1, 1))
        found[single] = 0.0
        for rows, of_force in ((self.error, False), (self.force, True)):
            own = np.flatnonzero(single & ((curve == Curve.KS) == of_force))
            found[own, 0, : rows.shape[1]] = rows[number[own] - self.first]
        return found


def own_rows(bounds: Bounds, plants: MatrixPlantSet) -> OwnRows:
    """Those that the bounds name, for plants in the coordinates of these."""
    first = plants.matrices.shape[2]
    own, weights = bounds.channels, bounds.weights
    level, scale = np.nan, 1.0
    if bounds.weighted_level is not None and weights is not None:
        level, scale = np.log(bounds.weighted_level), weights.M_K
    S_max = [np.nan if one.S_max is None else np.log(one.S_max) for one in own]
    levels = [np.nan if one.M_K is None else level + np.log(one.M_K / scale) for one in own]
    count = len(own)
    return OwnRows(
        first,
        np.array([np.log(bounds.S_max)] * first + S_max),
        np.array([level] * first + levels),
        np.array([0.0] * first + [one.lead for one in own]),
        plants.out[:count],
        np.asarray(np.linalg.inv(plants.into)[:count], float),
    )
