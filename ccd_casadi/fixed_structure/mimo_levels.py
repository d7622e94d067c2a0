"""How S, KS, T and GS of plants of several channels stand to their bounds, without derivatives.

The problem of such plants as a whole, ln σ over its bound of every matrix at many frequencies, and
what is added to ln σ to make it a constraint.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.figures import HALF_POWER, OF_S
from ccd_casadi.fixed_structure.loop_problem import (
    Curve,
    LoopProblem,
    chain_of,
    log_weights,
    shaped_at,
)
from ccd_casadi.fixed_structure.mimo_loop import MatrixPlantSet
from ccd_casadi.fixed_structure.own_rows import OwnRows, own_rows
from ccd_casadi.fixed_structure.structure import response
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class MatrixProblem(LoopProblem):
    """That of plants of several channels, as a whole."""

    plants: MatrixPlantSet
    structure: ChannelStructure

    @cached_property
    def own(self) -> OwnRows:
        """The rows that single channels bound for themselves."""
        return own_rows(self.bounds, self.plants)


def levels(
    problem: MatrixProblem, kappa: Array, tau: float, which: np.ndarray, v: Array, least: float
) -> dict[Curve, Array]:
    """ln σ over the bound, by number, of every curve on the plants `which` at v, of one shape.

    -inf where none can be above `least`. σ² is never above the largest row sum of |MᴴM|: most
    frequencies need no decomposition.
    """
    plants, own = problem.plants, problem.own
    S, KS, T = loop_matrices(problem, kappa, which, v)
    found: dict[Curve, Array] = {}
    whole = {
        curve: offsets(problem, tau, np.full(v.shape, curve), np.zeros(v.shape, int), v)[0]
        for curve in problem.curves
    }
    of_s = [curve for curve in problem.curves if curve in OF_S and curve is not Curve.GS]
    gains = _log_gains(S, np.max([whole[curve] for curve in of_s], axis=0), least)
    for curve, offset in whole.items():
        kind = np.full(v.shape, curve)
        if curve in of_s:
            M, own_gains = S, gains
        else:
            others = {Curve.KS: KS, Curve.T: T}
            M = others[curve] if curve in others else S @ plants.values(which, v, free=True)
            own_gains = _log_gains(M, offset, least)
        found[curve] = own_gains + offset[..., None]
        if own.count:
            alone = np.full((*v.shape, own.count), -np.inf)
            lengths = np.linalg.norm(own.of_curve(curve) @ M, axis=-1)
            for i in own.bounded(curve).tolist():
                offset, _ = offsets(problem, tau, kind, np.full(v.shape, own.first + i), v)
                alone[..., i] = np.log(lengths[..., i]) + offset
            found[curve] = np.concatenate([found[curve], alone], axis=-1)
    return found


def loop_matrices(
    problem: MatrixProblem, kappa: Array, which: np.ndarray, v: Array
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """S, KS and T (..., p, p) of the plants `which` at v, without weights."""
    k = np.stack([response(own, part, 1j * v) for own, part in problem.structure.split(kappa)], -1)
    K = problem.plants.into @ (k[..., None] * problem.plants.out)
    G = problem.plants.values(which, v)
    eye = np.eye(K.shape[-1])
    S = np.linalg.inv(eye + G @ K)
    return S, K @ S, eye - S


def _log_gains(M: np.ndarray, offset: Array, least: float) -> Array:
    """ln σ where ln σ + offset may be above `least`, else -inf."""
    square = np.abs(np.conj(np.swapaxes(M, -1, -2)) @ M).sum(-1).max(-1)
    with np.errstate(divide="ignore"):
        chosen = 0.5 * np.log(square) + offset > least
        out = np.full((*offset.shape, min(M.shape[-2:])), -np.inf)
        out[chosen] = np.log(np.linalg.svd(M[chosen], compute_uv=False))
    return out


def offsets(
    problem: MatrixProblem, tau: float, curve: np.ndarray, number: np.ndarray, v: Array
) -> tuple[Array, Array]:
    """What is added to ln σ to make it a constraint, and its slope to ln v; `number` as of rows."""
    plants, bounds, own = problem.plants, problem.bounds, problem.own
    omega = plants.frequency(v)
    chain = chain_of(problem, v)
    out, slope = np.zeros(v.shape), np.zeros(v.shape)
    peak = curve == Curve.S_MAX
    out[peak] = -own.ln_S_max[number[peak]]
    out[curve == Curve.S_LOW] = -np.log(bounds.S_low)
    out[(curve == Curve.CROSSING) | (curve == Curve.LEVEL)] = HALF_POWER
    shape = curve == Curve.SHAPE
    if bounds.shape is not None and shape.any():
        counted = shaped_at(problem, omega)
        under = np.log(bounds.shape * counted) - (tau + own.lead[number])
        out[shape] = HALF_POWER - under[shape]
        slope[shape] = np.where(counted == omega, -chain, 0.0)[shape]
    if bounds.weighted_level is not None and bounds.weights is not None:
        W, dW = log_weights(bounds.weights, omega * plants.omega_0)
        level = own.ln_level[number]
        for code, row, extra in ((Curve.KS, 0, np.log(plants.force)), (Curve.T, 1, 0.0)):
            weighted = curve == code
            out[weighted] = (W[row] + extra - level)[weighted]
            slope[weighted] = (dW[row] * chain)[weighted]
    if bounds.compliance_max is not None:
        out[curve == Curve.GS] = -np.log(bounds.compliance_max * plants.force)
    return out, slope
