"""Discs around what the modes of a plant are over frequencies and boxes of their parameters.

    g = 1/(s² + g s + k) = N/D + M/E,   D = s - p, E = s - q;   g ∈ middle + radius {|e| <= 1}

With hold and delay D = 1 - e^{(p-s)T}, N the answer of the pole to them. A free body is
that of `boxes`. (Discs of modes in the Nyquist plane: Delissen,
van Keulen and Langelaar 2023.)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.affine import Affine, inverse
from ccd_casadi.fixed_structure.boxes import Axis, Pair
from ccd_casadi.fixed_structure.uncertainty import ModalSum
from ccd_casadi.support.arrays import Array

FIRST = 1e30  # share of what is divided before anything else: where modes are not enclosed
CANCELLED = 1e3  # times what is of first order: there the second says what to divide
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
    """Of all modes as the loop has them, and where `free` without hold and delay; where all
    flexible modes stay damped (N,)."""
    free &= axis.period is not None
    count = (len(plant.omega), 1 + len(names), low.shape[1])
    held, bare = (
        Discs(np.zeros(count[::2], complex), np.zeros(count[::2]), np.zeros(count))
        for _ in range(2)
    )
    moved: Sequence[Sequence[Affine | None]] = [(None, None)] * count[0]
    q, known = sum(name.startswith("theta.") for name in names), np.ones(count[2], bool)
    if plant.moving is not None:
        moved, known = plant.moving(low[-q:], high[-q:])
    damped = known
    for i in range(count[0]):
        own = [k for k, name in enumerate(names)
               if name == plant.shift_of(i) or not name.startswith("mode_shift")]  # fmt: skip
        rows = [0, *(1 + k for k in own)]
        w, strength = (f and f.of(len(rows), len(rows) - q) for f in moved[i])
        if plant.rigid[i]:
            gain = plant.strength(tuple(names[k] for k in own), low[own], high[own])
            gain = gain if strength is None else gain * strength
            _fill_free(held, i, rows, axis.free_body.of(len(rows)) * gain)
            if free:
                _fill_free(bare, i, rows, axis.free_body_unheld.of(len(rows)) * gain)
            continue
        poles, decay = plant.poles(i, tuple(names[k] for k in own), low[own], high[own], w)
        damped = damped & (decay >= 0.0)
        T = axis.period  # of Re D, what it is not below
        least = decay * axis.x.lowest if T is None else -np.expm1(-decay * T)
        _fill(held, i, rows, [axis.factor(*pole) for pole in poles], least, strength)
        if free:
            s = axis.s.of(len(rows))
            _fill(bare, i, rows, [(s - p, residue) for p, residue in poles], decay, strength)
    if q:
        held.shares[:, -q:] = np.where(known, held.shares[:, -q:], FIRST * (high - low)[-q:])
    return held, bare if free else held, damped


def _fill_free(discs: Discs, i: int, rows: list[int], form: Affine) -> None:
    """A free body's disc."""
    discs.middle[i], discs.radius[i] = form.centre, (form.reach + form.rest) * (1.0 + 1e-12)
    discs.shares[i, rows] = form.reaches


def _fill(
    discs: Discs, i: int, rows: list[int], poles: list[Pair], least: Array, strength: Affine | None
) -> None:
    """Mode i's disc: of both poles as one form, since far above a resonance they nearly cancel, or
    a disc of each; times its strength, which may pass through 0."""
    (D, N), (E, M) = poles
    first, second = inverse(D), inverse(E)
    whole = N * first + M * second
    one, two = quotient(N, D, least, first), quotient(M, E, least, second)
    middle, apart = one[0] + two[0], one[1] + two[1]
    moves = one[2] + two[2]
    if strength is not None:
        whole, size, most = whole * strength, strength.middle, np.abs(middle) + apart
        apart = size * apart + (strength.reach + strength.rest) * most
        middle, moves = strength.centre * middle, size * moves + strength.reaches * most
    radius = whole.reach + whole.rest
    near = ~(radius <= apart) | np.isinf(radius)
    discs.middle[i] = np.where(near, middle, whole.centre)
    discs.radius[i] = np.where(near, apart, radius) * (1.0 + 1e-12)
    # where the first order cancels, as at rest, what is left is due to what moves the poles
    beyond = whole.rest * moves / np.maximum(moves.sum(axis=0), 1e-300)
    beyond = np.where(whole.rest > CANCELLED * whole.reach, beyond, 0.0)
    discs.shares[i, rows] = np.where(near, moves, whole.reaches + beyond)


def quotient(
    N: Affine, D: Affine, least: Array | float = 0.0, form: Affine | None = None
) -> tuple[np.ndarray, Array, Array]:
    """Centre and radius of a disc around N/D, and how each variable moves it (n, N); Re D >= least.

    1/D lies in that of 1/D as a `form`, or where Re e^{-jθ}D >= d in the disc of diameter 1/d that
    touches 0; N then turns and scales the latter, which keeps 0 on its edge. Around 0, |N|/d holds.
    """
    form = inverse(D) if form is None else form
    x, y = TURNS.real[:, None], TURNS.imag[:, None]
    along = x[..., None] * D.slope.real + y[..., None] * D.slope.imag
    d = x * D.centre.real + y * D.centre.imag - np.abs(along).sum(1) - D.rest
    d[len(TURNS) // 2] = np.maximum(d[len(TURNS) // 2], least)
    best = np.argmax(d, axis=0)
    d = d[best, np.arange(len(best))]
    half = np.where(d > 0.0, 0.5 / np.where(d > 0.0, d, 1.0), np.inf) * (1.0 + 1e-15)
    centre, radius = form.centre, form.reach + form.rest
    size = N.middle
    spread = N.reach + N.rest
    outer = size * radius + spread * (np.abs(centre) + radius)
    along = N.slope / np.where(size == 0.0, 1.0, N.centre)
    longer, aside = (np.abs(part).sum(0) + N.rest / size for part in (along.real, along.imag))
    grown = np.hypot(1.0 + longer, aside)
    bent = np.where(longer < 1.0, aside / np.where(longer < 1.0, 1.0 - longer, 1.0), np.inf)
    touching = size * half * grown * (1.0 + bent)
    chosen = ~(outer <= touching)
    edge = N.centre * TURNS[best].conj() * half * grown
    moves = D.reaches / np.where(chosen, d, D.middle) + np.abs(along)
    middle, radius = np.where(chosen, edge, N.centre * centre), np.where(chosen, touching, outer)
    plain = 2.0 * N.size * half
    middle, radius = np.where(plain < radius, 0.0, middle), np.fmin(plain, radius)
    # where nothing is bounded the relative ones say what to divide
    return middle, radius, moves * np.where(np.isinf(radius), 1.0, np.abs(middle) + radius)
