"""The stage in the design loop: case file, true quantities through the elements, references."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.cases.case import CaseError, load_case, parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.final_judgement import check_on
from ccd_casadi.extensions.rib_stage.geometry import NAMES
from ccd_casadi.extensions.rib_stage.stage_plant import rib_stage
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant, true_design
from ccd_casadi.plants.plant import constraint_values, hardware_cost, mechanics
from ccd_casadi.studies.comparison import design_hardware, first_resonance
from ccd_casadi.synthesis.synthesis import Outcome, synthesise

HZ = 2.0 * np.pi
FILE = Path(__file__).parents[2] / "runs" / "rib_stage.toml"
THETA_B = np.array([1e-3, 3e-3, 4.2446e-3, 4.0588e-3, 11.917e-3, 74.974e-3])


def stage_problem(**options: object) -> CoDesignProblem:
    """The shipped case on the coarse mesh: 0.2 s an evaluation."""
    case = load_case(FILE)
    section = replace(case.plant, options=case.plant.options | {"mesh": "coarse"} | options)
    return problem_of(replace(case, plant=section))


@pytest.fixture(scope="module")
def problem() -> CoDesignProblem:
    return stage_problem()


def test_the_shipped_case_is_the_papers_problem() -> None:
    case = load_case(FILE)
    assert tuple(p.name for p in case.theta) == NAMES
    assert (case.objective.w1, case.objective.w2, case.weights.M_K) == (0.9994, -0.0333, 4.5e4)
    assert case.plant.options["mesh"] == "shipped"


def test_mass_and_bays_are_closed_forms(problem: CoDesignProblem) -> None:
    plant = plant_of(problem)
    assert hardware_cost(plant, THETA_B) == pytest.approx(0.59, abs=2e-4)
    assert plant.constraint_names == ("bay_1", "bay_2")
    # outer bay 150 - 74.974 - 3 - 2.1223 mm, inner bay 74.974 - 2.1223 - 2.0294 mm; 8 mm least
    expected = [1.0 - 69.9037 / 8.0, 1.0 - 70.8223 / 8.0]
    np.testing.assert_allclose(constraint_values(plant, THETA_B), expected, atol=1e-4)


def test_theta_may_come_in_any_order() -> None:
    order = [3, 0, 5, 1, 4, 2]
    plain = rib_stage(NAMES, mesh="coarse")
    mixed = rib_stage([NAMES[i] for i in order], mesh="coarse")
    one, other = mechanics(plain, THETA_B), mechanics(mixed, THETA_B[order])
    np.testing.assert_array_equal(one.K, other.K)
    for ours, theirs in zip(one.derivatives, other.derivatives, strict=True):
        np.testing.assert_array_equal(ours[order], theirs)
    assert hardware_cost(mixed, THETA_B[order]) == pytest.approx(hardware_cost(plain, THETA_B))


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("mesh", "huge", "choose one of coarse, shipped, fine"),
        ("outputs", "twist", "choose one of"),
        ("modes", 12, "choose 10, 20 or 44"),
        ("poisson", 0.5, "between 0 and 0.5"),
        ("rib_count", 3, "is not an option of rib_stage"),
        ("actuators", [[0.15, 0.15]], "not lie on one line"),
        ("actuators", [[0.15]], "give a list of rows of 2 numbers"),
        ("actuators", 3, "give a list of rows of 2 numbers"),
        ("modes", [10], "choose 10, 20 or 44"),
        ("sensors", [[0.2, 0.1], [0.1, 0.1], [0.0, 0.1]], "off the stage"),
        ("point_masses", [[0.1, 0.1, "a"]], "give a list of rows of 3 numbers"),
        ("point_masses", [[0.1, 0.1, -0.1]], "give a number above 0"),
        ("point_masses", [[0.3, 0.1, 0.1]], "off the stage"),
    ],
)
def test_a_wrong_option_is_one_line_with_a_remedy(key: str, value: object, words: str) -> None:
    case = load_case(FILE)
    document = {
        "plant": {"model": "rib_stage", "outputs": "rigid", key: value},
        "theta": {p.name: {"lower": p.lower, "upper": p.upper} for p in case.theta},
        "objective": vars(case.objective),
        "weights": {key: v for key, v in vars(case.weights).items() if v is not None},
        "inner": {key: v for key, v in vars(case.inner).items() if v is not None},
    }
    with pytest.raises(CaseError) as caught:
        problem_of(parse_case(document, FILE))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_total_derivatives_reach_through_the_elements(problem: CoDesignProblem) -> None:
    """ω_b, ln‖S‖∞, ln|S(jω_low)| and γ_opt to all six lengths, against differences.

    Rounding of the assembled stiffness moves a mode's ω² by up to 3.5e-9 of it, and γ_opt by 3e-10,
    with the eigen-solver's tolerance at 1e-11 as at 0. At a step of 1e-3 that is up to 3.3e-5 of a
    slope; at 1e-2 it is a tenth, and the differences' own error is 3.4e-6.
    """
    omega = HZ * 600.0, HZ * 40.0
    theta = THETA_B * [1.3, 1.3, 1.2, 1.1, 1.05, 1.03]
    design = true_design(problem, tuple(theta), *omega)
    assert design.figures.certified
    along = theta * np.random.default_rng(7).uniform(-1.0, 1.0, 6)  # all six at once
    step = 1e-2

    def moved(share: float) -> np.ndarray:
        return true_design(problem, tuple(theta + share * step * along), *omega).values

    near, far = moved(1.0) - moved(-1.0), moved(2.0) - moved(-2.0)
    slope = (8.0 * near - far) / (12.0 * step)
    np.testing.assert_allclose(design.to_theta @ along, slope, rtol=1e-5)


def test_the_references_judge_the_same_controller(problem: CoDesignProblem) -> None:
    """Ten modes hide what twenty show: the light stage is stable there, its norm is not kept."""
    theta = (1e-3, 3e-3, 3e-3, 3e-3, 7.29e-3, 95e-3)
    design = synthesise(
        scaled_plant(problem, theta),
        problem.weights.at(HZ * 1067.0, HZ * 35.0),
        omega_low=problem.inner.omega_low,
    )
    plant = plant_of(problem)
    more = plant.references["20 flexible modes"](theta)
    found = check_on(problem, more, design, "20 flexible modes")
    assert found.outcome is Outcome.NORM_EXCEEDED
    assert not found.certified
    assert found.figures.certificate.stable
    assert found.figures.sensitivity_peak > 2.0 > 1.6 > design.figures.sensitivity_peak
    assert found.figures.bandwidth == pytest.approx(design.figures.bandwidth, rel=0.01)
    itself = check_on(problem, plant.evaluate(theta), design, "itself")
    assert itself.certified
    assert itself.outcome is Outcome.CERTIFIED
    # the norm of an all but flat loop, each time on a grid around poles found anew
    assert itself.figures.gamma == pytest.approx(design.figures.gamma, rel=1e-5)
    assert itself.figures.sensitivity_peak == pytest.approx(
        design.figures.sensitivity_peak, rel=1e-8
    )


@pytest.mark.slow
def test_the_least_mass_at_a_first_resonance(problem: CoDesignProblem) -> None:
    hardware = design_hardware(problem, HZ * 250.0, starts=0)
    assert hardware.met
    omega, slope = first_resonance(problem, np.array(hardware.theta))
    assert omega / HZ == pytest.approx(250.0, abs=1e-3)
    assert hardware.hardware_cost == pytest.approx(0.9236, abs=1e-3)  # coarse: 6 % too stiff
    h, _, t_i, t_c, H, x_i = hardware.theta
    np.testing.assert_allclose([h, t_i, t_c, x_i], [1e-3, 8e-3, 8e-3, 67.5e-3], rtol=1e-6)
    assert 6e-3 < H < 20e-3
    assert slope[4] > 0.0


@pytest.mark.slow
def test_all_ten_modes_come_back_from_another_order_of_actuators() -> None:
    """An actuator off its corner breaks the channels, not the job."""
    moved = [[0.12, 0.15], [-0.15, 0.15], [-0.15, -0.15], [0.15, -0.15]]
    problem = stage_problem(actuators=moved)
    plant = scaled_plant(problem, tuple(THETA_B))
    assert plant.channels == ()
    design = true_design(problem, tuple(THETA_B), HZ * 300.0, HZ * 60.0)
    assert design.figures.certified
