"""Modes of neighbouring samples told apart and turned into one frame.

A mode shape is known up to its sign, and where two frequencies come close the modes exchange their
shapes within a small change of θ (veering). Neither frequencies nor shapes can be interpolated
across that. But any orthogonal Q turns a modal model into an equal one,
K = Q Λ Qᵀ, B = Q Φ_B, C = Φ_C Qᵀ, and Q can be chosen so that K, B and C are smooth in θ: the
rotation, within each group of modes that come close, that brings a sample's shapes nearest to the
reference sample's (orthogonal Procrustes; K then has entries off its diagonal in the group).

Which modes are the same is settled along the shortest tree that joins the samples, by the modal
assurance criterion MAC_ij = (v_iᵀv_j)²/(v_iᵀv_i v_jᵀv_j) and the frequencies, as one assignment.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.distance import cdist

from ccd_casadi.plants.imported.modal_table import ModalTable
from ccd_casadi.support.arrays import Array

Index = NDArray[np.int64]
Groups = tuple[tuple[int, ...], ...]
CLOSE = 0.15  # modes whose frequencies come within this share of each other are one group
FREQUENCY_WEIGHT = 1.0  # of |ln f_i/f_j| against 1 - MAC
TIE = 1e-3  # share of the shapes' size that keeps an undetermined rotation next to none


@dataclass(frozen=True)
class Frame:
    """Q (N, r, r): Q[s] turns sample s's modes into the frame; `groups` of modes that K couples."""

    name: str
    Q: Array
    groups: Groups


def frames(table: ModalTable, rigid: int) -> list[Frame]:
    """The frames worth trying: modes by order, matched, and matched with groups turned.

    The first `rigid` modes are one group in each: rigid-body modes have no order of their own.
    """
    count = table.omega.shape[1]
    shapes = np.concatenate([table.inputs, table.outputs, table.shapes], axis=2)
    order, parents = _tree(table.theta)
    ordered = np.tile(np.arange(count), (len(table.theta), 1))
    matched = _matched(table, shapes, order, parents, rigid)
    free: Groups = (tuple(range(rigid)),) if rigid else ()
    single: Groups = tuple((i,) for i in range(rigid, count))
    found = [_frame("modes in order of frequency", shapes, ordered, order, parents, free + single)]
    if (matched != ordered).any():
        found.append(_frame("modes matched", shapes, matched, order, parents, free + single))
    groups = free + _groups(np.take_along_axis(table.omega, matched, 1), rigid)
    if len(groups) < len(free + single):
        name = "modes matched, close ones turned together"
        found.append(_frame(name, shapes, matched, order, parents, groups))
    return found


def _tree(theta: Array) -> tuple[Index, Index]:
    """The samples in breadth-first order from the most central one, and each one's parent."""
    width = np.ptp(theta, axis=0)
    unit = (theta - theta.min(axis=0)) / np.where(width > 0.0, width, 1.0)
    centre = int(np.linalg.norm(unit - unit.mean(axis=0), axis=1).argmin())
    distance = cdist(unit, unit)
    order, parents = breadth_first_order(minimum_spanning_tree(distance), centre, directed=False)
    return order.astype(np.int64), parents.astype(np.int64)


def _matched(table: ModalTable, shapes: Array, order: Index, parents: Index, rigid: int) -> Index:
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
        found[s, rigid:] = rigid + linear_sum_assignment(1.0 - mac + FREQUENCY_WEIGHT * gap)[1]
    return found


def _groups(omega: Array, rigid: int) -> Groups:
    """Flexible modes in groups that come close, or cross, at some sample."""
    x = np.log(omega[:, rigid:])
    ratio = x[:, :, None] - x[:, None, :]
    near = (np.abs(ratio).min(axis=0) < CLOSE) | (np.ptp(np.sign(ratio), axis=0) > 0.0)
    count, label = connected_components(near, directed=False)
    return tuple(tuple((rigid + np.flatnonzero(label == i)).tolist()) for i in range(count))


def _frame(
    name: str, shapes: Array, permutation: Index, order: Index, parents: Index, groups: Groups
) -> Frame:
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
            U, _, Vh = np.linalg.svd(product + TIE * np.linalg.norm(product) * np.eye(len(rows)))
            Q[s, rows] = (U @ Vh) @ Q[s, rows]
    return Frame(name, Q, groups)
