"""The CasADi expressions of the surrogates that are no exact Gaussian process."""

import casadi as ca
import numpy as np
from scipy.linalg import solve_triangular

from surrogates.casadi_export import expression, radial_expression, squared_distances
from surrogates.interface import Array, Surrogate, no_deviation
from surrogates.network import Network
from surrogates.polynomial import Polynomial, total_degree
from surrogates.radial_basis import DEGREES, Basis, RadialBasis
from surrogates.sparse_process import RESOLUTION, SparseProcess
from surrogates.transform import Exponential

# Added to s under the root of r³ and r⁵: AD then finds 0 · 1e15 and not 0 · inf at a
# sample, and the value changes by less than 1e-45.
UNDER_ROOT = 1e-30


def _unit(surrogate: Surrogate, x: ca.MX) -> ca.MX:
    return (x - ca.DM(surrogate.lower)) / ca.DM(surrogate.upper - surrogate.lower)


@expression.register
def _(polynomial: Polynomial, x: ca.MX, std: bool) -> tuple[ca.MX, ...]:
    v = 2.0 * _unit(polynomial, x) - 1.0
    powers = [ca.MX.ones(v.shape[0]), v]
    for k in range(1, polynomial.degree):
        powers.append(((2 * k + 1) * v * powers[k] - k * powers[k - 1]) / (k + 1))
    phi = _products(polynomial.exponents, powers)
    value = ca.dot(ca.DM(polynomial.coefficients), phi)
    if not std:
        return (value,)
    spread = ca.sumsqr(ca.mtimes(ca.DM(polynomial.root), phi))
    return value, ca.sqrt(polynomial.residual_variance * (1.0 + spread))


@expression.register
def _(surrogate: RadialBasis, x: ca.MX, std: bool) -> tuple[ca.MX, ...]:
    if std:
        raise no_deviation("radial basis function")
    unit = _unit(surrogate, x)
    d = surrogate.lower.size
    _, s = squared_distances(unit, surrogate.X, np.ones(d))
    match surrogate.basis:
        case Basis.CUBIC:
            phi = s * ca.sqrt(s + UNDER_ROOT)
        case Basis.QUINTIC:
            phi = -s * s * ca.sqrt(s + UNDER_ROOT)
        case Basis.MULTIQUADRIC:
            phi = -ca.sqrt(1.0 + surrogate.epsilon**2 * s)
        case Basis.GAUSSIAN:
            phi = ca.exp(-(surrogate.epsilon**2) * s)
    degree = DEGREES[surrogate.basis]
    v = 2.0 * unit - 1.0
    powers = [ca.MX.ones(d), v, v * v]
    tail = _products(total_degree(d, degree), powers)
    sum_ = ca.dot(ca.DM(surrogate.weights), phi) + ca.dot(ca.DM(surrogate.tail), tail)
    return (surrogate.output_mean + surrogate.output_scale * sum_,)


@expression.register
def _(network: Network, x: ca.MX, std: bool) -> tuple[ca.MX, ...]:
    if std:
        raise no_deviation("network")
    h = 2.0 * _unit(network, x) - 1.0
    last = len(network.matrices) - 1
    for k, (W, b) in enumerate(zip(network.matrices, network.biases, strict=True)):
        h = ca.mtimes(ca.DM(W.T), h) + ca.DM(b)
        h = ca.tanh(h) if k < last else h
    return (network.output_mean + network.output_scale * h,)


@expression.register
def _(process: SparseProcess, x: ca.MX, std: bool) -> tuple[ca.MX, ...]:
    p = process.hyperparameters
    _, s = squared_distances(_unit(process, x), process.inducing, p.length_scales)
    phi = radial_expression(process.kernel, s, 0)[0]
    total = p.signal_variance * ca.dot(ca.DM(process.weights), phi)
    mean = process.output_mean + process.output_scale * total
    if not std:
        return (mean,)
    L, B = process.factors
    first = p.signal_variance * solve_triangular(L, np.eye(len(L)), lower=True)
    v = ca.mtimes(ca.DM(first), phi)
    w = ca.mtimes(ca.DM(solve_triangular(B, np.eye(len(B)), lower=True)), v)
    variance = p.signal_variance - ca.sumsqr(v) + ca.sumsqr(w)
    floor = RESOLUTION * p.signal_variance
    return mean, process.output_scale * ca.sqrt(ca.fmax(variance, floor))


@expression.register
def _(surrogate: Exponential, x: ca.MX, std: bool) -> tuple[ca.MX, ...]:
    inside = expression(surrogate.logarithm, x, std)
    value = ca.exp(inside[0])
    return (value, value * inside[1]) if std else (value,)


def _products(exponents: Array, powers: list[ca.MX]) -> ca.MX:
    """Π_j powers_{e_ij}(j) as (m, 1), powers_k (d, 1): one gather to each factor.

    A term of total degree p has at most p factors that are not 1, so that p gathers
    make all terms at once; unrolled, 500 terms of 20 inputs would be 10⁴ nodes.
    """
    e = exponents.astype(int)
    d = e.shape[1]
    degree = int(e.sum(axis=1).max())
    stack = ca.vertcat(*powers)
    result = ca.MX.ones(len(e))
    table = np.zeros((len(e), max(degree, 1)), dtype=int)  # entry 0 of the stack is 1
    for i, row in enumerate(e):
        factors = [power * d + j for j, power in enumerate(row) if power]
        table[i, : len(factors)] = factors
    for column in table.T:
        if column.any():
            result = result * stack[column.tolist()]
    return result
