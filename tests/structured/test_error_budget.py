"""Error budgets: Lyapunov's equation, the integral over frequency and a simulation are one."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from oracles.differences import difference
from oracles.fixed_structure_loops import FAST, LATE, SLOW, loop, plant
from scipy.linalg import expm
from scipy.signal import lfilter

from ccd_casadi.budget import evaluation
from ccd_casadi.budget.error_density import integrate_densities
from ccd_casadi.budget.evaluation import (
    COMPLEX_STEP,
    ErrorVariance,
    evaluate_budget,
    of_source,
    variances,
)
from ccd_casadi.budget.noise_process import (
    Process,
    average_gain,
    average_matrix,
    noise_of_a_period,
    process,
    run_matrix,
)
from ccd_casadi.budget.sources import (
    ErrorBudget,
    ErrorSource,
    ShapedSpectrum,
    SourceKind,
    TabulatedSpectrum,
)
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Loop, Sampling, delay_parts
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array

WINDOW = 0.02


class Variances(NamedTuple):
    """σ² of error (m²), of its moving average over the window (NaN without one), of force (N²)."""

    error: float
    average: float
    force: float


def by_lyapunov(made: Loop, source: ErrorSource, window: float | None) -> Variances:
    """Of a shaped source."""
    return Variances(*map(float, of_source(made, source, window)))


SHAPED = (
    ErrorSource("cable", SourceKind.FORCE, ShapedSpectrum(1e-4)),
    ErrorSource("amplifier", SourceKind.FORCE, ShapedSpectrum(1e-2, (), ((20.0, 0.3),))),
    ErrorSource("floor", SourceKind.FLOOR_MOTION,
           ShapedSpectrum(1e-14, ((1.0,),), ((3.0,), (30.0, 0.5))), (0.0, 10.0, 1e4)),
    ErrorSource("floor accelerating", SourceKind.FLOOR_MOTION,
           ShapedSpectrum(1e-8, (), ((30.0, 0.5),)), (60.0, 0.0, 0.0), of_acceleration=True),
    ErrorSource("encoder", SourceKind.SENSOR_NOISE, ShapedSpectrum(1e-20)),
    ErrorSource("encoder's filter", SourceKind.SENSOR_NOISE,
                ShapedSpectrum(1e-18, (), ((500.0,),))),
    ErrorSource("setpoint", SourceKind.SETPOINT, ShapedSpectrum(1e-10, (), ((2.0, 0.7),))),
)  # fmt: skip
TABLES = tuple(
    ErrorSource(kind.value, kind, TabulatedSpectrum((1.0, 10.0, 15.0, 400.0), density),
           (3.0, 10.0, 1e4) if kind is SourceKind.FLOOR_MOTION else (0.0, 0.0, 0.0))
    for kind, density in (
        (SourceKind.FORCE, (1e-3, 1e-2, 1e-2, 1e-5)),
        (SourceKind.FLOOR_MOTION, (1e-15, 1e-14, 1e-16, 1e-18)),
        (SourceKind.SENSOR_NOISE, (1e-18, 1e-19, 1e-19, 1e-20)),
        (SourceKind.SETPOINT, (1e-9, 1e-10, 1e-10, 1e-14)),
    )
)  # fmt: skip


def doubled(source: ErrorSource) -> ErrorSource:
    """With twice the amplitude."""
    if isinstance(source.spectrum, ShapedSpectrum):
        return replace(source, spectrum=replace(source.spectrum, level=4.0 * source.spectrum.level))
    density = tuple(4.0 * value for value in source.spectrum.density)
    return replace(source, spectrum=replace(source.spectrum, density=density))


def built(
    sampling: Sampling | None, seed: int = 1, structure: Structure | None = None
) -> tuple[Loop, Structure, Array]:
    """A stable loop in SI of case study 1 with a random controller, and its parameters."""
    structure = Structure() if structure is None else structure
    problem, kappa = loop(seed, structure, sampling)
    P = problem.plants
    kappa = structure.in_units(kappa, P.omega_0, P.force)
    hold = sampling
    return Loop(plant().plant_si(), structure.state_space(kappa), hold), structure, kappa


@pytest.mark.parametrize("sampling", [None, FAST, SLOW])
def test_lyapunov_equals_the_integral_over_frequency(sampling: Sampling | None) -> None:
    """Parseval: error, moving average and force."""
    made, _, _ = built(sampling)
    period = None if sampling is None else sampling.period
    for source in SHAPED:
        found = by_lyapunov(made, source, WINDOW)
        whole = integrate_densities(made, source, lambda hz: average_gain(hz, WINDOW, period))
        expected = [whole.value[0], whole.value[2], whole.value[1]]
        np.testing.assert_allclose(
            [found.error, found.average, found.force], expected, rtol=1e-9, err_msg=source.name
        )


@pytest.mark.parametrize("sampling", [None, LATE])
def test_a_dense_table_of_a_filter_has_the_filters_budget(sampling: Sampling | None) -> None:
    """Between tables and filters lie only the straight lines between a table's points."""
    made, _, _ = built(sampling)
    for source in SHAPED[1:3]:
        hz = np.geomspace(1e-2, 1e4, 500)
        table = TabulatedSpectrum(tuple(hz), tuple(source.spectrum.at(hz)))
        other = replace(source, spectrum=table)
        pair = [evaluate_budget(made, ErrorBudget((one,), WINDOW)) for one in (source, other)]
        figures = [[one.error, one.average, one.deviation, one.force] for one in pair]
        np.testing.assert_allclose(figures[1], figures[0], rtol=1e-3)


