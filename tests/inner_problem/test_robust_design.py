"""Robust co-design: the peak of S over a set of perturbed plants, and what it is worth."""

import json
from pathlib import Path

import numpy as np
import pytest
from oracles.helpers import (
    HZ,
    OMEGA_LOW,
    SUSPENSION,
    log_uniform,
    problem,
    random_plant,
    two_mass_model,
)

from ccd_casadi.cases.case import case_to_toml, load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.inner_problem.controller_problem import RobustSet
from ccd_casadi.inner_problem.problem import CoDesignProblem, scaled_plant, true_design
from ccd_casadi.plants.modal import Perturbation, modal_plant
from ccd_casadi.plants.plant import Plant, mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.sampling.units import problem_hash
from ccd_casadi.solve import main
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.derivatives import Sensitivities, sensitivities
from ccd_casadi.synthesis.synthesis import DesignFigures, Outcome, sweep, synthesise
from ccd_casadi.synthesis.weights import Weights

RUNS = Path(__file__).parents[2] / "runs"
ROBUST = RobustSet(0.03, 5, (), -0.03)


def shifted(plant: Plant, theta: tuple[float, ...], shift: float, damping: float = 1.0):
    return modal_plant(mechanics(plant, theta), SUSPENSION, Perturbation(shift, damping))


@pytest.mark.parametrize(("modal", "factor"), [(True, 2.1), (False, 2.0)])
def test_a_shift_moves_frequencies_and_damping_and_no_rigid_body(
    modal: bool, factor: float
) -> None:
    """A shift of 5 % and double damping: of the ratio, or of the matrix that is given."""
    plant = random_plant(5, rigid=1, flexible=3, inputs=1, outputs=1, modal=modal)
    model, moved = shifted(plant, (0.3, 0.7), 0.0), shifted(plant, (0.3, 0.7), 0.05, 2.0)
    flexible = ~model.rigid
    K, D = np.diag(model.K), np.diag(model.D)
    assert np.diag(moved.K)[flexible] == pytest.approx(1.05**2 * K[flexible], rel=1e-14)
    assert np.diag(moved.D)[flexible] == pytest.approx(factor * D[flexible], rel=1e-14)
    assert (np.diag(moved.K)[model.rigid] == K[model.rigid]).all()
    assert np.diag(moved.D)[model.rigid] == pytest.approx(D[model.rigid], rel=1e-9)
    assert moved.natural[flexible] == pytest.approx(1.05 * model.natural[flexible], rel=1e-14)


@pytest.mark.parametrize("modal", [True, False])
def test_derivatives_of_a_perturbed_plant(modal: bool) -> None:
    """Against differences of the transfer function, which knows no coordinates."""
    plant = random_plant(7, rigid=2, flexible=3, inputs=2, outputs=2, modal=modal)
    theta, h = np.array([0.4, 0.6]), 1e-5
    s = 2j * np.pi * 60.0

    def response(at: np.ndarray) -> np.ndarray:
        q = shifted(plant, tuple(at), 0.04, 1.5)
        return q.C @ np.linalg.solve(s**2 * np.eye(len(q.K)) + s * q.D + q.K, q.B)

    q = shifted(plant, tuple(theta), 0.04, 1.5)
    Z = np.linalg.inv(s**2 * np.eye(len(q.K)) + s * q.D + q.K)
    for i in range(2):
        e = h * np.eye(2)[i]
        numeric = (response(theta + e) - response(theta - e)) / (2.0 * h)
        dZ = -Z @ (s**2 * q.dM[i] + s * q.dD[i] + q.dK[i]) @ Z
        exact = q.dC[i] @ Z @ q.B + q.C @ dZ @ q.B + q.C @ Z @ q.dB[i]
        assert exact == pytest.approx(numeric, rel=1e-6, abs=1e-7 * np.abs(numeric).max())


def robust_problem(robust: RobustSet | None) -> CoDesignProblem:
    return problem(robust=robust)


@pytest.mark.parametrize(
    "robust", [ROBUST, RobustSet(0.01, 3, (0.5, 2.0), 0.0), RobustSet(0.0, 1, (0.7,), 0.0)]
)
def test_total_derivatives_over_a_set(robust: RobustSet) -> None:
    """The controller is that of one plant, ω_b of another, the peak of a third."""
    case = robust_problem(robust)
    x = np.array([57.0, 58.0, np.log(40.0 * HZ), np.log(30.0 * HZ)])

    def at(point: np.ndarray) -> Sensitivities:
        return true_design(case, tuple(point[:2]), *np.exp(point[2:]))

    design = at(x)
    assert design.figures.certified
    exact = np.hstack([design.to_theta, design.to_break_frequencies])
    for i in range(4):
        e = 5e-4 * np.eye(4)[i] * max(1.0, abs(x[i]) / 10.0)
        # gamma_opt is known to 5e-11, so that steps are long, and their own error is taken off
        near, far = ((at(x + n * e).values - at(x - n * e).values) / (2.0 * n * e[i])
                     for n in (1.0, 2.0))  # fmt: skip
        numeric = (4.0 * near - far) / 3.0
        assert exact[:, i] == pytest.approx(numeric, rel=2e-5, abs=1e-6 * np.abs(exact).max())


