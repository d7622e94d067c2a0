"""Does a smooth surrogate suit these samples? Calibration, and kinks and jumps."""

import warnings
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from surrogates.gaussian_process import TWO_SIDED_95, GaussianProcess, loo_errors
from surrogates.interface import Array
from surrogates.likelihood import LENGTH_BOUNDS, SIGNAL_BOUNDS

# Samples that enter the four likelihood fits; they cost O(n³) each.
ROUGHNESS_ORDER = 200
NUGGET = 1e-9


class Roughness(StrEnum):
    """The kind of function the samples look like at their own resolution."""

    SMOOTH = "smooth"
    KINKED = "kinked"
    JUMPS = "jumps"


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What leave-one-out and the smoothness likelihoods say about a surrogate.

    standardised (n,): (y_i - μ_{-i}) / σ_{-i}, to see which samples do not fit.
    coverage: share of samples inside their own leave-one-out 95 % band, uncalibrated.
    q2: leave-one-out Q². log_likelihoods: of the values under Matérn kernels of
    smoothness ν, keyed '1/2', '3/2', '5/2', 'inf', relative to the best.
    """

    standardised: Array
    coverage: float
    q2: float
    log_likelihoods: dict[str, float]
    roughness: Roughness


def diagnose(process: GaussianProcess, noise: float = 0.0, seed: int = 0) -> Diagnosis:
    """Return calibration and roughness verdict of a fitted process.

    A kink across a surface has Sobolev regularity just below 3/2, a jump just below
    1/2, and sample paths of a Matérn process regularity ν. Each ν is fitted by
    maximum likelihood (at most 200 of the samples, values only, the noise fixed) and
    the verdict is 'smooth' if ν = 5/2 or ∞ explains the values best; else 'jumps' if
    ν = 1/2 explains them better than 5/2, and 'kinked' if not.

    The measure sees what the samples resolve and no more. Kinks and jumps that are
    small beside the smooth variation read one class too smooth (a jump as a kink, a
    kink as smooth), the more so the fewer samples and the more inputs; a steep
    smooth step reads as rough. So 'jumps' and 'kinked' are grounds to act, 'smooth'
    is no proof. Unmodelled noise is roughness: give its deviation `noise`, in output
    units, if there is any.

    Source: Stein, Interpolation of Spatial Data (1999), section 6.7, on estimating
    ν by likelihood; Rasmussen & Williams (2006), section 5.4.2 on leave-one-out.
    """
    residuals, deviations = loo_errors(process)
    standardised = residuals / deviations
    values = process.targets[: len(process.X)]
    likelihoods = smoothness_likelihoods(process.X, values, noise / process.output_scale, seed)
    return Diagnosis(
        standardised=standardised,
        coverage=float(np.mean(np.abs(standardised) <= TWO_SIDED_95)),
        q2=process.loo.q2,
        log_likelihoods=likelihoods,
        roughness=roughness(likelihoods),
    )


def roughness(likelihoods: dict[str, float]) -> Roughness:
    """Return the verdict of the likelihoods of the four smoothnesses, as `diagnose` says it.

    >>> roughness({"1/2": -9.0, "3/2": 0.0, "5/2": -4.0, "inf": -20.0}).value
    'kinked'
    """
    rough = max(likelihoods["1/2"], likelihoods["3/2"])
    if max(likelihoods["5/2"], likelihoods["inf"]) >= rough:
        return Roughness.SMOOTH
    return Roughness.JUMPS if likelihoods["1/2"] > likelihoods["5/2"] else Roughness.KINKED


def smoothness_likelihoods(X: Array, values: Array, noise: float, seed: int) -> dict[str, float]:
    """Return the log likelihoods of Matérn kernels ν, as `Diagnosis` keeps them.

    X (n, d) in the unit box; values (n,) and the noise's deviation in units of the
    deviation of the values.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern

    n, d = X.shape
    rows = np.random.default_rng(seed).permutation(n)[:ROUGHNESS_ORDER]
    found = {}
    for name, nu in (("1/2", 0.5), ("3/2", 1.5), ("5/2", 2.5), ("inf", np.inf)):
        shape = Matern(np.full(d, 0.5), LENGTH_BOUNDS, nu=nu)
        regressor = GaussianProcessRegressor(
            ConstantKernel(1.0, SIGNAL_BOUNDS) * shape,
            alpha=max(noise**2, NUGGET),
            n_restarts_optimizer=1,
            random_state=seed,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # as in fitting
            regressor.fit(X[rows], values[rows])
        found[name] = float(regressor.log_marginal_likelihood_value_)
    best = max(found.values())
    return {name: value - best for name, value in found.items()}
