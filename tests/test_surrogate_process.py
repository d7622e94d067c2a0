"""The Gaussian process: covariances, likelihood, fits and leave-one-out."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize, rosen, rosen_der
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

from surrogates import (
    Hyperparameters,
    Kernel,
    SurrogateFitError,
    checked,
    condition,
    cross_validate,
    design,
    diagnose,
    fit,
    fit_outputs,
    loo_errors,
    profile_likelihood,
)
from surrogates.bands import calibrated
from surrogates.kernels import covariance, observed_covariance, radial
from surrogates.likelihood import log_likelihood

KERNELS = pytest.mark.parametrize("kernel", list(Kernel))
BOX = {"lower": [-2.0, -2.0], "upper": [2.0, 2.0]}
few = partial(settings, max_examples=10, derandomize=True, deadline=None)
seeds = st.integers(0, 10**6)


def smooth(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A function of any number of inputs and its gradient."""
    w = np.linspace(1.0, 0.4, X.shape[1])
    return np.sin(X @ w) + 0.1 * (X**2).sum(1), np.cos(X @ w)[:, None] * w + 0.2 * X


def drawn(seed: int, d: int = 2) -> tuple[np.random.Generator, Hyperparameters]:
    rng = np.random.default_rng(seed)
    return rng, Hyperparameters(
        length_scales=rng.uniform(0.2, 1.5, d),
        signal_variance=float(rng.uniform(0.5, 4.0)),
        noise_variance=1e-3,
        gradient_noise_variance=1e-2,
    )


@KERNELS
def test_radial_derivatives_are_those_of_phi(kernel: Kernel) -> None:
    s, h = np.array([0.02, 0.3, 1.0, 7.0]), 1e-5
    phi, up, down = (radial(kernel, t, 3) for t in (s, s + h, s - h))
    for order in range(3):
        slope = (up[order] - down[order]) / (2.0 * h)
        np.testing.assert_allclose(phi[order + 1], slope, rtol=1e-5)


@KERNELS
def test_gradient_blocks_are_derivatives_of_the_value_block(kernel: Kernel) -> None:
    rng, p = drawn(3)
    A, B, h = rng.random((3, 2)), rng.random((4, 2)), 1e-5
    k = partial(covariance, kernel, length_scales=p.length_scales)
    joint = k(A, B, gradients_of_a=True, gradients_of_b=True).reshape(3, 3, 3, 4)
    for i, e in enumerate(h * np.eye(2)):
        in_a = (k(A + e, B) - k(A - e, B)) / (2 * h)
        in_b = (k(A, B + e) - k(A, B - e)) / (2 * h)
        np.testing.assert_allclose(joint[1 + i, :, 0], in_a, atol=1e-8)
        np.testing.assert_allclose(joint[0, :, 1 + i], in_b, atol=1e-8)
        cross = k(A + e, B, gradients_of_b=True) - k(A - e, B, gradients_of_b=True)
        expected = (cross / (2 * h)).reshape(3, 3, 4)
        np.testing.assert_allclose(joint[1 + i], expected, atol=1e-8)


@KERNELS
@few()
@given(seed=seeds, n=st.integers(1, 12), d=st.integers(1, 4))
def test_joint_covariance_is_symmetric_and_positive(
    kernel: Kernel, seed: int, n: int, d: int
) -> None:
    rng, p = drawn(seed, d)
    X = rng.random((n, d))
    X = np.vstack([X, X[:1]])  # a repeated sample: semidefinite, not definite
    K = covariance(kernel, X, X, p.length_scales, gradients_of_a=True, gradients_of_b=True)
    np.testing.assert_allclose(K, K.T, atol=1e-13 * np.abs(K).max())
    assert np.linalg.eigvalsh(K)[0] > -1e-12 * np.trace(K)
    noisy = observed_covariance(kernel, X, p, True, 0.0)
    assert np.linalg.eigvalsh(noisy)[0] > 0.9 * p.noise_variance


@KERNELS
@pytest.mark.parametrize("components", [1, 4])
def test_likelihood_slope_matches_differences(kernel: Kernel, components: int) -> None:
    rng = np.random.default_rng(0)
    X, t = rng.random((6, 3)), rng.standard_normal(6 * components)
    theta, h = np.log([0.3, 0.7, 1.1, 1.7, 1e-3, 1e-2]), 1e-5

    def value_and_slope(theta: np.ndarray) -> tuple[float, np.ndarray]:
        e = np.exp(theta)
        return log_likelihood(kernel, X, t, Hyperparameters(e[:3], e[3], e[4], e[5]), 1e-3)

    slope = value_and_slope(theta)[1]
    differences = [
        (value_and_slope(theta + e)[0] - value_and_slope(theta - e)[0]) / (2 * h)
        for e in h * np.eye(6)
    ]
    np.testing.assert_allclose(slope, differences, atol=1e-8 * np.abs(slope).max())


