"""Covariances of values and gradients, and the likelihood that fits maximise."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.surrogate_draws import KERNELS, drawn, few, seeds
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

from surrogates import Hyperparameters, Kernel
from surrogates.fitting import log_likelihood
from surrogates.gaussian_process import covariance, observed_covariance, radial


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
    noisy = observed_covariance(K, len(X), p, 0.0)
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