@pytest.mark.parametrize(
    ("sampling", "sources"),
    [(None, SHAPED), (LATE, SHAPED), (SLOW, SHAPED[:3]), (None, TABLES[:2]), (LATE, TABLES[2:])],
)
def test_derivatives_to_controller_and_plant(
    sampling: Sampling | None, sources: tuple[ErrorSource, ...]
) -> None:
    made, structure, kappa = built(sampling)
    budget, scaled, n = ErrorBudget(sources), plant(), len(kappa)
    parts = structure.state_spaces(kappa + 1j * COMPLEX_STEP * np.eye(n + 1, n, -1))

    def moved(x: Array) -> StateSpace:
        G = made.plant
        return StateSpace(
            *(part + x[0] * first + x[1] * second for part, first, second
              in zip((G.A, G.B, G.C), *scaled.changes_si(), strict=True)), G.D)  # fmt: skip

    plants = [moved(1j * COMPLEX_STEP * one) for one in np.eye(2)]
    variance = ErrorVariance(made.plant, budget, made.sampling, len(made.controller.A))
    found = variance.at(parts, run_matrix(parts, made.period), plants)
    assert found is not None
    whole = variances(made, budget)
    assert whole is not None
    assert found[0] == pytest.approx(whole[0], rel=1e-9)
    way = np.random.default_rng(5).normal(size=n + 2) / np.sqrt(n + 2)

    def at(h: float) -> Array:
        K = structure.state_space(kappa + h * way[:n])
        value = variances(Loop(moved(h * way[n:]), K, made.sampling), budget)
        assert value is not None
        return np.log(value[:1])

    expected = found[1] @ way / found[0]
    np.testing.assert_allclose(expected, difference(at, 2e-3)[0], atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("sampling", [FAST, SLOW])
def test_the_sampled_loop_equals_one_that_is_run_in_fine_steps(sampling: Sampling) -> None:
    """Covariances propagated over twenty substeps a period, forces switched as they arrive.

    An independent path: no Van Loan, no doubling, forces held by an explicit queue.
    """
    made, _, _ = built(sampling)
    assert made.sampling is not None
    T, steps = sampling.period, 20
    whole, rest = delay_parts(T, made.sampling.delay)
    for source in (SHAPED[0], SHAPED[1]):
        model = process(made, source)
        moved = model.A + np.eye(len(model.A))
        P = _settled(moved, model.noise)
        found = by_lyapunov(made, source, None)
        np.testing.assert_allclose(np.trace(model.C @ P @ model.C.T), found.error, rtol=1e-8)
        f = source.shaping()
        A = np.block([[made.plant.A, made.plant.B @ f.C], [np.zeros((len(f.A), 4)), f.A]])
        W = np.vstack([made.plant.B @ f.D, f.B])
        # Simpson's rule for the noise of a period, with matrix exponentials at its points.
        points = np.linspace(0.0, T, 2 * steps + 1)
        weights = np.array([1.0, *([4.0, 2.0] * steps)[:-1], 1.0]) * T / (6.0 * steps)
        Q = sum(w * expm(A * t) @ W @ W.T @ expm(A * t).T / 2.0
                for t, w in zip(points, weights, strict=True))  # fmt: skip
        np.testing.assert_allclose(noise_of_a_period(A, W, T), Q, rtol=1e-6, atol=1e-9 * Q.max())
        # One free run of the loop from a state, in substeps, against the model's A.
        rng = np.random.default_rng(0)
        state = rng.normal(size=len(model.A))
        n, nk = len(A), len(made.controller.A)
        x, k, old = state[:n], state[-nk:], list(state[n:-nk])
        half = np.eye(nk) - 0.5 * T * made.controller.A
        e = float(-(made.plant.C @ x[:4])[0])
        # (k_n + k_{n+1})/2
        middle = np.linalg.solve(half, k + 0.5 * T * made.controller.B[:, 0] * e)
        u = float((made.controller.C @ middle)[0] + made.controller.D[0, 0] * e)
        queue = [u, *old]
        B = np.append(made.plant.B[:, 0], np.zeros(len(f.A)))
        for length, force in ((rest, whole + 1), (T - rest, whole)):
            if length > 0.0:
                held = np.block([[A, B[:, None]], [np.zeros((1, n + 1))]])
                drive = expm(held * length)[:n, n]
                x = expm(A * length) @ x + drive * queue[force]
        after = np.concatenate([x, queue[: len(old)]])
        # the controller's state is scaled by Tustin's T/2
        np.testing.assert_allclose((moved @ state)[:-nk], after, rtol=1e-9)


def _settled(A: Array, Q: Array) -> Array:
    """Σ A^k Q A'^k by doubling: a covariance without Lyapunov's equation."""
    P = Q
    for _ in range(60):
        P, A = P + A @ P @ A.T, A @ A
        if np.abs(A).max() < 1e-200:
            break
    return P


@pytest.mark.parametrize("sampling", [FAST, SLOW])
def test_rms_equals_a_simulation_within_its_statistical_error(sampling: Sampling) -> None:
    """10⁵ samples; six standard errors by the correlation of e², a Gaussian process."""
    made, _, _ = built(sampling, structure=Structure(biquads=0))
    for seed, source in enumerate((SHAPED[0], SHAPED[4], SHAPED[6])):
        model = process(made, source)
        mean, error = simulated(model, 100_000, seed)
        found = by_lyapunov(made, source, None)
        assert abs(mean - found.error) < 6.0 * error
        assert error < 0.2 * found.error


def simulated(model: Process, count: int, seed: int, parts: int = 50) -> tuple[float, float]:
    """Mean of e² over a run of the process in its eigenvectors, and its standard error."""
    rng = np.random.default_rng(seed)
    moved = model.A + np.eye(len(model.A))
    noise = rng.normal(size=(count, len(moved))) @ _root(model.noise).T
    start = _root(_settled(moved, model.noise)) @ rng.normal(size=len(moved))
    poles, V = np.linalg.eig(moved)
    driven, first, out = noise @ np.linalg.inv(V).T, np.linalg.solve(V, start), model.C[0] @ V
    e = sum(c * lfilter([0.0, 1.0], [1.0, -p], part, zi=[x])[0]
            for c, p, part, x in zip(out, poles, driven.T, first, strict=True))  # fmt: skip
    batches = (e.real**2).reshape(parts, -1).mean(1)
    return float(batches.mean()), float(batches.std(ddof=1) / np.sqrt(parts))


def _root(Q: Array) -> Array:
    """R with R R' = Q, by the correlations: states of small noise keep their digits."""
    size = np.sqrt(np.diag(Q))
    size[size == 0.0] = 1.0
    values, vectors = np.linalg.eigh(Q / size / size[:, None])
    return size[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))


