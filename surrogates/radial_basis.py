"""Radial basis functions with a polynomial: what `scipy.interpolate.RBFInterpolator` fits.

The system is SciPy's (its kernels, signs and polynomial degrees); it is solved here
because leave-one-out needs its inverse, and a file needs its coefficients, neither of
which SciPy hands out. Thin plates are left out: their second derivative is infinite at
the samples, where an optimiser with exact Hessians stops.

Source: Fasshauer, Meshfree Approximation Methods with MATLAB (2007); Rippa, Advances in
Computational Mathematics 11 (1999), for leave-one-out in closed form.
"""

from dataclasses import dataclass
from enum import StrEnum
from math import comb
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from surrogates.covariance import separations
from surrogates.interface import (
    Array,
    Errors,
    SurrogateFitError,
    box,
    freeze,
    no_deviation,
    points_in,
)
from surrogates.polynomial import total_degree
from surrogates.samples import Samples
from surrogates.validation import errors

# Samples that enter the choice of kernel and smoothing, which cost O(n³) each, and
# samples that a dense system holds.
CHOICE_ORDER = 600
DENSE_LIMIT = 5000
SMOOTHINGS = (0.0, 1e-8, 1e-6, 1e-4, 1e-2)
NOISE_SCALES = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0)
SHAPES = (0.5, 1.0, 2.0, 4.0)
# Share of the output's deviation that rounding may cost: flat kernels interpolate by
# cancellation, and beyond this two machines would not agree on the value.
ROUNDING = 1e-10


class Basis(StrEnum):
    """SciPy's names of the kernels that are at least twice differentiable."""

    CUBIC = "cubic"
    QUINTIC = "quintic"
    MULTIQUADRIC = "multiquadric"
    GAUSSIAN = "gaussian"


# Degree of the polynomial beside the kernel, as RBFInterpolator takes it by default.
DEGREES = {Basis.CUBIC: 1, Basis.QUINTIC: 2, Basis.MULTIQUADRIC: 0, Basis.GAUSSIAN: 0}


@dataclass(frozen=True, eq=False)
class RadialBasis:
    """Radial functions at the samples and a polynomial, x̂ = (x - lower) / (upper - lower).

    value(x) = mean + scale (Σ_i weights_i φ(‖x̂ - x̂_i‖) + Σ_k tail_k q_k(x̂)), q the
    monomials of 2 x̂ - 1 up to the kernel's degree; φ of `radial`.

    X (n, d): the samples in the unit box. weights (n,), tail (m,). smoothing: the
    largest entry added to the kernel's diagonal. left_out (n,), loo: output units.
    """

    basis: Basis
    epsilon: float
    smoothing: float
    lower: Array
    upper: Array
    output_mean: float
    output_scale: float
    X: Array
    weights: Array
    tail: Array
    left_out: Array
    loo: Errors

    def __post_init__(self) -> None:
        d = box(self.lower, self.upper)[0].size
        p = DEGREES[self.basis]
        if self.X.shape != (self.weights.size, d) or self.tail.shape != (comb(d + p, p),):
            raise ValueError(f"weights and tail do not fit {len(self.X)} samples of {d} inputs")
        freeze(self.lower, self.upper, self.X, self.weights, self.tail, self.left_out)

    @property
    def has_std(self) -> bool:
        """An interpolant alone does not know how wrong it is."""
        return False

    @overload
    def predict(self, X: ArrayLike, return_std: Literal[False] = False) -> Array: ...
    @overload
    def predict(self, X: ArrayLike, return_std: Literal[True]) -> tuple[Array, Array]: ...
    def predict(self, X: ArrayLike, return_std: bool = False) -> Array | tuple[Array, Array]:
        """Return the value (m,) at X (m, d).

        Raises:
            ValueError: the deviation is asked for, which there is none of.
        """
        if return_std:
            raise no_deviation("radial basis function")
        unit = (points_in(self, X) - self.lower) / (self.upper - self.lower)
        z = separations(unit, self.X, np.ones(self.lower.size))
        phi = radial(self.basis, self.epsilon, np.einsum("jab,jab->ab", z, z))
        tail = monomials(unit, DEGREES[self.basis]) @ self.tail
        return self.output_mean + self.output_scale * (phi @ self.weights + tail)


def radial(basis: Basis, epsilon: float, s: Array) -> Array:
    """Return φ at squared distances s: r³, -r⁵, -√(1 + ε²s) or e^(-ε²s), SciPy's signs."""
    match basis:
        case Basis.CUBIC:
            return s * np.sqrt(s)
        case Basis.QUINTIC:
            return -(s**2) * np.sqrt(s)
        case Basis.MULTIQUADRIC:
            return -np.sqrt(1.0 + epsilon**2 * s)
        case Basis.GAUSSIAN:
            return np.exp(-(epsilon**2) * s)


