"""Marginal likelihood of values and gradients, with its analytic gradient.

Source: Rasmussen & Williams (2006), eq. 5.8 and 5.9; the gradients enter as
further observations of the same process (section 9.4).
"""

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky
from scipy.linalg.lapack import dpotri

from surrogates.covariance import (
    NO_NOISE,
    Hyperparameters,
    Kernel,
    blocks,
    covariance,
    observed_covariance,
    radial,
    separations,
)
from surrogates.interface import Array, SurrogateFitError

# Scaled units. Samples of a unit box do not tell shorter length scales apart, nor longer
# ones from that of an input without influence (a bound of 100 costs a tenth in error on
# the OTL circuit function); a signal far above the sample variance is what smooth
# functions ask for.
LENGTH_BOUNDS = (1e-2, 1e3)
SIGNAL_BOUNDS = (1e-3, 1e6)
NOISE_BOUNDS = (1e-12, 1e0)
JITTERS = (0.0, *(10.0**k for k in range(-15, -5)))


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
    for jitter in (j for j in JITTERS if j >= least):
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
    shifted = blocks(z, phi[1:], lengths, gradients, gradients)
    components = targets.size // n
    S = (W * shifted).reshape(components, n, components, n).sum(axis=(0, 2))
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
    inverse, _ = dpotri(L, lower=1)
    lower = np.tril(inverse)
    return lower + np.tril(inverse, -1).T
