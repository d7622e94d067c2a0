"""What a process fitted by likelihood is mended by: its mean, and the width of its bands."""

from dataclasses import replace

import numpy as np
from scipy.linalg import cho_solve

from surrogates.gaussian_process import TWO_SIDED_95, GaussianProcess, loo_errors
from surrogates.validation import errors

# Samples below which a quantile of 95 % is the largest of all, and says little.
LEAST_TO_CALIBRATE = 20


def centred(process: GaussianProcess) -> GaussianProcess:
    """Return the process about its best linear unbiased mean in place of the sample mean.

    μ = 1ᵀK⁻¹t / 1ᵀK⁻¹1 (the ones of the values only), in scaled units: samples that stand
    close together count less. Source: R & W, eq. 2.43, with a constant basis.
    """
    n = len(process.X)
    ones = np.zeros(process.targets.size)
    ones[:n] = 1.0
    along = cho_solve((process.factor, True), ones)
    mu = float(process.weights[:n].sum() / along[:n].sum())
    moved = replace(
        process,
        output_mean=process.output_mean + process.output_scale * mu,
        targets=process.targets - mu * ones,
        weights=process.weights - mu * along,
    )
    residuals, _ = loo_errors(moved)
    values = moved.output_mean + moved.output_scale * moved.targets[:n]
    return replace(moved, loo=errors(residuals, values))


def calibrated(process: GaussianProcess) -> GaussianProcess:
    """Return the process with its deviation stretched until its samples fit in their bands.

    band = max(1, q₉₅(|y_i - μ_{-i}| / σ_{-i}) / 1.96). Maximum likelihood takes the length
    scales for certain, and a smooth kernel on a function that is less smooth is much too
    sure of itself: unseen points of the lifted data were covered to 69 to 80 % in place of
    95 %, and to 84 to 94 % with the factor. It never narrows, the samples being few.
    """
    if len(process.X) < LEAST_TO_CALIBRATE:
        return process
    residuals, deviations = loo_errors(process)
    quantile = float(np.quantile(np.abs(residuals) / deviations, 0.95))
    return replace(process, band=max(1.0, quantile / TWO_SIDED_95))