def test_moving_average_and_deviation_share_the_variance() -> None:
    """Over a window of one sample all is average, over an endless one nothing is; between falls."""
    made, _, _ = built(FAST)
    T = FAST.period
    source = SHAPED[0]
    whole = by_lyapunov(made, source, T)
    np.testing.assert_allclose(whole.average, whole.error, rtol=1e-12)
    averages = [by_lyapunov(made, source, window).average for window in (1e-3, 1e-2, 1e-1, 1e4)]
    assert (np.diff(averages) < 0.0).all()
    assert averages[-1] < 1e-3 * whole.error
    slow = by_lyapunov(Loop(made.plant, made.controller), source, 1e-9)
    np.testing.assert_allclose(slow.average, slow.error, rtol=1e-9)


def test_the_matrix_of_the_moving_average_is_its_sum() -> None:
    A = np.array([[0.9, 0.2], [-0.1, 0.7]])
    N = 7
    expected = N * np.eye(2)
    for j in range(1, N):
        expected += 2.0 * (N - j) * np.linalg.matrix_power(A, j)
    found = average_matrix(A - np.eye(2), 0.07, 0.01)
    np.testing.assert_allclose(found, expected / N**2, rtol=1e-13)


def test_sources_add_in_squares_and_scale() -> None:
    made, _, _ = built(None)
    whole = evaluate_budget(made, ErrorBudget((*SHAPED, *TABLES), WINDOW))
    assert whole is not None
    squares = sum(item.error**2 for item in whole.sources)
    np.testing.assert_allclose(whole.error**2, squares, rtol=1e-12)
    np.testing.assert_allclose(whole.error**2, whole.average**2 + whole.deviation**2, rtol=1e-9)
    for item in whole.sources:
        assert (np.diff(item.cumulative) >= 0.0).all()
        np.testing.assert_allclose(np.sqrt(item.cumulative[-1]), item.error, rtol=1e-6)
    twice = ErrorBudget(tuple(map(doubled, (*SHAPED, *TABLES))), WINDOW)
    double = evaluate_budget(made, twice)
    assert double is not None
    np.testing.assert_allclose([double.error, double.force], [2 * whole.error, 2 * whole.force])