@KERNELS
def test_likelihood_of_values_is_scikit_learns(kernel: Kernel) -> None:
    rng, p = drawn(5)
    X, t = rng.random((9, 2)), rng.standard_normal(9)
    shape = RBF(p.length_scales) if kernel is Kernel.RBF else Matern(p.length_scales, nu=2.5)
    k = ConstantKernel(p.signal_variance) * shape + WhiteKernel(p.noise_variance)
    theirs = GaussianProcessRegressor(k, alpha=0.0, optimizer=None).fit(X, t)
    expected, slope = theirs.log_marginal_likelihood(theirs.kernel_.theta, eval_gradient=True)
    ours = log_likelihood(kernel, X, t, p)
    assert ours[0] == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(np.r_[ours[1][2], ours[1][:2], ours[1][3]], slope, rtol=1e-9)


@KERNELS
@few()
@given(seed=seeds, with_gradients=st.booleans())
def test_no_noise_interpolates(kernel: Kernel, seed: int, with_gradients: bool) -> None:
    _, p = drawn(seed)
    X = design("lhs", **BOX, n=10, seed=seed)
    Y, dY = smooth(X)
    p = Hyperparameters(0.5 * p.length_scales, p.signal_variance, 0.0)
    gp = condition(p, X, Y, **BOX, kernel=kernel, dY=dY if with_gradients else None)
    mean, std = gp.predict(X, return_std=True)
    assert gp.jitter == 0.0
    np.testing.assert_allclose(mean, Y, atol=1e-8 * gp.output_scale)
    assert std.max() < 1e-5 * gp.output_scale
    if with_gradients:
        for j, e in enumerate(1e-5 * np.eye(2)):
            slope = (gp.predict(X + e) - gp.predict(X - e)) / 2e-5
            np.testing.assert_allclose(slope, dY[:, j], atol=2e-6 * np.abs(dY).max())


@few()
@given(
    seeds,
    st.booleans(),
    st.floats(1e-3, 1e3),
    st.floats(-50.0, 50.0),
    st.floats(1e-3, 1e3),
    st.floats(-50.0, 50.0),
)
def test_prediction_is_invariant_under_units(
    seed: int, with_gradients: bool, a: float, b: float, c: float, e: float
) -> None:
    _, p = drawn(seed)
    low, high = np.array(BOX["lower"]), np.array(BOX["upper"])
    X, T = design("lhs", low, high, 12, seed), design("lhs", low, high, 20, seed + 1)
    Y, dY = smooth(X)
    slopes, moved = (dY, c * dY / a) if with_gradients else (None, None)
    one = condition(p, X, Y, lower=low, upper=high, dY=slopes)
    two = condition(p, a * X + b, c * Y + e, lower=a * low + b, upper=a * high + b, dY=moved)
    mean, std = one.predict(T, return_std=True)
    mean2, std2 = two.predict(a * T + b, return_std=True)
    # What is lost is the rounding of the shifts, eps (|b| / a + |e| / c) at most.
    tolerance = 1e-9 + 1e-11 * (abs(b) / a + abs(e) / c)
    np.testing.assert_allclose((mean2 - e) / c, mean, atol=tolerance, rtol=0)
    np.testing.assert_allclose(std2 / c, std, atol=tolerance, rtol=1e-7)


@pytest.mark.parametrize("with_gradients", [False, True])
def test_fit_is_bit_identical_under_units_that_are_powers_of_two(with_gradients: bool) -> None:
    X = design("lhs", **BOX, n=12, seed=2)
    Y, dY = smooth(X)
    one = fit(X, Y, **BOX, dY=dY if with_gradients else None, seed=4)
    two = fit(
        8 * X,
        Y / 4,
        lower=[-16.0, -16.0],
        upper=[16.0, 16.0],
        dY=dY / 32 if with_gradients else None,
        seed=4,
    )
    np.testing.assert_array_equal(one.predict(X + 0.1), 4 * two.predict(8 * (X + 0.1)))


