"""Kernels of Gaussian processes, and the marginal likelihood of values and gradients."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky
from scipy.linalg.lapack import dpotri

from surrogates.samples import Array, SurrogateFitError

ROOT5 = 5.0**0.5
NO_NOISE: Array = np.empty(0)


class Kernel(StrEnum):
    """Covariance families: Matérn 5/2 (twice differentiable) and RBF (analytic)."""

    MATERN52 = "matern52"
    RBF = "rbf"


@dataclass(frozen=True)
class Hyperparameters:
    """The parameters that the likelihood determines, in the scaled units of the unit box.

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
    """The covariance at σ² = 1 of values, and of gradients where required, at A and B.

    With z = (a - b) / lengths the blocks are
    cov(f_a, f_b) = φ, cov(f_a, ∂_j f_b) = -2 z_j φ' / l_j,
    cov(∂_i f_a, f_b) = 2 z_i φ' / l_i,
    cov(∂_i f_a, ∂_j f_b) = -(2 δ_ij φ' + 4 z_i z_j φ'') / (l_i l_j).
    Rows and columns are ordered by component: all values, all ∂_1, all ∂_2, ...

    Parameters
    ----------
    kernel : Kernel
        The family.
    A, B : (a, d), (b, d) array
        Points of the unit box.
    length_scales : (d,) array
        Fractions of the box.
    gradients_of_a, gradients_of_b : bool
        Whether rows, and columns, of gradients are included.

    Returns
    -------
    (a or a (1 + d), b or b (1 + d)) array
        Scaled units.
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
    if not (rows or columns):
        return K.reshape(a, b)
    u = 2.0 * z / length_scales[:, None, None]
    slopes = u * phi[1]
    if rows:
        K[1:, :, 0] = slopes
    if columns:
        K[0, :, 1:] = -slopes.transpose(1, 0, 2)
    if rows and columns:
        for i, curved in enumerate(u * phi[2]):
            K[1 + i, :, 1:] = (-u * curved).transpose(1, 0, 2)
            K[1 + i, :, 1 + i] -= (2.0 / length_scales[i] ** 2) * phi[1]
    return K.reshape((1 + d * rows) * a, (1 + d * columns) * b)


def blocks_weighed(W: Array, z: Array, phi: list[Array], length_scales: Array) -> Array:
    """Sum W times the blocks of `covariance`, rows and columns of gradients in it, over these.

    W is (a (1 + d), b (1 + d)) as the blocks are, or (a, b) of values alone; the sum is (a, b).
    """
    d, a, b = z.shape
    if len(W) == a:
        return np.asarray(W * phi[0])
    V = W.reshape(1 + d, a, 1 + d, b)
    u = 2.0 * z / length_scales[:, None, None]
    slopes = (u * (V[1:, :, 0] - V[0, :, 1:].transpose(1, 0, 2))).sum(axis=0)
    curved, own = np.zeros((a, b)), np.zeros((a, b))
    for i in range(d):
        curved += u[i] * (V[1 + i, :, 1:].transpose(1, 0, 2) * u).sum(axis=0)
        own += (2.0 / length_scales[i] ** 2) * V[1 + i, :, 1 + i]
    return np.asarray(V[0, :, 0] * phi[0] + (slopes - own) * phi[1] - curved * phi[2])


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


def factorise(
    kernel: Kernel,
    X: Array,
    parameters: Hyperparameters,
    gradients: bool,
    least: float = 0.0,
    sample_noise: Array = NO_NOISE,
) -> tuple[Array, float]:
    """Return the lower Cholesky factor of K and the relative jitter, >= least, it needed.

    Raises:
        SurrogateFitError: K is indefinite beyond a jitter of 1e-6 (contradictory
            repeated samples with no noise, or parameters that are not finite).
    """
    lengths = parameters.length_scales
    C = covariance(kernel, X, X, lengths, gradients_of_a=gradients, gradients_of_b=gradients)
    jitters = (0.0, *(10.0**k for k in range(-15, -5)))
    for jitter in (j for j in jitters if j >= least):
        K = observed_covariance(C, len(X), parameters, jitter, sample_noise)
        try:
            return cholesky(K, lower=True, overwrite_a=True), jitter
        except (LinAlgError, ValueError):
            continue
    raise SurrogateFitError("the covariance of the samples is not positive definite")


def log_likelihood(
    kernel: Kernel,
    X: Array,
    targets: Array,
    parameters: Hyperparameters,
    jitter: float = 0.0,
    sample_noise: Array = NO_NOISE,
) -> tuple[float, Array]:
    """Return log p(targets | X) and its gradient in the logarithms of the parameters.

    log p = -½ tᵀK⁻¹t - Σ log L_ii - N/2 log 2π and
    ∂ log p / ∂θ = ½ tr((αα^T - K⁻¹) ∂K/∂θ), α = K⁻¹t,
    in the order θ = log (l_1 ... l_d, σ², noise, gradient noise), shape (d + 3,).
    X (n, d) is scaled; targets (n,) are values, or (n (1 + d),) values and gradients.

    Raises:
        LinAlgError: K is not positive definite.
    """
    n, d = X.shape
    gradients = targets.size > n
    lengths = parameters.length_scales
    z = separations(X, X, lengths)
    squares = z * z
    phi = radial(kernel, squares.sum(axis=0), 3 if gradients else 1)
    C = blocks(z, phi, lengths, gradients, gradients)
    K = observed_covariance(C, n, parameters, jitter, sample_noise)
    L = cholesky(K, lower=True, overwrite_a=True)
    alpha = cho_solve((L, True), targets)
    value = (
        -0.5 * targets @ alpha - np.log(np.diag(L)).sum() - 0.5 * targets.size * np.log(2.0 * np.pi)
    )
    W = np.outer(alpha, alpha) - symmetric_inverse(L)

    # K depends on log l_m in two ways. Through s, ds/dlog l_m = -2 z_m², which
    # shifts every φ to its derivative; and through the factors 1/l of the gradient
    # rows and columns, z_i/l_i going as l_i^-2 but the δ_ij term as l_i^-2 in all.
    S, components = blocks_weighed(W, z, phi[1:], lengths), targets.size // n
    slope = np.empty(d + 3)
    slope[:d] = -np.tensordot(squares, S, axes=2)
    WK = W * C
    WK[np.diag_indices_from(WK)] *= 1.0 + jitter
    if gradients:
        # The jitter sits on the diagonal, where z = 0 and only the δ_ij term acts.
        own = np.einsum("iaib->iab", W.reshape(components, n, components, n))[1:]
        with_jitter = phi[1] * (1.0 + jitter * np.eye(n))
        slope[:d] -= 2.0 * WK.sum(axis=1).reshape(components, n).sum(axis=1)[1:]
        slope[:d] += -(2.0 / lengths**2) * np.einsum("iab,ab->i", own, with_jitter)
    slope[:d] *= parameters.signal_variance
    slope[d] = 0.5 * parameters.signal_variance * WK.sum()
    W_diagonal = np.diag(W)
    slope[d + 1] = 0.5 * parameters.noise_variance * W_diagonal[:n].sum()
    slope[d + 2] = 0.5 * parameters.gradient_noise_variance * W_diagonal[n:].sum()
    return float(value), slope


def symmetric_inverse(L: Array) -> Array:
    """Return K⁻¹ in full from the lower Cholesky factor of K."""
    inverse, _ = dpotri(L, lower=1)  # above the diagonal it has the zeros of L
    full = inverse + inverse.T
    np.einsum("ii->i", full)[:] *= 0.5
    return np.asarray(full)