def test_white_noise_that_reaches_the_force_undamped_has_no_rms() -> None:
    made, _, _ = built(None, structure=Structure(roll_off=0))
    found = by_lyapunov(made, SHAPED[4], None)
    assert np.isinf(found.force)
    assert np.isfinite(found.error)


def test_an_unstable_loop_has_no_budget() -> None:
    made, _, _ = built(None)
    K = made.controller
    wrong = Loop(made.plant, StateSpace(K.A, K.B, -K.C, -K.D))
    assert (wrong.poles.real > 0.0).any()
    assert evaluate_budget(wrong, ErrorBudget(SHAPED)) is None


@pytest.mark.parametrize("wrong", [
    lambda: TabulatedSpectrum((1.0,), (1.0,)),
    lambda: TabulatedSpectrum((2.0, 1.0), (1.0, 1.0)),
    lambda: TabulatedSpectrum((1.0, 2.0), (1.0, 0.0)),
    lambda: ShapedSpectrum(0.0),
    lambda: ShapedSpectrum(1.0, (), ((1.0, -0.1),)),
    lambda: ErrorSource("floor", SourceKind.FLOOR_MOTION, ShapedSpectrum(1.0)),
    lambda: ErrorSource("floor", SourceKind.FLOOR_MOTION, ShapedSpectrum(1.0), (1.0, 0.0, 0.0)),
    lambda: ErrorSource("force", SourceKind.FORCE, ShapedSpectrum(1.0), (1.0, 0.0, 0.0)),
    lambda: ErrorSource("setpoint", SourceKind.SETPOINT, ShapedSpectrum(1.0)),
    lambda: ErrorBudget(()),
    lambda: ErrorBudget(SHAPED, 0.0),
])  # fmt: skip
def test_what_makes_no_sense_is_refused(wrong: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match=r"need|give|have to|has to"):
        wrong()


@pytest.mark.parametrize("found", [0.2, -0.3, 1.0])
def test_where_lyapunov_s_equation_has_no_digits_the_integral_counts(
    found: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ẍ + 2ẋ + x = w, w white of 1 N²/Hz: σ² = 1/8. States 13 decades apart, as of an amplifier
    before a loop of 3 kHz, left the equation an error of 40 %, or less than nothing."""
    mass = StateSpace(np.array([[0.0, 1.0], [-1.0, -2.0]]), np.eye(2, 1, -1), np.eye(1, 2),
                      np.zeros((1, 1)))  # fmt: skip
    none = StateSpace(*(np.zeros((i, j)) for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))))
    white = ErrorBudget((ErrorSource("cable", SourceKind.FORCE, ShapedSpectrum(1.0)),))
    monkeypatch.setattr(evaluation, "of_source", lambda *_: np.array([found, np.nan, 0.0]))
    figures = evaluate_budget(Loop(mass, none), white)
    assert figures is not None
    assert figures.by_integral
    assert figures.error**2 == pytest.approx(0.125, rel=1e-6)
