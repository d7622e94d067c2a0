"""Each kind of surrogate against its library, what it does with noise, and which is chosen."""

from time import process_time

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator
from sklearn.linear_model import LinearRegression
from sklearn.neural_network import MLPRegressor
from sklearn.preprocessing import PolynomialFeatures
from surrogate_family import BOX, DY, LOW, SPAN, T, X, Y, member

from surrogates import (
    Hyperparameters,
    Kernel,
    SurrogateFitError,
    checked,
    choose,
    condition,
    design,
    errors,
    fit,
    fit_network,
    fit_outputs,
    fit_polynomial,
    fit_radial_basis,
    fit_sparse,
    to_casadi,
)


@pytest.mark.parametrize(
    ("basis", "epsilon", "degree"),
    [("cubic", 1.0, 1), ("quintic", 1.0, 2), ("multiquadric", 3.0, 0), ("gaussian", 4.0, 0)],
)
@pytest.mark.parametrize("smoothing", [0.0, 1e-3])
def test_radial_basis_equals_scipy(
    basis: str, epsilon: float, degree: int, smoothing: float
) -> None:
    ours = fit_radial_basis(checked(X, Y, **BOX), basis, epsilon, smoothing)
    theirs = RBFInterpolator(
        (X - LOW) / SPAN, Y, smoothing=smoothing, kernel=basis, epsilon=epsilon, degree=degree
    )
    expected = theirs((T - LOW) / SPAN)
    np.testing.assert_allclose(ours.predict(T), expected, atol=1e-9 * Y.std(), rtol=0)


def test_polynomial_equals_scikit_learn() -> None:
    ours = fit_polynomial(checked(X, Y, **BOX), degree=3)
    features = PolynomialFeatures(3)
    u, t = (2.0 * (points - LOW) / SPAN - 1.0 for points in (X, T))
    theirs = LinearRegression().fit(features.fit_transform(u), Y)
    expected = theirs.predict(features.transform(t))
    np.testing.assert_allclose(ours.predict(T), expected, atol=1e-9 * Y.std(), rtol=0)


def test_network_equals_scikit_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted = []
    train = MLPRegressor.fit

    def remember(self: MLPRegressor, *arguments: object, **more: object) -> MLPRegressor:
        fitted.append(train(self, *arguments, **more))
        return fitted[-1]

    monkeypatch.setattr(MLPRegressor, "fit", remember)
    ours = fit_network(checked(X, Y, **BOX), (8, 6), seed=3, validate=False)
    expected = Y.mean() + Y.std() * fitted[0].predict(2.0 * (T - LOW) / SPAN - 1.0)
    np.testing.assert_allclose(ours.predict(T), expected, atol=1e-9 * Y.std(), rtol=0)


def test_sparse_process_of_all_samples_is_the_exact_one() -> None:
    # With every sample inducing, FITC is the process itself, deviation included.
    samples = checked(X, Y, **BOX, noise=0.5)
    sparse = fit_sparse(samples, Kernel.MATERN52, inducing=len(X), starts=1)
    exact = condition(sparse.hyperparameters, X, Y, **BOX)
    mean, std = exact.predict(T, return_std=True)
    ours = sparse.predict(T, return_std=True)
    np.testing.assert_allclose(ours[0], mean, atol=1e-6 * Y.std())
    np.testing.assert_allclose(ours[1], std, atol=1e-6 * Y.std())


@pytest.mark.parametrize("name", ["cubic", "quintic", "multiquadric", "polynomial"])
def test_closed_form_leave_one_out_is_what_leaving_out_gives(name: str) -> None:
    s = member(name)
    for i in (0, 11, 30):
        rest = np.arange(len(X)) != i
        if name == "polynomial":
            again = fit_polynomial(checked(X[rest], Y[rest], **BOX), s.degree)
        else:
            again = fit_radial_basis(
                # The scale of the outputs moves a little, and with it only the rounding.
                checked(X[rest], Y[rest], **BOX),
                s.basis,
                s.epsilon,
                s.smoothing,
            )
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


@pytest.mark.parametrize("kind", ["gaussian_process", "polynomial", "radial_basis", "network"])
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