def test_derivatives_with_several_channels() -> None:
    """2 x 2, ω_0 itself moving with θ.

    The gain's weak direction is 1/200 of the strong one: a plant rounded to 1e-14 moves γ_opt by
    8e-10 here, whatever finds it. That is 1.6e-3 of a difference with a step of 1e-5, and 1.6e-5
    of one with 1e-3, whose own error is 4e-7.
    """
    plant = random_plant(3, rigid=2, flexible=2, inputs=2, outputs=2)
    M_K = 2e4
    weights = Weights(
        M_S=2.0, A_S=1e-4, omega_S=1.0 * HZ, c_K=1e4, omega_K=100.0 * HZ, M_K=M_K,
        A_l=1.0, A_u=1e-2, omega_T=10.0 * HZ,
    )  # fmt: skip
    theta = np.array([0.4, 0.6])

    def family(at: np.ndarray) -> ScaledPlant:
        made = [scale_plant(shifted(plant, tuple(at), s), M_K) for s in (0.0, -0.01, 0.01)]
        return ScaledPlant(**(vars(made[0]) | {"family": tuple(made[1:])}))

    def at(point: np.ndarray) -> Sensitivities:
        return sensitivities(family(point), weights, omega_low=OMEGA_LOW)

    design = at(theta)
    assert design.figures.certified
    h = 1e-3
    for i in range(2):
        e = h * np.eye(2)[i]
        up, down = at(theta + e), at(theta - e)
        numeric = (up.values - down.values) / (2.0 * h)
        exact = design.to_theta[:, i]
        assert exact == pytest.approx(numeric, rel=1e-4, abs=1e-6 * np.abs(exact).max())


def test_a_set_of_the_model_alone_changes_nothing() -> None:
    alone, nominal = robust_problem(RobustSet(0.0, 1, (), 0.0)), robust_problem(None)
    rng = np.random.default_rng(2)
    for _ in range(5):
        theta = tuple(rng.uniform(55.0, 70.0, 2))
        point = (log_uniform(rng, 50.0, 1500.0) * HZ, log_uniform(rng, 25.0, 200.0) * HZ)
        a, b = true_design(alone, theta, *point), true_design(nominal, theta, *point)
        assert (a.values == b.values).all()
        assert a.to_theta == pytest.approx(b.to_theta, rel=1e-9)
        assert a.to_break_frequencies == pytest.approx(b.to_break_frequencies, rel=1e-9, abs=1e-9)
        assert a.fixed_controller == pytest.approx(b.fixed_controller, rel=1e-12)


def test_stored_samples_of_nominal_cases_keep_their_names() -> None:
    """Hashes are what they were before there were robust cases, the numerics' version aside."""
    case = problem_of(load_case(RUNS / "two_mass.toml"))
    assert problem_hash(case.identity() | {"numerics": 4}) == (
        "fa46f39d5ab080e38ddac4477fc3833c3bfa2eae37b14997496eeee47860fb7f"
    )
    assert problem_hash(case.inner_identity()) == (
        "8e340232fa168fce65fdde47cf849ae864d0f195318f80797654b1548ad7cecc"
    )
    names = {problem_hash(robust_problem(r).identity()) for r in (None, ROBUST)}
    assert len(names) == 2


def test_the_section_survives_being_written(tmp_path: Path) -> None:
    path = tmp_path / "case.toml"
    text = (RUNS / "two_mass.toml").read_text()
    path.write_text(text + "\n[robust]\nresonance_shift = 0.03\ndamping = [0.5, 2]\n")
    case = load_case(path)
    assert problem_of(case).robust == RobustSet(0.03, 5, (0.5, 2.0), None)
    ends = {"low": -0.03, "nominal": 0.0, "high": 0.03}
    for name, shift in ends.items():
        path.write_text(text + f'\n[robust]\nresonance_shift = 0.03\ndesign_at = "{name}"\n')
        assert problem_of(load_case(path)).robust == RobustSet(0.03, 5, (), shift)
    path.write_text(text + "\n[robust]\nresonance_shift = 0.03\ndamping = [0.5, 2]\n")
    path.write_text(case_to_toml(case))
    assert load_case(path).robust == case.robust