@pytest.mark.parametrize("with_gradients", [False, True])
def test_closed_form_leave_one_out_is_what_leaving_out_gives(with_gradients: bool) -> None:
    _, p = drawn(1)
    X = design("lhs", **BOX, n=9, seed=3)
    Y, dY = smooth(X)
    gp = condition(p, X, Y, **BOX, dY=dY if with_gradients else None)
    residuals, deviations = loo_errors(gp)
    n = len(X)
    K = observed_covariance(gp.kernel, gp.X, p, with_gradients, 0.0)
    for i in range(n):
        rest = np.arange(gp.targets.size) % n != i
        w = np.linalg.solve(K[np.ix_(rest, rest)], K[rest, i])
        residual = gp.output_scale * (gp.targets[i] - w @ gp.targets[rest])
        deviation = gp.output_scale * np.sqrt(K[i, i] - w @ K[rest, i])
        assert residuals[i] == pytest.approx(residual, rel=1e-8, abs=1e-12)
        assert deviations[i] == pytest.approx(deviation, rel=1e-8)
    assert gp.loo.rms == pytest.approx(np.sqrt(np.mean(residuals**2)))
    assert gp.loo.max == np.abs(residuals).max()


def relative_error(
    f: Callable, n: int, kernel: str, gradients: bool, d: int = 2, half: float = 2.0
) -> float:
    low, high = [-half] * d, [half] * d
    X, T = design("lhs", low, high, n, seed=1), design("lhs", low, high, 500, seed=9)
    Y, dY = f(X)
    gp = fit(X, Y, lower=low, upper=high, kernel=kernel, dY=dY if gradients else None)
    truth = f(T)[0]
    return float(np.sqrt(np.mean((gp.predict(T) - truth) ** 2)) / truth.std())