def monomials(unit: Array, degree: int) -> Array:
    """Return the monomials (n, m) of 2 x̂ - 1 up to a total degree at x̂ (n, d)."""
    powers = total_degree(unit.shape[1], degree)
    return np.prod((2.0 * unit - 1.0)[:, None, :] ** powers, axis=2)


def fit_radial_basis(
    samples: Samples,
    basis: Basis | str | None = None,
    epsilon: float | None = None,
    smoothing: float | None = None,
) -> RadialBasis:
    """Return the radial basis functions of least error left out, over what is None.

    `smoothing` is added to the diagonal of the kernel matrix as by SciPy; where the
    noise is known it is spread over the samples as their noise variances are.

    Raises:
        SurrogateFitError: gradients are given, too many samples, or none of the systems
            can be solved.
    """
    if samples.dY is not None:
        raise SurrogateFitError(
            "radial basis functions take no gradients: leave dY out, or use "
            "kind='gaussian_process' or 'polynomial'"
        )
    n = len(samples.X)
    if n > DENSE_LIMIT:
        raise SurrogateFitError(
            f"{n} samples are more than the {DENSE_LIMIT} radial basis functions hold: "
            "use kind='polynomial', or fewer samples"
        )
    choices = _choices(samples, basis, epsilon, smoothing)
    if len(choices) > 1:
        few = samples.rows(np.linspace(0, n - 1, min(n, CHOICE_ORDER)).astype(int))
        found = [(choice, _solve(few, *choice)) for choice in choices]
        ranked = sorted(
            (f.loo.rms, i, choice) for i, (choice, f) in enumerate(found) if f is not None
        )
        choices = [choice for *_, choice in ranked]
    for choice in choices:
        solved = _solve(samples, *choice)
        if solved is not None:
            return solved
    raise SurrogateFitError(
        f"{n} samples of {samples.lower.size} inputs do not settle radial basis functions: "
        "take more samples, remove repeated ones, or give their noise"
    )


def _choices(
    samples: Samples, basis: Basis | str | None, epsilon: float | None, smoothing: float | None
) -> list[tuple[Basis, float, float]]:
    shapes = SHAPES if epsilon is None else (epsilon,)
    if smoothing is not None:
        smoothings: tuple[float, ...] = (smoothing,)
    elif samples.noise is None:
        smoothings = SMOOTHINGS
    else:
        largest = float(samples.noise_variances.max())
        smoothings = tuple(scale * largest for scale in NOISE_SCALES) if largest else (0.0,)
    return [
        (family, shape, amount)
        for family in (list(Basis) if basis is None else [Basis(basis)])
        # r³ and r⁵ have no shape: another ε is another factor in the weights.
        for shape in (shapes if DEGREES[family] == 0 else (1.0,))
        for amount in smoothings
    ]


def _solve(samples: Samples, basis: Basis, epsilon: float, smoothing: float) -> RadialBasis | None:
    """Solve [Φ + Λ, Q; Qᵀ, 0] [weights; tail] = [y; 0], or None if that is singular."""
    unit, targets = samples.unit, samples.targets
    n, d = unit.shape
    Q = monomials(unit, DEGREES[basis])
    m = Q.shape[1]
    if m > n:
        return None
    z = separations(unit, unit, np.ones(d))
    system = np.zeros((n + m, n + m))
    system[:n, :n] = radial(basis, epsilon, np.einsum("jab,jab->ab", z, z))
    largest = np.abs(system[:n, :n]).max()
    share = np.ones(n)
    if samples.noise is not None and samples.noise.max() > 0.0:
        share = samples.noise_variances / samples.noise_variances.max()
    system[np.arange(n), np.arange(n)] += smoothing * share
    system[:n, n:], system[n:, :n] = Q, Q.T
    try:
        inverse = np.linalg.inv(system)
        solution = np.linalg.solve(system, np.r_[targets, np.zeros(m)])
    except np.linalg.LinAlgError:
        return None
    own = np.diag(inverse)[:n]
    weights, tail = solution[:n], solution[n:]
    eps = float(np.finfo(float).eps)
    if not eps * largest * np.abs(weights).sum() < ROUNDING or (own == 0.0).any():
        return None
    mean, scale = samples.scaling
    left_out = scale * weights / own
    return RadialBasis(
        basis=basis,
        epsilon=epsilon,
        smoothing=smoothing,
        lower=samples.lower,
        upper=samples.upper,
        output_mean=mean,
        output_scale=scale,
        X=unit,
        weights=weights,
        tail=tail,
        left_out=left_out,
        loo=errors(left_out, samples.Y),
    )