def test_auto_chooses_what_suits() -> None:
    u = (X - LOW) / SPAN
    quadratic = 1.0 + u @ [1, 2, 3] + u[:, 0] * u[:, 1]
    noisy = quadratic + 0.2 * np.random.default_rng(0).standard_normal(48)
    chosen = fit(X, noisy, **BOX, kind="auto")
    assert np.sqrt(np.mean((chosen.predict(X) - quadratic) ** 2)) < 0.15
    cubic = quadratic + np.prod(u, axis=1)
    assert type(fit(X, cubic, **BOX, kind="auto")).__name__ == "Polynomial"
    s = fit(X[:16], Y[:16], DY[:16], **BOX, kind="auto", transform="log")
    assert s.loo.q2 > 0.999


def test_log_transform_scales_noise_slopes_and_bands() -> None:
    s = fit(X, Y, DY, **BOX, transform="log", noise=0.01 * Y)
    assert s.logarithm.hyperparameters.noise_variance == pytest.approx(
        (0.01 / np.log(Y).std()) ** 2
    )
    with pytest.raises(SurrogateFitError, match="positive"):
        fit(X, Y - 60.0, **BOX, transform="log")


def test_several_outputs_have_kinds_transforms_and_noises() -> None:
    both = np.stack([Y, np.log(Y)], 1)
    one, two = fit_outputs(X, both, **BOX, kind="polynomial", transform=["log", "identity"])
    np.testing.assert_allclose(one.predict(T), np.exp(two.predict(T)), rtol=1e-12)
    assert to_casadi([one, two], std=True)(T[0])[0].shape == (2, 1)
    noisy = fit_outputs(X, both, **BOX, noise=[np.full(48, 0.1), None], starts=1)
    assert len(noisy) == 2


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
        ({"transform": "sqrt"}, "unknown transform"),
        ({"noise": [1.0, 2.0]}, "one noise or one to each"),
        ({"noise": -np.ones(48)}, "negative"),
        ({"kind": "network", "dY": DY}, "takes no gradients"),
        ({"kind": "radial_basis", "dY": DY}, "take no gradients"),
        ({"kind": "sparse_process", "dY": DY}, "takes no gradients"),
    ],
)
def test_what_cannot_be_done_is_said(options: dict, message: str) -> None:
    with pytest.raises(SurrogateFitError, match=message):
        fit(X, Y, **{**BOX, **options})
    with pytest.raises(SurrogateFitError, match="fit_outputs takes several"):
        fit(X, np.stack([Y, Y], 1), **BOX)


def test_too_many_samples_for_an_exact_process_are_named() -> None:
    many = np.random.default_rng(0).random((5001, 2))
    for kind in ("gaussian_process", "radial_basis"):
        with pytest.raises(SurrogateFitError, match="sparse_process"):
            fit(many, many.sum(1), lower=[0, 0], upper=[1, 1], kind=kind)
    with pytest.raises(SurrogateFitError, match="degree 9"):
        fit_polynomial(checked(X, Y, **BOX), degree=9)


@pytest.mark.parametrize("sparse", [False, True])  # the sparse one of 500 inducing points
def test_a_thousand_samples_of_eight_inputs_take_two_milliseconds(sparse: bool) -> None:
    P = np.random.default_rng(0).random((1000, 8))
    values = np.sin(P.sum(1))
    box = {"lower": np.zeros(8), "upper": np.ones(8)}
    if sparse:
        s = fit_sparse(checked(P[:600], values[:600], **box, noise=1e-4), inducing=500, starts=1)
    else:
        s = condition(Hyperparameters(np.full(8, 2.0), 10.0, 1e-8), P, values, **box)
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


def test_choice_names_the_errors_of_all_candidates() -> None:
    found = choose(checked(X, Y, **BOX), folds=4)
    assert set(found.errors) == {
        "gaussian_process/matern52",
        "gaussian_process/rbf",
        "polynomial",
        "network",
        "radial_basis",
    }
    assert found.errors[found.best.name].rms == min(e.rms for e in found.errors.values())
    with_gradients = choose(checked(X[:16], Y[:16], **BOX, dY=DY[:16]), folds=4)
    assert set(with_gradients.errors) == {
        "gaussian_process/matern52",
        "gaussian_process/rbf",
        "polynomial",
    }


@pytest.mark.slow
def test_many_samples_go_through_a_sparse_process() -> None:
    P = design("lhs", np.zeros(4), np.ones(4), 6000, seed=1)
    unseen = design("lhs", np.zeros(4), np.ones(4), 500, seed=2)
    s = fit(P, np.sin(3 * P.sum(1)), lower=np.zeros(4), upper=np.ones(4), kind="auto")
    assert type(s).__name__ in ("SparseProcess", "Polynomial", "Network")
    assert np.abs(s.predict(unseen) - np.sin(3 * unseen.sum(1))).max() < 1e-3
