"""The difference equation that is deployed, channel by channel, with back-calculation while it
saturates."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg import block_diag, lstsq, null_space, schur, solve_discrete_are, solve_sylvester

from ccd_casadi.analysis.loop_channels import LoopChannel
from ccd_casadi.deployment.integer_equation import FixedPoint
from ccd_casadi.lti.state_space import StateSpace, balance_system
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError


def assemble(channels: Sequence[LoopChannel], controllers: Sequence[StateSpace]) -> StateSpace:
    """K = Σ V_i K_i U_iᵀ, its states one channel after the other."""
    pairs = list(zip(channels, controllers, strict=True))
    return StateSpace(
        block_diag(*(K.A for _, K in pairs)),
        np.vstack([K.B @ c.outputs.T for c, K in pairs]),
        np.hstack([c.inputs @ K.C for c, K in pairs]),
        np.sum([c.inputs @ K.D @ c.outputs.T for c, K in pairs], axis=0),
    )


@dataclass(frozen=True)
class Realisation:
    """A controller x_{k+1} = A x_k + B e_k, u_k = C x_k + D e_k as its code computes it.

    Attributes
    ----------
    system : StateSpace
        SI; A is block-diagonal.
    blocks : tuple of int
        Sizes of the blocks.
    saturation : float or None
        N: every u is clipped to ± it, and the states are corrected by what was cut off,
        + L (u_k - v_k).
    back_calculation : array (n, m) or None
        L (`anti_windup`).
    single : bool
        The code computes with numbers of 24 bits, and the coefficients are such (`in_single`).
    fixed : FixedPoint or None
        It computes with these integers, and the coefficients are theirs (`fixed_point.in_fixed`).
    """

    system: StateSpace
    blocks: tuple[int, ...]
    saturation: float | None = None
    back_calculation: Array | None = None
    single: bool = False
    fixed: FixedPoint | None = None

    @property
    def precision(self) -> str:
        """The arithmetic of the code, in words."""
        if self.fixed is not None:
            return f"fixed {self.fixed.bits}"
        return "single" if self.single else "double"

    @property
    def number(self) -> type[np.floating[Any]]:
        """The floating-point type of the code."""
        return np.float32 if self.single else np.float64

    @property
    def block_entries(self) -> Array:
        """The diagonal blocks of A, each row by row, one after the other."""
        ends = pairwise(np.cumsum([0, *self.blocks]))
        return np.concatenate([np.zeros(0), *(self.system.A[i:j, i:j].ravel() for i, j in ends)])

    @property
    def as_coded(self) -> StateSpace:
        """The controller of the coefficients that the code has: nothing of A but its blocks."""
        inside = block_diag(*(np.ones((size, size)) for size in self.blocks))
        return replace(self.system, A=self.system.A * (inside if self.blocks else 1.0))


def in_single(realisation: Realisation) -> Realisation:
    """The same in single precision: every coefficient is the nearest number of 24 bits, in a
    double. What is judged from here on has these.
    """

    def rounded(M: Array) -> Array:
        return np.asarray(M, np.float32).astype(float)

    K, L, limit = realisation.system, realisation.back_calculation, realisation.saturation
    return replace(
        realisation,
        system=replace(K, A=rounded(K.A), B=rounded(K.B), C=rounded(K.C), D=rounded(K.D)),
        back_calculation=None if L is None else rounded(L),
        saturation=None if limit is None else float(np.float32(limit)),
        single=True,
    )


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


def realise_blocks(K: StateSpace) -> Realisation:
    """A controller in discrete time as the code has it.

    Parameters
    ----------
    K : StateSpace
        K(z), SI.

    Returns
    -------
    Realisation
        Without saturation.
    """
    system, blocks = block_diagonal(K)
    return Realisation(replace(system, period=K.period), tuple(blocks))


def block_diagonal(K: StateSpace) -> tuple[StateSpace, list[int]]:
    """K with A block-diagonal, and the sizes of its blocks.

    From balanced coordinates: a Schur form errs by eps ‖A‖, which moves light poles of a large A.
    """
    if not len(K.A):
        return StateSpace(K.A, K.B, K.C, K.D), []
    A, B, C = balance_system(K.A, K.B, K.C)
    A, T, sizes = _decouple(A)
    B, C = np.asarray(np.linalg.solve(T, B), float), C @ T
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


def _decouple(A: Array, condition: float = 1e4) -> tuple[Array, Array, list[int]]:
    """T⁻¹ A T, T and the sizes of its diagonal blocks: Bavely and Stewart's method (1979).

    Of the real Schur form block after block is split off by a Sylvester equation, and grows by the
    next one where T, its columns of unit length, would exceed a condition.
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
            if not (np.isfinite(unit).all() and np.linalg.cond(unit) <= condition):
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
    bit by bit. Of integers e, f, `start` and u are counts.
    """
    fixed = realisation.fixed
    if fixed is not None:
        X = [0] * len(fixed.states) if start is None else [int(x) for x in start]
        ahead = np.zeros((len(errors), len(fixed.forces))) if forward is None else forward
        found = []
        for e, f in zip(np.asarray(errors, int).tolist(), np.asarray(ahead, int).tolist(),
                        strict=True):  # fmt: skip
            counts, X, _ = fixed.step(X, e, f)
            found.append(counts)
        return np.array(found)
    K, given = realisation.system, realisation.back_calculation
    A, B, C, D = (numbers(realisation, part) for part in (K.A, K.B, K.C, K.D))
    (x,) = numbers(realisation, np.array([np.zeros(len(A)) if start is None else start]))
    limit = realisation.saturation
    L = None if given is None else numbers(realisation, given)
    ahead = np.zeros((len(errors), len(C))) if forward is None else forward
    answers = []
    every = zip(numbers(realisation, errors), numbers(realisation, ahead), strict=True)
    for e, f in every:
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


def numbers(realisation: Realisation, M: Array) -> list[list[float]]:
    """The rows of a matrix as scalars of the code's precision, with which sums stay in it."""
    own = np.asarray(M, realisation.number)
    return [list(row) for row in own] if realisation.single else own.tolist()