def test_one_unstable_plant_spoils_the_design_and_no_more() -> None:
    """The nominal optimum, asked of the set: a reason, no figure to be used, in a sweep too."""
    case = robust_problem(RobustSet(0.03, 3, (), 0.0))
    plant = scaled_plant(case, (55.0, 55.0))
    weights = case.weights.at(1800.0 * HZ, 26.07 * HZ)
    made = synthesise(plant, weights, omega_low=OMEGA_LOW)
    assert made.figures.outcome is Outcome.NOT_ROBUST
    assert not case.inner.feasible(made.figures)
    design = true_design(case, (55.0, 55.0), weights.omega_S, weights.omega_T)
    assert np.isnan(design.to_theta).all()
    rows = sweep(plant, weights, HZ * np.array([20.0, 1800.0]), [26.07 * HZ], omega_low=OMEGA_LOW)
    assert [row.outcome for row in rows] == [Outcome.CERTIFIED, Outcome.NOT_ROBUST]


def over_shifts(run: FinishedRun, count: int = 61) -> list[DesignFigures]:
    """The run's controller on ±3 %, by plants built here."""
    system = two_mass_model()
    found = []
    for shift in np.linspace(-0.03, 0.03, count):
        plant = scale_plant(shifted(system, run.theta, float(shift)), run.weights.M_K)
        low = run.problem.inner.omega_low
        found.append(measure(plant, run.controller, run.weights, omega_low=low))
    return found


@pytest.mark.slow  # a whole robust co-design; CI has the tutorial's
def test_robust_co_design_of_case_study_1(two_mass_run: Path, tmp_path: Path) -> None:
    """‖S‖∞ <= S_max over ±3 % for 40.06 Hz instead of 72.05; the nominal design is not stable."""
    path = tmp_path / "robust.toml"
    path.write_text((RUNS / "two_mass.toml").read_text() + "\n[robust]\nresonance_shift = 0.03\n")
    options = ["--formulation", "lifted", "--workers", "1", "--quiet"]
    assert main([str(path), *options]) == 0
    result = json.loads((tmp_path / "robust" / "result.json").read_text())
    assert result["bandwidth_hz"] == pytest.approx(40.0585, abs=2e-3)
    assert result["kkt"]["stationarity"] < 1e-6
    run = read_run(tmp_path / "robust")
    figures = over_shifts(run)
    assert all(f.certified for f in figures)
    peaks = [f.sensitivity_peak for f in figures]
    assert max(peaks) == pytest.approx(result["robust"]["worst_sensitivity_peak"], rel=1e-6)
    assert max(peaks) <= 1.75 * (1.0 + 1e-6)
    (required,) = (one for one in result["requirements"] if one["name"] == "S_max")
    assert required["achieved"] == pytest.approx(max(peaks), rel=1e-6)  # of the set
    assert required["evidence"] == "searched"
    assert run.figures.sensitivity_peak == pytest.approx(
        result["robust"]["nominal_sensitivity_peak"], rel=1e-9
    )
    nominal = over_shifts(read_run(two_mass_run))
    assert sum(f.certificate.stable for f in nominal) < len(nominal)
    assert not nominal[0].certificate.stable
    assert nominal[-1].sensitivity_peak > 1.75


@pytest.mark.slow  # a whole robust co-design; CI has the tutorial's
def test_what_no_robust_design_meets_is_infeasible(tmp_path: Path, capsys) -> None:
    path = tmp_path / "robust.toml"
    text = (RUNS / "two_mass.toml").read_text().replace("S_max = 1.75", "S_max = 1.3")
    path.write_text(text + "\n[robust]\nresonance_shift = 0.03\nshifts = 2\n")
    options = ["--formulation", "lifted", "--workers", "1", "--quiet"]
    assert main([str(path), *options]) == 3
    err = capsys.readouterr().err
    assert len(err.splitlines()) == 1
    for words in ("none found", "where S_max = 1.3 is required", "is not proven", "[robust]"):
        assert words in err
    assert "cannot" not in err


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("resonance_shift = -0.1", "robust.resonance_shift"),
        ("resonance_shift = 0.9", "robust.resonance_shift"),
        ("shifts = 1", "robust.shifts"),
        ("damping = [0.0]", "robust.damping"),
        ('design_at = "middle"', "robust.design_at"),
    ],
)
def test_a_wrong_value_is_named(tmp_path: Path, line: str, words: str, capsys) -> None:
    path = tmp_path / "case.toml"
    path.write_text((RUNS / "two_mass.toml").read_text() + f"\n[robust]\n{line}\n")
    assert main([str(path), "--quiet"]) == 2
    assert words in capsys.readouterr().err
