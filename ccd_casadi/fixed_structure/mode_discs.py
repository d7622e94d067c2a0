"""Discs around what the modes of a plant are over frequencies and boxes of their parameters.

    g = 1/(s² + g s + k) = N/D + M/E,   D = s - p, E = s - q;   g ∈ middle + radius {|e| <= 1}

With hold and delay D = 1 - e^{(p-s)T}, N the answer of the pole to them. (Discs of modes in the
Nyquist plane: Delissen, van Keulen and Langelaar 2023.)
"""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.affine import Affine, inverse
from ccd_casadi.fixed_structure.boxes import Axis, Pair
from ccd_casadi.fixed_structure.uncertainty import ModalSum
from ccd_casadi.support.arrays import Array

TURNS = np.exp(1j * np.pi * np.arange(-2, 3) / 4)  # half planes that 1/D is looked for in


@dataclass(frozen=True)
class Discs:
    """Of n modes over N boxes: `middle`, `radius` (n, N), and what each coordinate adds to the
    latter (n, 1 + n_p, N)."""

    middle: np.ndarray
    radius: Array
    shares: Array


def discs_of(
    plant: ModalSum, names: tuple[str, ...], low: Array, high: Array, axis: Axis, free: bool
) -> tuple[Discs, Discs, np.ndarray]:
    """Of all modes as the loop has them, and where `free` without hold and delay; where all modes
    stay damped (N,)."""
    free &= axis.period is not None
    count = (len(plant.omega), 1 + len(names), low.shape[1])
    held, bare = (
        Discs(np.zeros(count[::2], complex), np.zeros(count[::2]), np.zeros(count))
        for _ in range(2)
    )
    damped = np.ones(count[2], bool)
    for i in range(count[0]):
        own = [k for k, name in enumerate(names)
               if name == plant.shift_of(i) or not name.startswith("mode_shift")]  # fmt: skip
        poles, calm = plant.poles(i, tuple(names[k] for k in own), low[own], high[own])
        damped &= calm
        rows = [0, *(1 + k for k in own)]
        _fill(held, i, rows, *(axis.factor(p, residue) for p, residue in poles))
        if free:
            s = axis.s.of(len(rows))
            _fill(bare, i, rows, *((s - p, residue) for p, residue in poles))
    return held, bare if free else held, damped


def _fill(discs: Discs, i: int, rows: list[int], first: Pair, second: Pair) -> None:
    """Mode i's disc: of both poles as one form, since far above a resonance they nearly cancel, or
    a disc of each."""
    (D, N), (E, M) = first, second
    whole = N * inverse(D) + M * inverse(E)
    one, two = quotient(N, D), quotient(M, E)
    radius, apart = whole.reach + whole.rest, one[1] + two[1]
    near = ~(radius <= apart)
    discs.middle[i] = np.where(near, one[0] + two[0], whole.centre)
    discs.radius[i] = np.where(near, apart, radius) * (1.0 + 1e-12)
    moves = np.abs(one[0]) * one[2] + np.abs(two[0]) * two[2]
    discs.shares[i, rows] = np.where(near, moves, np.abs(whole.slope))


def quotient(N: Affine, D: Affine) -> tuple[np.ndarray, Array, Array]:
    """Centre and radius of a disc around N/D, and how each variable moves it (n, N), relative.

    1/D lies in that of 1/D as a form, or where Re e^{-jθ}D >= d in the disc of diameter 1/d that
    touches 0; N then turns and scales the latter, which keeps 0 on its edge.
    """
    form = inverse(D)
    turned = TURNS.conj()[:, None] * D.centre
    d = turned.real - np.abs((TURNS.conj()[:, None, None] * D.slope).real).sum(1) - D.rest
    best = np.argmax(d, axis=0)
    d = d[best, np.arange(len(best))]
    half = np.where(d > 0.0, 0.5 / np.where(d > 0.0, d, 1.0), np.inf) * (1.0 + 1e-15)
    centre, radius = form.centre, form.reach + form.rest
    size = np.abs(N.centre)
    spread = N.reach + N.rest
    outer = size * radius + spread * (np.abs(centre) + radius)
    along = N.slope / np.where(size == 0.0, 1.0, N.centre)
    longer, aside = (np.abs(part).sum(0) + N.rest / size for part in (along.real, along.imag))
    grown = np.hypot(1.0 + longer, aside)
    bent = np.where(longer < 1.0, aside / np.where(longer < 1.0, 1.0 - longer, 1.0), np.inf)
    touching = size * half * grown * (1.0 + bent)
    chosen = ~(outer <= touching)
    edge = N.centre * TURNS[best].conj() * half * grown
    moves = np.abs(D.slope) / np.where(chosen, d, np.abs(D.centre)) + np.abs(along)
    return np.where(chosen, edge, N.centre * centre), np.where(chosen, touching, outer), moves
