"""The CasADi expressions of the surrogates that are no exact Gaussian process."""

import casadi as ca
import numpy as np
from scipy.linalg import solve_triangular

from surrogates.casadi_export import (
    expression,
    flat_mean,
    legendre_products,
    products_of,
    radial_expression,
    squared_distances,
)
from surrogates.casadi_export import to_casadi as to_casadi
from surrogates.flat_limit import UNDER_ROOT
from surrogates.interface import Surrogate, no_deviation
from surrogates.maximum import Maximum
from surrogates.network import Network
from surrogates.polynomial import Polynomial, total_degree
from surrogates.radial_basis import DEGREES, Basis, RadialBasis
from surrogates.sparse_process import RESOLUTION, SparseProcess
from surrogates.transform import Exponential


def _unit(surrogate: Surrogate, x: ca.MX) -> ca.MX:
    return (x - ca.DM(surrogate.lower)) / ca.DM(surrogate.upper - surrogate.lower)


@expression.register
def _(polynomial: Polynomial, x: ca.MX, std: bool) -> tuple[ca.MX, ...]:
    v = 2.0 * _unit(polynomial, x) - 1.0
    phi = legendre_products(polynomial.exponents, v)
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
    tail = products_of(total_degree(d, degree), powers)
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
    unit = _unit(process, x)
    _, s = squared_distances(unit, process.inducing, p.length_scales)
    phi = radial_expression(process.kernel, s, 0)[0]
    if process.flat is not None:
        total = flat_mean(process.flat, unit)
    else:
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


@expression.register
def _(surrogate: Maximum, x: ca.MX, std: bool) -> tuple[ca.MX, ...]:
    best = expression(surrogate.pieces[0], x, std)
    for piece in surrogate.pieces[1:]:
        other = expression(piece, x, std)
        larger = other[0] > best[0]
        best = tuple(ca.if_else(larger, b, a) for a, b in zip(best, other, strict=True))
    return best
