"""Stationary covariances of a function and of its gradient.

Both kernels are radial, k(x, x') = σ² φ(s) with s = Σ_j ((x_j - x'_j) / l_j)², and
everything here is written in φ and its derivatives in s, which (unlike those in
the distance r = √s) are finite at zero distance as often as they are needed.

Source: Rasmussen & Williams, Gaussian Processes for Machine Learning (2006),
eq. 4.9 and 4.17 for the kernels, section 9.4 for observations of derivatives.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from surrogates.interface import Array

ROOT5 = 5.0**0.5
NO_NOISE: Array = np.empty(0)


class Kernel(StrEnum):
    """Covariance families: Matérn 5/2 (twice differentiable) and RBF (analytic)."""

    MATERN52 = "matern52"
    RBF = "rbf"


@dataclass(frozen=True)
class Hyperparameters:
    """What the likelihood determines, in the scaled units of the unit box.

    Parameters
    ----------
    length_scales : array (d,)
        Fractions of the box.
    signal_variance, noise_variance : float
        In units of the sample variance of the output.
    gradient_noise_variance : float
        The same per box width squared.
    """

    length_scales: Array
    signal_variance: float
    noise_variance: float
    gradient_noise_variance: float = 0.0


def radial(kernel: Kernel, s: Array, order: int) -> list[Array]:
    """Return [φ, φ', ..., φ^(order)](s), order <= 3, for squared distances s >= 0.

    Matérn 5/2: φ = (1 + √5 r + 5/3 r²) e^(-√5 r); RBF: φ = e^(-s/2). The third
    derivative of the Matérn kernel grows as 1/r; it only ever appears times terms
    of order r⁴ and is returned as 0 at r = 0, the limit of those products.
    """
    if kernel is Kernel.RBF:
        e = np.exp(-0.5 * s)
        return [e, -0.5 * e, 0.25 * e, -0.125 * e][: order + 1]
    r = np.sqrt(s)
    e = np.exp(-ROOT5 * r)
    derivatives = [(1.0 + ROOT5 * r + (5.0 / 3.0) * s) * e]
    if order >= 1:
        derivatives.append((-5.0 / 6.0) * (1.0 + ROOT5 * r) * e)
    if order >= 2:
        derivatives.append((25.0 / 12.0) * e)
    if order >= 3:
        inverse = np.divide(1.0, r, out=np.zeros_like(r), where=r > 0.0)
        derivatives.append((-25.0 * ROOT5 / 24.0) * e * inverse)
    return derivatives


def separations(A: Array, B: Array, length_scales: Array) -> Array:
    """Return z (d, a, b) with z_j = (A_j - B_j) / l_j for points A (a, d), B (b, d).

    Differences are taken before squaring: |a|² + |b|² - 2ab would lose the distance
    of close points, where the interpolation happens.
    """
    return (A.T[:, :, None] - B.T[:, None, :]) / length_scales[:, None, None]


def covariance(
    kernel: Kernel,
    A: Array,
    B: Array,
    length_scales: Array,
    *,
    gradients_of_a: bool = False,
    gradients_of_b: bool = False,
) -> Array:
    """Return the covariance at σ² = 1 of values, and gradients if asked, at A and B.

    With z = (a - b) / lengths the blocks are
    cov(f_a, f_b) = φ, cov(f_a, ∂_j f_b) = -2 z_j φ' / l_j,
    cov(∂_i f_a, f_b) = 2 z_i φ' / l_i,
    cov(∂_i f_a, ∂_j f_b) = -(2 δ_ij φ' + 4 z_i z_j φ'') / (l_i l_j).
    Rows and columns are ordered by component: all values, all ∂_1, all ∂_2, ...
    Shape (a or a (1 + d), b or b (1 + d)).
    """
    z = separations(A, B, length_scales)
    phi = radial(kernel, np.einsum("jab,jab->ab", z, z), int(gradients_of_a) + int(gradients_of_b))
    return blocks(z, phi, length_scales, gradients_of_a, gradients_of_b)


def blocks(
    z: Array, phi: list[Array], length_scales: Array, rows: bool = True, columns: bool = True
) -> Array:
    """Assemble the blocks of `covariance` from separations and radial derivatives."""
    d, a, b = z.shape
    K = np.empty((1 + d * rows, a, 1 + d * columns, b))
    K[0, :, 0] = phi[0]
    for i in range(d):
        slope = 2.0 * z[i] / length_scales[i]
        if columns:
            K[0, :, 1 + i] = -slope * phi[1]
        if rows:
            K[1 + i, :, 0] = slope * phi[1]
        if rows and columns:
            for j in range(d):
                K[1 + i, :, 1 + j] = (-2.0 / length_scales[j]) * slope * z[j] * phi[2]
            K[1 + i, :, 1 + i] -= (2.0 / length_scales[i] ** 2) * phi[1]
    return K.reshape((1 + d * rows) * a, (1 + d * columns) * b)


def observed_covariance(
    C: Array, n: int, parameters: Hyperparameters, jitter: float, sample_noise: Array = NO_NOISE
) -> Array:
    """Return K = σ² C + jitter diag(σ² C) + noise of the observations of n samples.

    C is their `covariance`; `sample_noise` (n,), or (0,) for none, are variances that add to the
    common noise. The jitter is relative to the prior variance of each observation, so that it
    treats values and gradients, whatever their units, alike.
    """
    K = parameters.signal_variance * C
    diagonal = np.einsum("ii->i", K)
    diagonal *= 1.0 + jitter
    diagonal[:n] += parameters.noise_variance
    if sample_noise.size:
        diagonal[:n] += sample_noise
    diagonal[n:] += parameters.gradient_noise_variance
    return K