def dot(gains: Sequence[float], values: Sequence[float], total: float = 0.0) -> float:
    """The sum of products as the C code forms it, term after term: Python's `sum` compensates."""
    for gain, value in zip(gains, values, strict=True):
        total += gain * value
    return total


def literal(value: float) -> str:
    """Write a number as a literal that C and IEC 61131 read back exactly.

    Parameters
    ----------
    value : float

    Returns
    -------
    str
        Of 17 digits, with a point before the exponent, as IEC wants it.

    >>> literal(1e-5), literal(3.0), literal(0.1)
    ('1.0000000000000001e-05', '3.0', '0.10000000000000001')
    """
    mantissa, e, exponent = f"{value:.17g}".partition("e")
    return (mantissa if "." in mantissa else mantissa + ".0") + e + exponent


def literals(values: Array, indent: int) -> str:
    """Write numbers as literals, four in a line.

    Parameters
    ----------
    values : array
    indent : int
        Spaces before every line but the first.

    Returns
    -------
    str
    """
    texts = [literal(value) for value in np.ravel(values)] or ["0.0"]
    lines = [", ".join(texts[i : i + 4]) for i in range(0, len(texts), 4)]
    return (",\n" + " " * indent).join(lines)


def plain_title(title: str) -> str:
    """Keep only letters that no comment of a program ends at."""
    return "".join(c if c.isalnum() or c in " ._-" else "_" for c in title)


def with_anti_windup(realisation: Realisation, bandwidth: float) -> Realisation:
    """The same with back-calculation where it has a saturation; ω_b in rad/s."""
    if realisation.saturation is None:
        return realisation
    L = back_calculation(realisation.system, realisation.saturation, bandwidth)
    return replace(realisation, back_calculation=L)


def back_calculation(
    K: StateSpace, limit: float, bandwidth: float, trusts: Sequence[float] = (0.1, 0.01, 1.0)
) -> Array:
    """L (n, m) for a limit in N and ω_b in rad/s; raises UserError where K has no such gain.

    `trusts`: error of the force, as the filter sees it, over the limit. On rigid stages with PID
    0.01 to 0.1 settle alike and sooner than 1; later ones are tried where the Riccati equation of
    those before fails.
    """
    n, m = K.B.shape[0], K.C.shape[0]
    if not n:
        return np.zeros((0, m))
    gain = np.abs(K.response(np.array([bandwidth]))[0]).max()
    noise = K.B / gain  # in units of the limit, as all forces here: L does not depend on it
    for trust in trusts:
        weight = trust**2 * np.eye(m)
        try:
            P = solve_discrete_are(K.A.T, (K.C / limit).T, noise @ noise.T, weight)
        except np.linalg.LinAlgError:
            continue
        spread = K.C @ P @ K.C.T / limit**2 + weight
        L = np.linalg.solve(spread, K.C @ P @ K.A.T).T / limit**2
        if np.abs(np.linalg.eigvals(K.A - L @ K.C)).max() < 1.0:
            return np.asarray(L)
    if np.abs(np.linalg.eigvals(K.A)).max() < 1.0:
        return np.zeros((n, m))  # its states need no help to come back
    raise UserError(
        "no anti-windup gain was found: the controller may have an unstable mode that its force "
        "does not show; deploy without --saturation"
    )


def takeover(K: StateSpace) -> Array:
    """X (n, p + m): the state [e₀; u₀] -> x₀ from which the first force is u₀ and least moves on.

    min ‖(A - I) x + B e‖ subject to C x = u - D e; where C has dependent rows (no state can make
    two forces apart) the force is met in the least squares.
    """
    n, p = K.B.shape
    m = len(K.C)
    if not n:
        return np.zeros((0, p + m))
    wanted = np.hstack([-K.D, np.eye(m)])  # C x for unit [e; u]
    particular = np.asarray(lstsq(K.C, wanted)[0])
    free = null_space(K.C)
    if not free.size:
        return particular
    moved = (K.A - np.eye(n)) @ particular + np.hstack([K.B, np.zeros((n, m))])
    return particular - free @ np.asarray(lstsq((K.A - np.eye(n)) @ free, moved)[0])
