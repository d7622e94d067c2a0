"""Complex affine forms over many boxes at once, rounded outwards, and modes that move with the
parameters as such forms."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from operator import add, mul, neg
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class Affine:
    """An affine form f = centre + Σ slope_i t_i + δ, |t_i| <= 1, |δ| <= rest, on each of N boxes.

    Attributes
    ----------
    centre, rest : array (N,)
        `rest` is infinite where nothing holds.
    slope : array (n, N)
        Of n variables.
    rounding : float
        Relative: eight times what a product of complex numbers loses.
    """

    rounding: ClassVar[float] = 2e-15
    centre: np.ndarray
    slope: np.ndarray
    rest: Array

    @cached_property
    def middle(self) -> Array:
        """The sizes |centre|."""
        return np.asarray(np.abs(self.centre))

    @cached_property
    def reaches(self) -> Array:
        """The sizes |slope| (n, N)."""
        return np.asarray(np.abs(self.slope))

    @cached_property
    def reach(self) -> Array:
        """The largest distance of the linear part from the centre."""
        return np.asarray(self.reaches.sum(0))

    @cached_property
    def size(self) -> Array:
        """Not below |f| anywhere."""
        return np.asarray(self.middle + self.reach + self.rest)

    @cached_property
    def lowest(self) -> Array:
        """Not above |f| anywhere; 0 where the enclosure touches 0."""
        size = self.middle
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (self.slope * (self.centre.conj() / size)).real
        found = size - np.abs(along).sum(0) - self.rest
        return np.asarray(np.where(found > 0.0, found * (1.0 - self.rounding), 0.0))

    def __add__(self, other: "Affine | complex | np.ndarray") -> "Affine":
        if isinstance(other, Affine):
            self._same_variables(other)
            rest = self.rest + other.rest + self.rounding * (self.size + other.size)
            return Affine(self.centre + other.centre, self.slope + other.slope, rest)
        size = self.middle + np.abs(other)
        return Affine(self.centre + other, self.slope, self.rest + self.rounding * size)

    def __neg__(self) -> "Affine":
        return Affine(-self.centre, -self.slope, self.rest)

    def __sub__(self, other: "Affine | complex | np.ndarray") -> "Affine":
        return self + (-other)

    def __mul__(self, other: "Affine | complex | np.ndarray") -> "Affine":
        if not isinstance(other, Affine):
            rest = (self.rest + self.rounding * self.size) * np.abs(other)
            return Affine(self.centre * other, self.slope * other, rest)
        self._same_variables(other)
        a, b = self.middle + self.reach, other.middle + other.reach
        # t_i² lies in [0, 1]: half of it goes to the centre.
        rest = self.reach * other.reach - 0.5 * (self.reaches * other.reaches).sum(0)
        rest += self.rest * b + other.rest * a + self.rest * other.rest + self.rounding * a * b
        centre = self.centre * other.centre + 0.5 * (self.slope * other.slope).sum(0)
        slope = self.centre * other.slope + other.centre * self.slope
        return Affine(centre, slope, np.where(np.isnan(rest), np.inf, rest))

    __radd__ = __add__
    __rmul__ = __mul__

    def _same_variables(self, other: "Affine") -> None:
        """NumPy would spread the slope of a single variable over all of the other's."""
        if len(self.slope) != len(other.slope):
            raise ValueError(f"{len(self.slope)} and {len(other.slope)} variables: use `of`")

    def of(self, variables: int, first: int = 0) -> "Affine":
        """The same of more variables, of which those from `first` on are its own."""
        slope = np.zeros((variables, *self.slope.shape[1:]), self.slope.dtype)
        slope[first : first + len(self.slope)] = self.slope
        return Affine(self.centre, slope, self.rest)


