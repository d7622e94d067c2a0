"""The difference equation that is deployed: block-diagonal, its order of operations fixed.

Controller poles lie close to z = 1 at high sampling rates, where the coefficients of a companion
form, or of a long cascade, lose digits. Here A is block-diagonal: blocks of one real pole or one
complex pair, larger ones only where poles nearly coincide. Each pole then is as exact as its own
block's four numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag, schur, solve_sylvester

from ccd_casadi.deployment.channels import LoopChannel, assemble
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array

CONDITION = 1e4  # most of the block-diagonalising transformation, its columns of unit length


@dataclass(frozen=True)
class Realisation:
    """x_{k+1} = A x_k + B e_k, u_k = C x_k + D e_k in SI; A block-diagonal with these `blocks`.

    With a `saturation` in N every u is clipped to ± it, and the states are led back by what was
    cut off: + L (u_k - v_k), L = `back_calculation` (n, m) (`anti_windup`).
    """

    system: StateSpace
    blocks: tuple[int, ...]
    saturation: float | None = None
    back_calculation: Array | None = None

    @property
    def block_entries(self) -> Array:
        """The diagonal blocks of A, each row by row, one after the other."""
        ends = pairwise(np.cumsum([0, *self.blocks]))
        return np.concatenate([np.zeros(0), *(self.system.A[i:j, i:j].ravel() for i, j in ends)])

    @property
    def as_coded(self) -> StateSpace:
        """Of the coefficients that the code has: nothing of A but its blocks."""
        inside = block_diag(*(np.ones((size, size)) for size in self.blocks))
        return replace(self.system, A=self.system.A * (inside if self.blocks else 1.0))


def realise(
    channels: Sequence[LoopChannel],
    controllers: Sequence[StateSpace],
    saturation: float | None = None,
) -> Realisation:
    """The controllers of all channels as one block-diagonal system from e to u."""
    parts, blocks = [], []
    for controller in controllers:
        part, sizes = block_diagonal(controller)
        parts.append(part)
        blocks += sizes
    whole = assemble(channels, parts)
    system = replace(whole, period=controllers[0].period)
    return Realisation(system, tuple(blocks), saturation)


def realised(K: StateSpace) -> Realisation:
    """A controller in discrete time as the code has it."""
    system, blocks = block_diagonal(K)
    return Realisation(replace(system, period=K.period), tuple(blocks))


def block_diagonal(K: StateSpace) -> tuple[StateSpace, list[int]]:
    """K with A block-diagonal, and the sizes of its blocks."""
    if not len(K.A):
        return StateSpace(K.A, K.B, K.C, K.D), []
    A, T, sizes = _decoupled(K.A)
    B, C = np.asarray(np.linalg.solve(T, K.B), float), K.C @ T
    start = 0
    for size in sizes:
        states = slice(start, start + size)
        b, c = np.linalg.norm(B[states]), np.linalg.norm(C[:, states])
        if b > 0.0 and c > 0.0:  # states of like size on input and output
            B[states] *= np.sqrt(c / b)
            C[:, states] *= np.sqrt(b / c)
        A[states, :start] = A[states, start + size :] = 0.0
        start += size
    return StateSpace(A, B, C, K.D), sizes


def _decoupled(A: Array) -> tuple[Array, Array, list[int]]:
    """T⁻¹ A T, T and the sizes of its diagonal blocks: Bavely and Stewart's method (1979).

    Of the real Schur form block after block is split off by a Sylvester equation, and grows by the
    next one where T would exceed its condition.
    """
    S, T = schur(A, output="real")
    n, start = len(S), 0
    sizes: list[int] = []
    for end in (i for i in range(1, n + 1) if i == n or S[i, i - 1] == 0.0):
        here, rest = slice(start, end), slice(end, n)
        if end < n:
            split = T.copy()
            split[:, rest] += T[:, here] @ solve_sylvester(
                S[here, here], -S[rest, rest], -S[here, rest]
            )
            unit = split / np.linalg.norm(split, axis=0)
            if not (np.isfinite(unit).all() and np.linalg.cond(unit) <= CONDITION):
                continue
            S[here, rest], T = 0.0, split
        sizes.append(end - start)
        start = end
    return np.asarray(S, float), np.asarray(T, float), sizes


def difference_equation(
    realisation: Realisation,
    errors: Array,
    forward: Array | None = None,
    start: Sequence[float] | None = None,
) -> Array:
    """u_k (k, m) for errors e_k (k, p) and feedforward f_k (k, m), in the C code's own order.

    From the state `start`, else from rest. Sums start at zero and run over the states, then the
    inputs, then the feedforward, without fused operations: the result equals that of the C code
    bit by bit.
    """
    K = realisation.system
    A, B, C, D = (part.tolist() for part in (K.A, K.B, K.C, K.D))
    x = [0.0] * len(A) if start is None else list(start)
    limit = realisation.saturation
    L = None if realisation.back_calculation is None else realisation.back_calculation.tolist()
    ahead = np.zeros((len(errors), len(C))) if forward is None else np.asarray(forward, float)
    answers = []
    for e, f in zip(np.asarray(errors, float).tolist(), ahead.tolist(), strict=True):
        u, cut = [], []
        for row_c, row_d, extra in zip(C, D, f, strict=True):
            total = dot(row_d, e, dot(row_c, x)) + extra
            u.append(total if limit is None else min(max(total, -limit), limit))
            cut.append(u[-1] - total)
        following: list[float] = []
        for size in realisation.blocks:
            block = slice(len(following), len(following) + size)
            for i in range(block.start, block.stop):
                total = dot(B[i], e, dot(A[i][block], x[block]))
                following.append(total if L is None else dot(L[i], cut, total))
        x = following
        answers.append(u)
    return np.array(answers).reshape(len(answers), len(C))


def dot(gains: Sequence[float], values: Sequence[float], total: float = 0.0) -> float:
    """The sum of products as the C code forms it, term after term: Python's `sum` compensates."""
    for gain, value in zip(gains, values, strict=True):
        total += gain * value
    return total


def literal(value: float) -> str:
    """17 digits give every double back; a point before the exponent, as IEC's literals want it.

    >>> literal(1e-5), literal(3.0), literal(0.1)
    ('1.0000000000000001e-05', '3.0', '0.10000000000000001')
    """
    mantissa, e, exponent = f"{value:.17g}".partition("e")
    return (mantissa if "." in mantissa else mantissa + ".0") + e + exponent


def literals(values: Array, indent: int) -> str:
    """Four in a line, the lines after the first indented."""
    texts = [literal(value) for value in np.ravel(values)] or ["0.0"]
    lines = [", ".join(texts[i : i + 4]) for i in range(0, len(texts), 4)]
    return (",\n" + " " * indent).join(lines)


def plain_title(title: str) -> str:
    """Of letters that no comment of a program ends at."""
    return "".join(c if c.isalnum() or c in " ._-" else "_" for c in title)
