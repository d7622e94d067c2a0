"""Modes of neighbouring samples told apart, and their numbers as smooth functions of θ."""

from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb, prod
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.distance import cdist

from ccd_casadi.extensions.imported.modal_table import ModalTable
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

LOST = "the samples cannot be interpolated"


@dataclass(frozen=True)
class EntryFitOptions:
    """Numbers of the fit of entries: a polynomial and radial functions of Matérn's kind.

    Attributes
    ----------
    most_degree, most_terms : int
        Of the polynomial.
    singular : float
        Relative pivot below which terms are not distinguished by the samples, and leverage of
        the other samples below which a sample alone settles a term.
    lengths : tuple of float
        Lengths of the radial functions that are tried, over half the range of each parameter.
    largest_coefficient : float
        Of a radial function, over the numbers: beyond, the sum loses digits.
    """

    most_degree: int = 12
    most_terms: int = 500
    singular: float = 1e-9
    lengths: tuple[float, ...] = (0.5, 1.0, 2.0)
    largest_coefficient: float = 1e4


def fit_entries(
    theta: Array, Y: Array, *, options: EntryFitOptions = EntryFitOptions()
) -> tuple[ca.Function, Array]:
    """θ -> q numbers, of numbers Y (N, q) at samples θ (N, p), and the error (N, q) at each sample,
    predicted without it. Raises PlantError where the samples are too few, or one is there twice."""
    lower, width = theta.min(axis=0), np.ptp(theta, axis=0)
    N, p = theta.shape
    unit = 2.0 * (theta - lower) / np.where(width > 0.0, width, np.nan) - 1.0
    if not np.isfinite(unit).all():
        raise PlantError(f"{LOST}: a parameter does not vary among the samples; add samples")
    if len(np.unique(unit, axis=0)) < N:
        raise PlantError("two samples are at the same theta; keep one of them")
    squares = ((unit[:, None] - unit) ** 2).sum(axis=2)
    radial = [_matern(squares / length**2, np) for length in options.lengths]
    left_out, trend = np.full(Y.shape, np.inf), np.zeros((0, Y.shape[1]))
    spread = np.zeros((len(options.lengths), *Y.shape))
    powers = np.zeros((0, p))
    for degree in range(options.most_degree + 1):
        if not comb(p + degree, degree) < min(N, options.most_terms + 1):
            break
        rows = combinations_with_replacement(range(p), degree)
        powers = np.vstack([powers, [np.bincount(row, minlength=p) for row in map(list, rows)]])
        trend = np.pad(trend, ((0, len(powers) - len(trend)), (0, 0)))
        Q, R = np.linalg.qr(np.prod(unit[:, None, :] ** powers, axis=2), mode="complete")
        (own, rest), R = np.split(Q, [len(powers)], axis=1), R[: len(powers)]
        pivots = np.abs(np.diag(R))
        singular = options.singular
        if pivots.min() < singular * pivots.max() or (rest**2).sum(axis=1).min() < singular:
            continue
        for k, phi in enumerate(radial):
            W = rest @ np.linalg.solve(rest.T @ phi @ rest, rest.T)
            a = W @ Y
            errors = a / np.diag(W)[:, None]
            better = (errors**2).sum(axis=0) < (left_out**2).sum(axis=0)
            largest = options.largest_coefficient * np.abs(Y).max(axis=0)
            better &= (k == 0) | (np.abs(a).max(axis=0) <= largest)
            left_out[:, better], spread[:, :, better] = errors[:, better], 0.0
            spread[k][:, better] = a[:, better]
            trend[:, better] = np.linalg.solve(R, own.T @ (Y - phi @ a))[:, better]
    if not np.isfinite(left_out).all():
        words = f"{N} samples of {p} parameters do not settle a polynomial; add samples"
        raise PlantError(f"{LOST}: {words}")
    x = ca.MX.sym("theta", p)
    scaled = 2.0 * (x - lower) / width - 1.0
    terms = [prod((scaled[j] ** int(k) for j, k in enumerate(row) if k), start=ca.MX(1.0))
             for row in powers]  # fmt: skip
    y = ca.mtimes(ca.DM(trend.T), ca.vertcat(*terms))
    away = ca.sum1((ca.repmat(scaled, 1, N) - ca.DM(unit.T)) ** 2).T
    for length, a in zip(options.lengths, spread, strict=True):
        if a.any():
            y += ca.mtimes(ca.DM(a.T), _matern(away / length**2, ca))
    return ca.Function("entries", [x], [y]), left_out


def _matern(squares: Any, module: Any) -> Any:
    """φ of squared distances over l², by NumPy or CasADi."""
    x = module.sqrt(7.0 * squares + 1e-16)  # φ has no slope at a sample, but this root would
    return (1.0 + x + 0.4 * x**2 + x**3 / 15.0) * module.exp(-x)