def product(how: str, f: Affine, g: Affine) -> Affine:
    """Sums of products of two arrays of forms, as `einsum` takes them."""
    of = partial(np.einsum, how)
    slope = [of(a, g.centre) + of(f.centre, b) for a, b in zip(f.slope, g.slope, strict=True)]
    rest = of(f.reach, g.reach) + of(f.rest, g.size) + of(np.abs(f.centre) + f.reach, g.rest)
    rest += f.rounding * g.centre.shape[1] * of(f.size, g.size)
    return Affine(of(f.centre, g.centre), np.array(slope), rest)


def variable(low: Array, high: Array, index: int, variables: int) -> Affine:
    """Make the form of a variable itself, c + h t with |t| <= 1, between its ends.

    Parameters
    ----------
    low, high : array (N,)
        Ends on N boxes.
    index, variables : int
        Which of how many variables it is.

    Returns
    -------
    Affine
    """
    centre = 0.5 * (low + high)
    half = np.maximum(high - centre, centre - low)
    slope = np.zeros((variables, len(low)))
    slope[index] = half
    return Affine(centre, slope, np.zeros(len(low)))


def inverse(f: Affine) -> Affine:
    """Invert a form: 1/(c + δ) = 1/c - δ/c² + δ²/(c²(c + δ)).

    Parameters
    ----------
    f : Affine
        c + δ.

    Returns
    -------
    Affine
        Its rest is infinite where f may be 0.
    """
    size, low = f.middle, f.lowest
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = 1.0 / f.centre
        deviation = f.reach + f.rest
        rest = (f.rest + deviation**2 / low) / size**2
        rest += f.rounding * (1.0 + deviation / size) / size
        slope = -f.slope * centre**2
    good = (low > 0.0) & np.isfinite(rest)
    return Affine(np.where(good, centre, 0.0), np.where(good, slope, 0.0),
                  np.where(good, rest, np.inf))  # fmt: skip


def exponential(f: Affine) -> Affine:
    """Exponentiate a form: |e^δ - 1 - δ| <= |δ|²/2 e^|δ|.

    Parameters
    ----------
    f : Affine
        c + δ.

    Returns
    -------
    Affine
    """
    value = np.exp(f.centre)
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = f.reach + f.rest
        rest = f.rest + 0.5 * deviation**2 * np.exp(deviation)
        rest = np.abs(value) * (rest + f.rounding * (1.0 + np.abs(f.centre) + f.reach))
    return Affine(value, value * f.slope, np.where(np.isnan(rest), np.inf, rest))


def root(f: Affine) -> Affine:
    """√f of a real form that stays above 0; the second derivative is at most ¼ low^{-3/2}."""
    low = f.centre.real - np.abs(f.slope.real).sum(0) - f.rest
    good = low > 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.sqrt(f.centre.real)
        deviation = f.reach + f.rest
        rest = 0.5 * f.rest / value + deviation**2 / (8.0 * low**1.5)
        rest += f.rounding * (value + deviation / value)
        slope = 0.5 * f.slope / value
    return Affine(np.where(good, value, 1.0), np.where(good, slope, 0.0),
                  np.where(good, rest, np.inf))  # fmt: skip


def sine(f: Affine) -> Affine:
    """Enclose the sine of a real form."""
    turned = exponential(f * 1j)
    return Affine(turned.centre.imag, turned.slope.imag, turned.rest)


OPERATIONS: dict[int, Callable[..., Any]] = {
    ca.OP_ADD: add,
    ca.OP_SUB: lambda f, g: f + -g,
    ca.OP_MUL: mul,
    ca.OP_DIV: lambda f, g: f * (inverse(g) if isinstance(g, Affine) else 1.0 / g),
    ca.OP_NEG: neg,
    ca.OP_TWICE: lambda f: f * 2.0,
    ca.OP_SQ: lambda f: f * f,
    ca.OP_INV: inverse,
    ca.OP_SQRT: root,
    ca.OP_EXP: exponential,
    ca.OP_SIN: sine,
    ca.OP_COS: lambda f: sine(f + 0.5 * np.pi),
}


