"""The guided beam of examples/guided_beam, and the PID rule that it is compared with."""

from pathlib import Path

import numpy as np
import pytest
from benchmark_scripts import benchmark

from ccd_casadi.cases.case import load_case, problem_of
from ccd_casadi.inner_problem.problem import plant_of, scaled_plant
from ccd_casadi.plants.plant import constraint_values

ROOT = Path(__file__).resolve().parent.parent
CASE = ROOT / "examples" / "guided_beam" / "case.toml"
HZ = 2.0 * np.pi


def test_a_prismatic_beam_has_the_frequencies_of_the_textbook() -> None:
    """tan β + tanh β = 0, guided at one end and free at the other."""
    problem = problem_of(load_case(CASE))
    height, length = 0.03, 0.3
    wave = np.sqrt(65e9 / (1.0 - 0.3**2) * height**2 / (12.0 * 2700.0)) / (HZ * length**2)
    expected = [beta**2 * wave for beta in (2.36502037, 5.49780392, 8.63937983)]
    natural = np.sort(scaled_plant(problem, (height, height)).natural) / HZ
    flexible = natural[natural > 100.0]
    np.testing.assert_allclose(flexible[:3], expected, rtol=1e-4)
    assert len(flexible) == 10
    assert constraint_values(plant_of(problem), (0.04, 0.02)) == pytest.approx([0.0], abs=1e-12)


def test_the_rule_has_its_gain_at_the_bandwidth() -> None:
    guided_beam = benchmark("guided_beam")
    w, mass = 80.0, 7.0
    K = guided_beam.their_pid(w, mass)
    at = guided_beam.response(K, np.array([w]))[0]
    assert abs(at) == pytest.approx(1.1 * mass * w**2, rel=1e-9)
    assert sorted(np.linalg.eigvals(K.A).real) == pytest.approx([-5.0 * w, -3.0 * w, 0.0], abs=1e-6)
