"""Length scales of samples without noise, their mean and signal variance eliminated.

With K = σ² C(lengths), both are known where the likelihood is largest: μ = 1ᵀC⁻¹t / 1ᵀC⁻¹1 and
σ² = (t - μ)ᵀC⁻¹(t - μ) / n. What is left has d unknowns in place of d + 2, and its optimum is
that of the mean which the process is then `centred` about.

Source: Santner, Williams & Notz, The Design and Analysis of Computer Experiments (2003),
section 3.3.2; Jones, Schonlau & Welch, J. Global Optim. 13 (1998), eq. 4 to 6.
"""

import numpy as np
from scipy.linalg import cho_solve, cholesky

from surrogates.covariance import Hyperparameters, Kernel, radial, separations
from surrogates.interface import Array
from surrogates.likelihood import (
    LENGTH_BOUNDS,
    SIGNAL_BOUNDS,
    SINGULAR,
    maximised,
    symmetric_inverse,
)

# On the diagonal of C, so that no trial point is lost to rounding.
JITTER = 1e-13
# Length scales that the search starts from besides those it is given: a box, and five.
STARTS = (1.0, 5.0)


def polished(kernel: Kernel, X: Array, targets: Array, found: Hyperparameters) -> Hyperparameters:
    """Return the hyperparameters of largest profile likelihood, searched from those found.

    X (n, d) in the unit box, targets (n,) without noise. Those found are returned where the
    covariance is singular everywhere.
    """
    d = X.shape[1]
    starts = [found.length_scales, *(np.full(d, value) for value in STARTS)]
    best, lengths = maximised(
        lambda lengths: profile_likelihood(kernel, X, targets, lengths),
        starts,
        [LENGTH_BOUNDS] * d,
    )
    if best <= SINGULAR:
        return found
    variance = _solved(kernel, X, targets, lengths)[-1]
    return Hyperparameters(lengths, float(np.clip(variance, *SIGNAL_BOUNDS)), 0.0)


def profile_likelihood(
    kernel: Kernel, X: Array, t: Array, lengths: Array
) -> tuple[float, Array]:
    """-n/2 log σ² - ½ log det C, and its gradient in log lengths. Raises LinAlgError."""
    z, phi, L, alpha, variance = _solved(kernel, X, t, lengths)
    value = -0.5 * t.size * np.log(variance) - np.log(np.diag(L)).sum()
    W = (symmetric_inverse(L) - np.outer(alpha, alpha) / variance) * phi[1]
    return float(value), np.tensordot(z * z, W, axes=2)


def _solved(
    kernel: Kernel, X: Array, t: Array, lengths: Array
) -> tuple[Array, list[Array], Array, Array, float]:
    """Separations, radial derivatives, the factor of C, C⁻¹(t - μ) and σ²."""
    z = separations(X, X, lengths)
    phi = radial(kernel, np.einsum("jab,jab->ab", z, z), 1)
    C = phi[0].copy()
    C[np.diag_indices_from(C)] += JITTER
    L = cholesky(C, lower=True)
    ones = cho_solve((L, True), np.ones(t.size))
    alpha = cho_solve((L, True), t)
    mu = alpha.sum() / ones.sum()
    alpha = alpha - mu * ones
    return z, phi, L, alpha, float((t - mu) @ alpha) / t.size
