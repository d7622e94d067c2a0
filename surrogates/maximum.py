"""The maximum of several smooth functions, each fitted to the samples where it is the largest.

A peak over frequency is such a maximum: it is smooth until another local peak takes over, and
kinked there. One smooth surrogate is off around the kink by what the kink is worth; one for each
piece is not. Which piece a sample belongs to must be known, from where the peak was for one.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surrogates.fitting import Kind, fit_samples, named
from surrogates.interface import Array, Surrogate, SurrogateFitError, freeze, points_in
from surrogates.kernels import Kernel
from surrogates.samples import checked
from surrogates.validation import Errors, errors

# Ratio of neighbouring marks that parts two pieces, and the least that a piece holds.
GAP = 1.25


@dataclass(frozen=True, eq=False)
class Maximum:
    """max_k of surrogates of the same inputs; its deviation is that of the largest.

    left_out (n,): each sample's residual from its own piece without it, in output units.
    """

    pieces: tuple[Surrogate, ...]
    left_out: Array
    loo: Errors

    def __post_init__(self) -> None:
        if not self.pieces or len({piece.lower.size for piece in self.pieces}) != 1:
            raise ValueError("a maximum needs pieces, all of the same inputs")
        freeze(self.left_out)

    @property
    def lower(self) -> Array:
        """Lower bounds (d,)."""
        return self.pieces[0].lower

    @property
    def upper(self) -> Array:
        """Upper bounds (d,)."""
        return self.pieces[0].upper

    @property
    def has_std(self) -> bool:
        """Whether all pieces know their deviation."""
        return all(piece.has_std for piece in self.pieces)

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Array: ...
    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Array, Array]: ...
    def predict(self, X: ArrayLike, return_std: bool = False) -> Array | tuple[Array, Array]:
        """Return the value (m,) at X (m, d), and the deviation (m,) of the largest if asked."""
        points = points_in(self, X)
        if not return_std:
            return np.max([piece.predict(points) for piece in self.pieces], axis=0)
        both = [piece.predict(points, return_std=True) for piece in self.pieces]
        values, deviations = (np.array(part) for part in zip(*both, strict=True))
        largest = values.argmax(axis=0), np.arange(len(points))
        return values[largest], deviations[largest]


def fit_maximum(
    X: ArrayLike,
    Y: ArrayLike,
    pieces: ArrayLike,
    dY: ArrayLike | None = None,
    *,
    lower: ArrayLike,
    upper: ArrayLike,
    kind: Kind | str = Kind.GAUSSIAN_PROCESS,
    kernel: Kernel | str = Kernel.MATERN52,
    seed: int = 0,
    starts: int = 5,
) -> Maximum:
    """Fit one surrogate to each piece, given by a number for each sample (n,), as `fit` does.

    X (n, d), Y (n,), dY (n, d). A piece is fitted to its own samples only: where it is not the
    largest it is extrapolated, which its gradients, if there are any, make a good deal safer.

    Raises:
        SurrogateFitError: as `fit`, and a piece of too few samples.
    """
    samples = checked(X, Y, lower, upper, dY)
    labels = np.asarray(pieces)
    if labels.shape != samples.Y.shape:
        raise SurrogateFitError(f"expected pieces {samples.Y.shape}, got {labels.shape}")
    a_kind, a_kernel = named(Kind, kind, "kind"), named(Kernel, kernel, "kernel")
    least = least_of_a_piece(samples.X.shape[1], gradients=dY is not None)
    found, left_out = [], np.empty(samples.Y.size)
    for label in np.unique(labels):
        rows = np.flatnonzero(labels == label)
        if rows.size < least:
            raise SurrogateFitError(
                f"piece {label} has {rows.size} samples, fewer than {least}: take more samples "
                "there, or count it to another piece"
            )
        piece = fit_samples(samples.rows(rows), a_kind, kernel=a_kernel, seed=seed, starts=starts)
        left_out[rows] = piece.left_out
        found.append(piece)
    return Maximum(tuple(found), left_out, errors(left_out, samples.Y))


def least_of_a_piece(d: int, gradients: bool) -> int:
    """Samples that settle a piece: of values d + 2, of values and gradients 4."""
    return 4 if gradients else d + 2


def pieces_of(marks: ArrayLike, least: int, gap: float = GAP) -> NDArray[np.intp]:
    """Return the piece (n,) of each sample from positive marks (n,), frequencies of peaks say.

    Sorted, the marks are parted at every step by more than the factor `gap`; a part of fewer
    than `least` samples is counted to its neighbour across the smaller step.

    >>> pieces_of([70.0, 230.0, 72.0, 240.0, 66.0, 225.0], 2).tolist()
    [0, 1, 0, 1, 0, 1]
    """
    values = np.log(np.asarray(marks, dtype=float))
    order = np.argsort(values)
    steps = np.diff(values[order])
    cuts: list[int] = [int(i) + 1 for i in np.flatnonzero(steps > np.log(gap))]
    while cuts:
        sizes = np.diff([0, *cuts, values.size])
        small = int(sizes.argmin())
        if sizes[small] >= least:
            break
        beside: Sequence[int] = [k for k in (small - 1, small) if 0 <= k < len(cuts)]
        cuts.pop(min(beside, key=lambda k: float(steps[cuts[k] - 1])))
    labels: Any = np.empty(values.size, dtype=np.intp)
    labels[order] = np.searchsorted(cuts, np.arange(values.size), side="right")
    return np.asarray(labels)