def outputs(graph: ca.Function, x: list[Affine]) -> list[Affine]:
    """The dense outputs (N, rows, columns) of a graph of scalars at x (N,), the entries of its
    input, operation by operation; nan where one is not of `OPERATIONS`."""
    work: dict[int, Any] = {}
    shapes = [(len(x[0].rest), *graph.size_out(i)) for i in range(graph.n_out())]
    found = [Affine(np.zeros(s), np.zeros((len(x), *s)), np.zeros(s)) for s in shapes]
    for k in range(graph.n_instructions()):
        kind, (to, *place) = graph.instruction_id(k), graph.instruction_output(k)
        if kind == ca.OP_INPUT:
            work[to] = x[graph.instruction_input(k)[1]]
        elif kind == ca.OP_CONST:
            work[to] = graph.instruction_constant(k)
        elif kind == ca.OP_OUTPUT:
            value = work[graph.instruction_input(k)[0]]
            column, row = divmod(place[0], shapes[to][1])
            for part, default in (("centre", value), ("slope", 0.0), ("rest", 0.0)):
                getattr(found[to], part)[..., row, column] = getattr(value, part, default)
        else:
            values = (work[i] for i in graph.instruction_input(k))
            work[to] = OPERATIONS.get(kind, lambda *_: np.nan)(*values)
    return found


@dataclass(frozen=True)
class ModeEnclosureOptions:
    """Numbers of the enclosure of modes that move with the parameters."""

    rigid: float = 1e-10  # λ over the largest, up to which a mode counts as one without stiffness
    steps: int = 12  # of the search for discs that are mapped into themselves
    inflation: float = 1.1  # of the discs of the step before
    singular: float = 1e-14  # least eigenvalue of a mass matrix over its largest, to be inverted


@np.errstate(all="ignore")  # of pieces that are too wide
def moving_modes(
    graph: ca.Function, rigid: int, unit: float, low: Array, high: Array,
    options: ModeEnclosureOptions = ModeEnclosureOptions(),
) -> tuple[list[list[Affine]], np.ndarray]:  # fmt: skip
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
    known &= spectrum[:, 0] > options.singular * spectrum[:, -1]
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
    for _ in range(options.steps):
        held, within = options.inflation * rho, options.inflation * m
        top, gap = (size + within)[:, None, :], np.abs(away) - within[:, None, :]
        moved = E.size + F.size * top + E.size @ held + (F.size @ held) * top
        rho, m = np.where(gap > 0.0, moved / gap, np.inf), moved[:, own, own]
    known &= (rho <= held).all(axis=(1, 2)) & (m <= within).all(axis=1)
    known &= ((lam + m)[:, :-1] < (lam - m)[:, 1:]).all(axis=1)
    top, gap = (size + m)[:, None, :], np.abs(away) - m[:, None, :]
    A = E + F * -lam[:, None, :]
    second = A.rest + F.size * m[:, None, :] + E.size @ rho + (F.size @ rho) * top
    bending = A.reach * m[:, None, :] / np.abs(away)
    vectors = Affine(shapes * 0.0 + eye, -A.slope / away, (second + bending) / gap)
    read, drive = (product("Npk,Nki->Ni", product(how, f, modes), vectors)
                   for how, f in (("Npk,Nki->Npi", c), ("Nkp,Nki->Npi", b)))  # fmt: skip
    length = product("Nki,Nki->Ni", vectors, product("Njk,Nki->Nji", M, vectors))
    value = Affine(lam, A.slope[..., own, own], second[:, own, own])
    least, most = 2.0 * size - value.size, value.size
    lowest = most[:, :rigid].max(axis=1, initial=0.0, keepdims=True)
    apart = np.where(own < rigid, most <= options.rigid * least[:, -1:], least > lowest)
    forms = root(value) * (1.0 / unit), read * drive * inverse(length) * unit**-2
    of_mode = [[Affine(f.centre[back, i], f.slope[:, back, i], f.rest[back, i]) for f in forms]
               for i in range(n)]  # fmt: skip
    return of_mode, (known & apart.all(axis=1))[back]
