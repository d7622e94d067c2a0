"""Is a point, an optimum for one, where the samples support the surrogate?"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surrogates.gaussian_process import GaussianProcess
from surrogates.interface import Array

# Samples nearest to the point that enter the hull: those beyond seldom change it.
NEAREST = 500
# A point this many typical spacings outside the hull, or with this many times the
# deviation that is met one spacing away from the samples, is not supported by them.
SPACINGS = 1.0
DEVIATIONS = 2.0
OUTSIDE = 1e-9


@dataclass(frozen=True)
class Extrapolation:
    """How far a point is from the samples, in the unit box, and what follows.

    Parameters
    ----------
    hull, nearest : float
        Distance to the samples' convex hull, and to the nearest one.
    spacing : float
        Median distance of a sample to its nearest neighbour.
    deviation : float or None
        Predicted deviation over that one spacing from the samples (95 % quantile); None: that is 0.
    reasons : tuple of str
        A sentence for everything amiss; with none the point is supported.
    """

    hull: float
    nearest: float
    spacing: float
    deviation: float | None
    reasons: tuple[str, ...]

    @property
    def flagged(self) -> bool:
        """Whether the surrogate extrapolates at the point."""
        return bool(self.reasons)


def extrapolation(surrogate: GaussianProcess, X: ArrayLike, x: ArrayLike) -> Extrapolation:
    """Compare a point with the samples that a surrogate was fitted to.

    Flagged are points outside the box, further outside the convex hull of the samples
    than their typical spacing (in many inputs almost every point of the box is a
    little outside it), further from every sample than twice the widest gap among them,
    or where the deviation is twice the largest that is usual one spacing from a sample.

    Parameters
    ----------
    surrogate : GaussianProcess
        What was fitted.
    X : array (n, d)
        Its samples, in input units.
    x : array (d,)
        The point.

    Returns
    -------
    Extrapolation
        Distances, and a reason for each flag.

    Raises
    ------
    ValueError
        The point or the samples do not have the surrogate's inputs.
    """
    from scipy.spatial import cKDTree

    low, span = surrogate.lower, surrogate.upper - surrogate.lower
    samples, point = surrogate.in_unit_box(X), surrogate.in_unit_box(x)[0]
    near = cKDTree(samples).query(samples, k=2)[0][:, 1]  # to the nearest other sample
    spacing = float(np.median(near))
    distances = np.linalg.norm(samples - point, axis=1)
    nearest = float(distances.min())
    hull = hull_distance(samples[np.argsort(distances)[:NEAREST]], point)
    reasons = []
    beyond = np.flatnonzero((point < -OUTSIDE) | (point > 1.0 + OUTSIDE))
    if beyond.size:
        reasons.append(f"input {', '.join(map(str, beyond))} is outside the sampled box")
    if hull > SPACINGS * spacing:
        reasons.append(
            f"the point lies {hull:.3g} box widths outside the hull of the samples, which are "
            f"{spacing:.3g} apart"
        )
    if nearest > 2.0 * float(near.max()):
        reasons.append(
            f"the nearest sample is {nearest:.3g} box widths away, where samples are "
            f"{spacing:.3g} apart"
        )
    rng = np.random.default_rng(0)
    step = rng.standard_normal(samples[:NEAREST].shape)
    step *= spacing / np.linalg.norm(step, axis=1, keepdims=True)
    around = low + span * np.clip(samples[:NEAREST] + step, 0.0, 1.0)
    usual = float(np.quantile(surrogate.predict(around, return_std=True)[1], 0.95))
    here = float(surrogate.predict(low + span * point, return_std=True)[1][0])
    deviation = here / usual if usual > 0.0 else None
    if deviation is not None and deviation > DEVIATIONS:
        reasons.append(
            f"the predicted deviation is {deviation:.3g} times what is usual "
            "one spacing from a sample"
        )
    return Extrapolation(hull, nearest, spacing, deviation, tuple(reasons))


def hull_distance(samples: Array, point: Array) -> float:
    """Return min ‖Xᵀw - x‖ over w >= 0, Σ w = 1: the distance of x (d,) to the hull of X (n, d).

    >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    >>> round(hull_distance(square, np.array([1.5, 0.5])), 6)
    0.5
    """
    from scipy.optimize import nnls  # 0.3 s to import

    # The sum as one more, heavy equation; what it is missed by is mended afterwards.
    heavy = 1e3
    A = np.vstack([samples.T, np.full(len(samples), heavy)])
    w, _ = nnls(A, np.append(point, heavy))
    return float(np.linalg.norm(samples.T @ (w / w.sum()) - point))