def rosenbrock(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return rosen(X.T), rosen_der(X.T).T


# About twice the errors measured when this was written.
@pytest.mark.parametrize(
    ("n", "kernel", "gradients", "bound"),
    [
        (32, "matern52", False, 6e-2),
        (32, "rbf", False, 5e-4),
        (16, "matern52", True, 4e-2),
        (16, "rbf", True, 1e-4),
        (32, "rbf", True, 2e-5),
    ],
)
def test_rosenbrock_is_learnt(n: int, kernel: str, gradients: bool, bound: float) -> None:
    assert relative_error(rosenbrock, n, kernel, gradients) < bound


@KERNELS
def test_gradients_pay_for_themselves(kernel: Kernel) -> None:
    error = partial(relative_error, smooth, kernel=kernel, d=4, half=1.0)
    with_gradients = error(n=32, gradients=True)
    assert with_gradients < 0.2 * error(n=32, gradients=False)
    assert with_gradients < 0.5 * error(n=48, gradients=False)


@pytest.mark.parametrize("with_gradients", [False, True])
def test_noise_is_found_and_smoothed(with_gradients: bool) -> None:
    rng = np.random.default_rng(0)
    X = design("sobol", **BOX, n=64, seed=0)
    Y, dY = smooth(X)
    noisy, noisy_slopes = (
        Y + 0.05 * rng.standard_normal(64),
        dY + 0.1 * rng.standard_normal((64, 2)),
    )
    gp = fit(X, noisy, **BOX, dY=noisy_slopes if with_gradients else None)
    found = gp.output_scale * np.sqrt(gp.hyperparameters.noise_variance)
    assert 0.035 < found < 0.07
    # Averaging gains at least a factor two on the noise itself.
    assert np.sqrt(np.mean((gp.predict(X) - Y) ** 2)) < 0.025 * 1.4
    fixed = fit(X, noisy, **BOX, noise=0.05)
    assert fixed.output_scale**2 * fixed.hyperparameters.noise_variance == pytest.approx(0.05**2)


def test_repeated_samples_and_constant_output_are_survived() -> None:
    X = design("lhs", **BOX, n=8, seed=0)
    X, Y = np.vstack([X, X]), np.tile(smooth(X)[0], 2)
    gp = fit(X, Y, **BOX, noise=0.0)
    np.testing.assert_allclose(gp.predict(X), Y, atol=1e-5)
    flat = fit(X, np.full(16, 3.0), **BOX)
    np.testing.assert_allclose(flat.predict(X + 0.1), 3.0, rtol=1e-12)


def test_several_outputs_are_fitted_apart() -> None:
    X = design("lhs", **BOX, n=10, seed=0)
    Y, dY = smooth(X)
    both = fit_outputs(X, np.stack([Y, 2 * Y], 1), **BOX, dY=np.stack([dY, 2 * dY], 1), starts=1)
    alone = fit(X, Y, **BOX, dY=dY, starts=1)
    assert len(both) == 2
    np.testing.assert_array_equal(both[0].predict(X + 0.1), alone.predict(X + 0.1))
    np.testing.assert_array_equal(both[1].predict(X + 0.1), 2 * alone.predict(X + 0.1))


def test_fit_is_deterministic_in_the_seed() -> None:
    X = design("lhs", **BOX, n=12, seed=0)
    Y, _ = smooth(X)
    one, two = fit(X, Y, **BOX, seed=3), fit(X, Y, **BOX, seed=3)
    np.testing.assert_array_equal(one.weights, two.weights)


def test_cross_validation_refits_on_every_fold() -> None:
    X = design("lhs", **BOX, n=12, seed=0)
    Y, dY = smooth(X)
    sizes = []

    def fitter(X, Y, dY=None):
        sizes.append(len(X))
        return condition(drawn(0)[1], X, Y, **BOX, dY=dY)

    plain = cross_validate(fitter, X, Y, folds=5, seed=1)
    assert sorted(sizes) == [9, 9, 10, 10, 10]
    assert plain == cross_validate(fitter, X, Y, folds=5, seed=1)
    assert cross_validate(fitter, X, Y, folds=5, seed=1, dY=dY).rms < plain.rms
    with pytest.raises(ValueError, match="folds"):
        cross_validate(fitter, X, Y, folds=13)


@pytest.mark.parametrize(
    ("n", "step", "kink", "verdict"),
    [
        (60, 0.0, 0.0, "smooth"),
        (120, 0.0, 0.0, "smooth"),
        (60, 0.0, 2.0, "kinked"),
        (120, 0.0, 2.0, "kinked"),
        (120, 4.0, 0.0, "jumps"),
    ],
)
def test_roughness_is_recognised(n: int, step: float, kink: float, verdict: str) -> None:
    X = design("sobol", **BOX, n=n, seed=3)
    across = X @ [1.0, -0.7] - 0.1
    Y = smooth(X)[0] + step * (across > 0) + kink * np.abs(across)
    found = diagnose(fit(X, Y, **BOX))
    assert found.roughness == verdict
    assert (found.coverage > 0.97) == (verdict == "smooth")
    worst = np.argsort(np.abs(found.standardised))[-3:]
    if verdict != "smooth":  # the samples that do not fit are those at the edge
        assert (np.abs(across[worst]) < 0.6).all()


X4, Y4 = np.linspace(0, 1, 4)[:, None], np.arange(4.0)


@pytest.mark.parametrize(
    ("X", "Y", "options"),
    [
        (X4, Y4[:3], {}),
        (X4[:, 0], Y4, {}),
        (np.hstack([X4, X4]), Y4, {}),
        (X4[:1], Y4[:1], {}),
        (X4, np.array([0.0, 1.0, np.nan, 2.0]), {}),
        (X4, Y4, {"dY": np.ones(4)}),
        (X4, Y4, {"dY": np.full((4, 1), np.inf)}),
        (X4, Y4, {"noise": -1.0}),
        (X4, Y4, {"starts": 0}),
        (X4, Y4, {"upper": [-1.0]}),
    ],
)
def test_bad_samples_are_refused(X: np.ndarray, Y: np.ndarray, options: dict) -> None:
    with pytest.raises(SurrogateFitError):
        fit(X, Y, **{"lower": [0.0], "upper": [1.0], **options})


def test_prediction_refuses_points_of_other_inputs() -> None:
    gp = fit(X4, Y4, lower=[0.0], upper=[1.0], starts=1)
    with pytest.raises(ValueError, match="expected points"):
        gp.predict(np.ones((3, 2)))


@pytest.mark.parametrize("with_gradients", [False, True])
def test_fitted_mean_is_the_best_linear_unbiased_one(with_gradients: bool) -> None:
    X = design("lhs", **BOX, n=14, seed=2)
    Y, dY = smooth(X)
    gp = fit(X, Y, **BOX, dY=dY if with_gradients else None, starts=1)
    K = observed_covariance(gp.kernel, gp.X, gp.hyperparameters, with_gradients, gp.jitter)
    ones = (np.arange(len(K)) < 14).astype(float)
    # Generalised least squares of what is left about the mean: nothing.
    left = ones @ np.linalg.solve(K, gp.targets) / (ones @ np.linalg.solve(K, ones))
    assert abs(left) < 1e-6
    residuals, _ = loo_errors(gp)
    assert gp.loo.rms == pytest.approx(np.sqrt(np.mean(residuals**2)))


def test_bands_are_stretched_and_never_narrowed() -> None:
    X = design("sobol", **BOX, n=60, seed=3)
    Y = smooth(X)[0]
    fitted = fit(X, Y, **BOX, starts=1)
    p = fitted.hyperparameters
    # A hundredth of the variance: too sure of itself by ten, with the same mean.
    sure = Hyperparameters(p.length_scales, p.signal_variance / 100, p.noise_variance / 100)
    raw = condition(sure, X, Y, **BOX)
    assert raw.band == 1.0
    mended = calibrated(raw)
    unseen = design("lhs", **BOX, n=500, seed=4)
    mean, std = mended.predict(unseen, return_std=True)
    assert np.mean(np.abs(mean - smooth(unseen)[0]) <= 1.96 * std) > 0.85
    np.testing.assert_allclose(std, mended.band * raw.predict(unseen, return_std=True)[1])
    vague = Hyperparameters(p.length_scales, 1e4 * p.signal_variance, 1e4 * p.noise_variance)
    assert calibrated(condition(vague, X, Y, **BOX)).band == 1.0
    assert calibrated(condition(sure, X[:10], Y[:10], **BOX)).band == 1.0  # too few to tell


def test_many_close_samples_without_noise_are_fitted() -> None:
    # The likelihood's optimum was singular here, which ended in a LinAlgError.
    X = design("lhs", [0, 0], [1, 1], 700, seed=1)
    Y = np.sin(2 * X[:, 0] + X[:, 1]) + (X[:, 0] + 2 * X[:, 1]) ** 2 / 2
    gp = fit(X, Y, lower=[0, 0], upper=[1, 1], noise=0.0, starts=1)
    assert gp.loo.rms < 1e-4


@KERNELS
def test_the_profile_likelihood_is_the_likelihood_with_mean_and_variance_eliminated(
    kernel: Kernel,
) -> None:
    X = design("sobol", [0, 0], [1, 1], 24, seed=3)
    t = np.sin(3.0 * X[:, 0]) + X[:, 1] ** 2 + 5.0
    lengths = np.array([0.25, 0.35])  # longer ones drown the differences in rounding
    value, slope = profile_likelihood._negative(kernel, X, t, lengths)
    C = covariance(kernel, X, X, lengths) + profile_likelihood.JITTER * np.eye(24)

    def negative(mean_and_log_variance: np.ndarray) -> float:
        mean, variance = mean_and_log_variance[0], np.exp(mean_and_log_variance[1])
        residual = t - mean
        log_det = np.linalg.slogdet(C)[1]
        inside = residual @ np.linalg.solve(C, residual) / variance
        return 0.5 * (24 * np.log(variance) + log_det + inside)

    least = minimize(negative, [5.0, 0.0], method="Nelder-Mead", options={"fatol": 1e-10}).fun
    assert value + 12.0 == pytest.approx(least, abs=1e-6)  # ½ n of the quadratic form
    for j, e in enumerate(1e-5 * np.eye(2)):
        up, down = (
            profile_likelihood._negative(kernel, X, t, lengths * np.exp(sign * e))[0]
            for sign in (1.0, -1.0)
        )
        assert slope[j] == pytest.approx((up - down) / 2e-5, rel=1e-5, abs=1e-6)


def test_exact_samples_are_polished_about_their_own_mean() -> None:
    # Far from zero mean in its own units: the sample mean is a poor one at long length scales.
    X = design("lhs", [0] * 6, [1] * 6, 80, seed=2)
    Y = np.exp(X @ [1.0, 0.8, 0.5, 0.0, 0.1, 0.3])
    gp = fit(X, Y, lower=[0] * 6, upper=[1] * 6, kernel="rbf", noise=0.0)
    samples = checked(X, Y, [0] * 6, [1] * 6, None, 0.0)
    found = profile_likelihood.polished(
        Kernel.RBF, samples.unit, samples.targets, gp.hyperparameters
    ).length_scales
    value, slope = profile_likelihood._negative(Kernel.RBF, samples.unit, samples.targets, found)[
        :2
    ]
    before = profile_likelihood._negative(
        Kernel.RBF, samples.unit, samples.targets, gp.hyperparameters.length_scales
    )[0]
    assert np.abs(slope[found < 900]).max() < 0.05
    assert value <= before + 1e-9
    repeated = fit(np.repeat(X, 1, 0), np.ones(80), lower=[0] * 6, upper=[1] * 6, noise=0.0)
    assert repeated.predict(X[:3]) == pytest.approx(1.0)
