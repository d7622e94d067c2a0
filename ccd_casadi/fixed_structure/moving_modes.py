"""Modes of a plant whose matrices move with x: ω_i(x) and b_i(x) c_i(x), enclosed on pieces of x.

In the modes Φ of a piece's middle ΦᵀMΦ = 1 + F, ΦᵀKΦ = Λ + E. A vector e_i + w, w_i = 0, with
Kv = λMv is a fixed point of

    w_j = -(A_ji + Σ_k A_jk w_k)/(Λ_j - λ),   λ = Λ_i + A_ii + Σ_k A_ik w_k,   A = E - λF.

Discs |w_j| <= ρ_j, |λ - Λ_i| <= m_i that this maps into themselves hold one at every x of the piece
(Brouwer), and the only one where the m_i keep all n eigenvalues apart. Put in once more they leave
w and λ to first order in x with a rest of second order, and b_i c_i = (cΦv)(bᵀΦv)/(vᵀ(1 + F)v).
(Rump 2010, Verification methods, section 13.)
"""

import casadi as ca
import numpy as np

from ccd_casadi.fixed_structure.affine import Affine, inverse, outputs, product, root, variable
from ccd_casadi.support.arrays import Array

RIGID = 1e-10  # λ over the largest: what the model's rigid modes are enclosed to, of no stiffness
STEPS = 12  # of the search for discs that are mapped into themselves
WIDER = 1.1  # than what the step before gave
SINGULAR = 1e-14  # relative: a mass matrix with such an eigenvalue is not inverted


@np.errstate(all="ignore")  # of pieces that are too wide
def moving_modes(
    graph: ca.Function, rigid: int, unit: float, low: Array, high: Array
) -> tuple[list[list[Affine]], np.ndarray]:
    """ω and b c of every mode over boxes (q, N) of x, time in 1/`unit`; where they are enclosed.

    `graph`: x to M, D, K, b (n, 1), c (1, n), SI. That the first modes are `rigid` and the others
    are not, and apart from these, is part of it; a rigid mode stays one, with ω = 0.
    """
    pieces, back = np.unique(np.vstack([low, high]), axis=1, return_inverse=True)
    ends = zip(*np.split(pieces, 2), strict=True)
    x = [variable(least, most, k, len(low)) for k, (least, most) in enumerate(ends)]
    M, _, K, b, c = outputs(graph, x)
    (q, N, n), eye = M.slope.shape[:3], np.eye(M.slope.shape[2])
    sizes = np.array([f.size.sum(axis=(1, 2)) for f in (M, K, b, c)])
    known = np.asarray(np.isfinite(sizes).all(axis=0))
    mass, stiffness = (np.where(known[:, None, None], f.centre, eye) for f in (M, K))
    spectrum = np.linalg.eigvalsh(mass)
    known &= spectrum[:, 0] > SINGULAR * spectrum[:, -1]
    half = np.linalg.inv(np.linalg.cholesky(np.where(known[:, None, None], mass, eye)))
    lam, turned = np.linalg.eigh(half @ stiffness @ half.transpose(0, 2, 1))
    shapes = half.transpose(0, 2, 1) @ turned
    modes = Affine(shapes, np.zeros((q, N, n, n)), np.zeros((N, n, n)))
    M, K = (product("Nja,Nji->Nai", modes, product("Njk,Nki->Nji", f, modes)) for f in (M, K))
    E, F = (Affine(0.0 * eye, f.slope, f.rest + np.abs(f.centre - about))
            for f, about in ((K, lam[:, :, None] * eye), (M, eye)))  # fmt: skip
    size, own = np.abs(lam), np.arange(n)
    away = lam[:, :, None] - lam[:, None, :]
    away[:, own, own] = np.inf
    rho, m = np.zeros((N, n, n)), np.zeros((N, n))
    for _ in range(STEPS):
        held, within = WIDER * rho, WIDER * m
        top, gap = (size + within)[:, None, :], np.abs(away) - within[:, None, :]
        moved = E.size + F.size * top + E.size @ held + (F.size @ held) * top
        rho, m = np.where(gap > 0.0, moved / gap, np.inf), moved[:, own, own]
    known &= (rho <= held).all(axis=(1, 2)) & (m <= within).all(axis=1)
    known &= ((lam + m)[:, :-1] < (lam - m)[:, 1:]).all(axis=1)
    top, gap = (size + m)[:, None, :], np.abs(away) - m[:, None, :]
    A = E + F * -lam[:, None, :]
    second = A.rest + F.size * m[:, None, :] + E.size @ rho + (F.size @ rho) * top
    bent = A.reach * m[:, None, :] / np.abs(away)
    vectors = Affine(shapes * 0.0 + eye, -A.slope / away, (second + bent) / gap)
    read, drive = (product("Npk,Nki->Ni", product(how, f, modes), vectors)
                   for how, f in (("Npk,Nki->Npi", c), ("Nkp,Nki->Npi", b)))  # fmt: skip
    length = product("Nki,Nki->Ni", vectors, product("Njk,Nki->Nji", M, vectors))
    value = Affine(lam, A.slope[..., own, own], second[:, own, own])
    least, most = 2.0 * size - value.size, value.size
    lowest = most[:, :rigid].max(axis=1, initial=0.0, keepdims=True)
    apart = np.where(own < rigid, most <= RIGID * least[:, -1:], least > lowest)
    forms = root(value) * (1.0 / unit), read * drive * inverse(length) * unit**-2
    of_mode = [[Affine(f.centre[back, i], f.slope[:, back, i], f.rest[back, i]) for f in forms]
               for i in range(n)]  # fmt: skip
    return of_mode, (known & apart.all(axis=1))[back]
