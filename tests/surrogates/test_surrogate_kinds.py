"""Each kind of surrogate against its library, and what it does with noise."""

from time import process_time

import casadi as ca
import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.preprocessing import PolynomialFeatures
from surrogate_family import BOX, DY, LOW, SPAN, T, X, Y, member

from surrogates import (
    Hyperparameters,
    SurrogateFitError,
    checked,
    condition,
    design,
    errors,
    fit,
    fit_outputs,
    fit_polynomial,
    to_casadi,
)


def test_polynomial_equals_scikit_learn() -> None:
    ours = fit_polynomial(checked(X, Y, **BOX), degree=3)
    features = PolynomialFeatures(3)
    u, t = (2.0 * (points - LOW) / SPAN - 1.0 for points in (X, T))
    theirs = LinearRegression().fit(features.fit_transform(u), Y)
    expected = theirs.predict(features.transform(t))
    np.testing.assert_allclose(ours.predict(T), expected, atol=1e-9 * Y.std(), rtol=0)


def test_closed_form_leave_one_out_is_what_leaving_out_gives() -> None:
    s = member("polynomial")
    for i in (0, 11, 30):
        rest = np.arange(len(X)) != i
        again = fit_polynomial(checked(X[rest], Y[rest], **BOX), s.degree)
        residual = Y[i] - again.predict(X[i])[0]
        assert s.left_out[i] == pytest.approx(residual, rel=1e-5, abs=1e-6 * Y.std())
    assert s.loo == errors(s.left_out, Y)


def test_gradients_are_left_out_with_their_sample() -> None:
    s = member("polynomial+gradients")
    A = [
        fit_polynomial(
            checked(np.delete(X, i, 0), np.delete(Y, i), **BOX, dY=np.delete(DY, i, 0)), s.degree
        )
        for i in (0, 20)
    ]
    for i, again in zip((0, 20), A, strict=True):
        # Another choice of the gradients' weight is possible with one sample less.
        residual = Y[i] - again.predict(X[i])[0]
        assert s.left_out[i] == pytest.approx(residual, rel=1e-6, abs=1e-9 * Y.std())
    assert s.loo.rms < 0.5 * member("polynomial").loo.rms


def test_polynomial_finds_the_degree_of_a_polynomial() -> None:
    u = (X - LOW) / SPAN
    cubic = u[:, 0] ** 3 - 2 * u[:, 1] * u[:, 2] ** 2 + u[:, 0]
    s = fit(X, cubic, **BOX, kind="polynomial")
    assert s.loo.rms < 1e-12
    noisy = fit(
        X, cubic + 0.1 * np.random.default_rng(0).standard_normal(48), **BOX, kind="polynomial"
    )
    assert noisy.degree <= 3


@pytest.mark.parametrize("kind", ["gaussian_process", "polynomial"])
def test_noise_of_single_samples_is_heeded(kind: str) -> None:
    rng = np.random.default_rng(4)
    P = design("sobol", [0, 0], [1, 1], 64, seed=5)
    noise = np.where(rng.random(64) < 0.3, 1.0, 0.003)
    truth = np.sin(2 * P[:, 0]) + P[:, 1] ** 2
    values = truth + noise * rng.standard_normal(64)
    box = {"lower": [0, 0], "upper": [1, 1]}
    heeded = fit(P, values, **box, kind=kind, noise=noise)
    error = np.sqrt(np.mean((heeded.predict(P) - truth) ** 2))
    alike = fit(P, values, **box, kind=kind, noise=float(np.sqrt(np.mean(noise**2))))
    assert error < 0.05
    assert error < 0.5 * np.sqrt(np.mean((alike.predict(P) - truth) ** 2))


def test_joint_likelihood_heeds_the_noise_of_single_samples() -> None:
    noise = np.full(24, 1e-3)
    noise[::6] = 30.0
    moved = Y[:24] + noise * np.random.default_rng(1).standard_normal(24)
    s = fit(X[:24], moved, DY[:24], **BOX, noise=noise, starts=1)
    assert s.sample_noise.shape == (24,)
    assert np.abs(s.predict(X[:24]) - Y[:24]).max() < 2.0
    assert s.loo.rms > 3.0  # the noisy samples are predicted, not followed


def test_several_outputs_have_noises_of_their_own() -> None:
    both = np.stack([Y, np.log(Y)], 1)
    one, two = fit_outputs(X, both, **BOX, noise=[np.full(48, 0.1), None], starts=1)
    assert one.hyperparameters.noise_variance == pytest.approx((0.1 / Y.std()) ** 2)
    assert two.hyperparameters.noise_variance != one.hyperparameters.noise_variance
    assert to_casadi([one, two], std=True)(T[0])[0].shape == (2, 1)
    with pytest.raises(SurrogateFitError, match="expected 2 noises, got 1"):
        fit_outputs(X, both, **BOX, noise=[0.1])


def test_bounds_left_out_are_the_range_of_the_samples() -> None:
    s = fit(X, Y, kind="polynomial")
    np.testing.assert_array_equal(s.lower, X.min(axis=0))
    with pytest.raises(SurrogateFitError, match="input 1 does not vary"):
        fit(X * [1, 0, 1], Y)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "spline"}, "unknown kind 'spline'; it is one of: gaussian_process"),
        ({"kernel": "cubic"}, "unknown kernel"),
        ({"noise": [1.0, 2.0]}, "one noise or one to each"),
        ({"noise": -np.ones(48)}, "negative"),
    ],
)
def test_what_cannot_be_done_is_said(options: dict, message: str) -> None:
    with pytest.raises(SurrogateFitError, match=message):
        fit(X, Y, **{**BOX, **options})
    with pytest.raises(SurrogateFitError, match="fit_outputs takes several"):
        fit(X, np.stack([Y, Y], 1), **BOX)


def test_too_many_samples_for_an_exact_process_are_named() -> None:
    many = np.random.default_rng(0).random((5001, 2))
    with pytest.raises(SurrogateFitError, match="or fewer samples"):
        fit(many, many.sum(1), lower=[0, 0], upper=[1, 1])
    with pytest.raises(SurrogateFitError, match="degree 9"):
        fit_polynomial(checked(X, Y, **BOX), degree=9)


def test_a_thousand_samples_of_eight_inputs_take_two_milliseconds() -> None:
    P = np.random.default_rng(0).random((1000, 8))
    box = {"lower": np.zeros(8), "upper": np.ones(8)}
    s = condition(Hyperparameters(np.full(8, 2.0), 10.0, 1e-8), P, np.sin(P.sum(1)), **box)
    x = ca.MX.sym("x", 8)
    mean = to_casadi(s, std=False)(x)
    gradient = ca.Function("g", [x], [mean, ca.gradient(mean, x)])
    hessian = ca.Function("h", [x], [ca.hessian(mean, x)[0]])
    for function in (gradient, hessian):
        times = []
        for point in P[:40]:
            began = process_time()
            function(point)
            times.append(process_time() - began)
        assert min(times) < 2e-3  # the best of many, of the processor: others use the machine too