Index = NDArray[np.int64]
Groups = tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class FrameOptions:
    """Numbers of the matching of modes.

    Attributes
    ----------
    close : float
        Relative distance of frequencies within which modes are one group.
    frequency_weight : float
        Weight of |ln f_i/f_j| against 1 - MAC.
    tie : float
        Share of the shapes' size that keeps an undetermined rotation near the identity.
    """

    close: float = 0.15
    frequency_weight: float = 1.0
    tie: float = 1e-3


@dataclass(frozen=True)
class Frame:
    """Q (N, r, r): Q[s] turns sample s's modes into the frame; `groups` of modes that K couples."""

    name: str
    Q: Array
    groups: Groups


def frames(table: ModalTable, rigid: int, *, options: FrameOptions = FrameOptions()) -> list[Frame]:
    """The frames worth trying: modes by order, matched, and matched with groups turned.

    The first `rigid` modes are one group in each: rigid-body modes have no order of their own.
    """
    count = table.omega.shape[1]
    shapes = np.concatenate([table.inputs, table.outputs, table.shapes], axis=2)
    order, parents = _tree(table.theta)
    ordered = np.tile(np.arange(count), (len(table.theta), 1))
    matched = _matched(table, shapes, order, parents, rigid, options.frequency_weight)
    free: Groups = (tuple(range(rigid)),) if rigid else ()
    single: Groups = tuple((i,) for i in range(rigid, count))
    name, tie = "modes in order of frequency", options.tie
    found = [_frame(name, shapes, ordered, order, parents, free + single, tie)]
    if (matched != ordered).any():
        found.append(_frame("modes matched", shapes, matched, order, parents, free + single, tie))
    groups = free + _groups(np.take_along_axis(table.omega, matched, 1), rigid, options.close)
    if len(groups) < len(free + single):
        name = "modes matched, close ones turned together"
        found.append(_frame(name, shapes, matched, order, parents, groups, tie))
    return found


def _tree(theta: Array) -> tuple[Index, Index]:
    """The samples in breadth-first order from the most central one, and each one's parent."""
    width = np.ptp(theta, axis=0)
    unit = (theta - theta.min(axis=0)) / np.where(width > 0.0, width, 1.0)
    centre = int(np.linalg.norm(unit - unit.mean(axis=0), axis=1).argmin())
    distance = cdist(unit, unit)
    order, parents = breadth_first_order(minimum_spanning_tree(distance), centre, directed=False)
    return order.astype(np.int64), parents.astype(np.int64)


def _matched(
    table: ModalTable, shapes: Array, order: Index, parents: Index, rigid: int, weight: float
) -> Index:
    """(N, r) which mode of each sample is the reference's i-th; flexible modes only move."""
    count = table.omega.shape[1]
    found = np.tile(np.arange(count), (len(table.theta), 1))
    for s in order[1:]:
        before = found[parents[s]][rigid:]
        one, other = shapes[parents[s]][before], shapes[s][rigid:]
        sizes = np.outer((one**2).sum(axis=1), (other**2).sum(axis=1))
        # 0 where a shape vanishes at every point
        mac = np.divide((one @ other.T) ** 2, sizes, out=np.zeros_like(sizes), where=sizes > 0.0)
        gap = np.abs(
            np.log(table.omega[parents[s]][before][:, None] / table.omega[s][rigid:][None, :])
        )
        found[s, rigid:] = rigid + linear_sum_assignment(1.0 - mac + weight * gap)[1]
    return found


def _groups(omega: Array, rigid: int, close: float) -> Groups:
    """Flexible modes in groups that come close, or cross, at some sample."""
    x = np.log(omega[:, rigid:])
    ratio = x[:, :, None] - x[:, None, :]
    near = (np.abs(ratio).min(axis=0) < close) | (np.ptp(np.sign(ratio), axis=0) > 0.0)
    count, label = connected_components(near, directed=False)
    return tuple(tuple((rigid + np.flatnonzero(label == i)).tolist()) for i in range(count))


def _frame(
    name: str, shapes: Array, permutation: Index, order: Index, parents: Index, groups: Groups,
    tie: float,
) -> Frame:  # fmt: skip
    """Signs along the tree; then each group turned next to the reference sample's."""
    N, r = permutation.shape
    Q = np.zeros((N, r, r))
    for s in range(N):
        Q[s, np.arange(r), permutation[s]] = 1.0
    for s in order[1:]:
        along = ((Q[parents[s]] @ shapes[parents[s]]) * (Q[s] @ shapes[s])).sum(axis=1)
        Q[s] *= np.where(along < 0.0, -1.0, 1.0)[:, None]
    reference = Q[order[0]] @ shapes[order[0]]
    for group in groups:
        if len(group) == 1:
            continue
        rows = list(group)
        for s in order[1:]:
            product = reference[rows] @ (Q[s] @ shapes[s])[rows].T
            U, _, Vh = np.linalg.svd(product + tie * np.linalg.norm(product) * np.eye(len(rows)))
            Q[s, rows] = (U @ Vh) @ Q[s, rows]
    return Frame(name, Q, groups)
