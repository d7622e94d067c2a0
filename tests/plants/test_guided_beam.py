"""The guided beam of examples/guided_beam, and the PID rule that it is compared with."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles import guided_beam
from scipy.signal import tf2ss

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.optimality import theta_kkt
from ccd_casadi.codesign.outer_structured import polish_structured
from ccd_casadi.codesign.post_optimal import structured_responses
from ccd_casadi.fixed_structure.bounds import ShapeEnd
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of, scaled_plant
from ccd_casadi.inner_problem.structured_bandwidth import StructuredValue, structured_value
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.inner_problem.structured_search import prepare_search
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import constraint_values
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers

ROOT = Path(__file__).resolve().parents[2]
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
    w, mass = 80.0, 7.0
    K = guided_beam.their_pid(w, mass)
    at = guided_beam.response(K, np.array([w]))[0]
    assert abs(at) == pytest.approx(1.1 * mass * w**2, rel=1e-9)
    assert sorted(np.linalg.eigvals(K.A).real) == pytest.approx([-5.0 * w, -3.0 * w, 0.0], abs=1e-6)


def test_a_double_pole_does_not_spoil_the_judge() -> None:
    """The co-design's lead and roll-off end with equal poles."""
    a = 3000.0
    K = StateSpace(*tf2ss([1.0, 2.0, 5.0], np.polymul([1.0, 0.0], [1.0, 2.0 * a, a**2])))
    s = 1j * np.geomspace(0.1, 1e6, 200)
    expected = (s**2 + 2.0 * s + 5.0) / (s * (s + a) ** 2)
    found = guided_beam.response(K, s.imag)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.fixture(scope="module")
def anchored() -> CoDesignProblem:
    problem = problem_of(load_case(CASE))
    assert isinstance(problem.controller, StructuredProblem)
    # where |S| may leap at ω_b the optimum lies on a kink
    few = replace(problem.controller, starts=4, shape_ends=ShapeEnd.CROSSING)
    found, made, _ = prepare_search(replace(problem, controller=few))
    assert made.certified
    return found


def kink(problem: CoDesignProblem, total: float) -> StructuredValue:
    """The largest bandwidth of all beams with this sum of heights, in m; it lies on a kink."""

    def at(tip: float) -> tuple[StructuredValue, float]:
        found = structured_value(problem, (total - tip, tip))
        return found, found.gradient[1] - found.gradient[0]

    low, high = 0.005, 0.006
    for share in (0.1, 0.02, 0.02, 0.02):
        (below, rising), (above, falling) = at(low), at(high)
        assert rising > 0.0 > falling
        gap = above.bandwidth - below.bandwidth + rising * low - falling * high
        meet, width = gap / (rising - falling), high - low  # where the two tangents do
        low, high = meet - share * width, meet + share * width
    return at(meet)[0]


@pytest.mark.slow
def test_the_co_design_ends_on_a_kink_that_is_an_optimum(
    anchored: CoDesignProblem, tmp_path: Path
) -> None:
    """Both ways along the bound on the volume J rises, and only both sides together say why."""
    with Workers(1) as pool, SampleStore(tmp_path / "samples.sqlite") as store:
        sampler = Sampler(anchored, store, pool)
        best = polish_structured(sampler, np.array([0.0546, 0.0054]))[1]
        found = structured_value(anchored, best.theta)
        assert best.bandwidth / HZ == pytest.approx(118.2542, abs=2e-4)
        certificate = theta_kkt(anchored, best, sampler, found.envelope)
    assert certificate.active == ("volume",)
    assert certificate.stationarity < 1e-5
    assert certificate.kink is not None
    assert certificate.kink.one_gradient > 0.1
    ((one, other),) = certificate.kink.slopes
    assert min(one, other) > 0.1
    # what the optimum answers to: S_max moves the kink, and J with it
    answers = structured_responses(anchored, best, found)
    reported = {item.parameter: item.objective for item in answers.responses}["S_max"]
    ends = []
    for sign in (1.0, -1.0):
        inner = replace(anchored.inner, S_max=anchored.inner.S_max + sign * 1e-3)
        ends.append(kink(replace(anchored, inner=inner), 0.06).bandwidth)
    assert reported == pytest.approx(-(ends[0] - ends[1]) / 2e-3, rel=1e-3)


def test_elsewhere_on_the_kink_the_beam_is_not_optimal(anchored: CoDesignProblem) -> None:
    """A lighter beam, the best of its volume: on the kink, but more material would help."""
    found = kink(anchored, 0.0597)
    with Workers(1) as pool, SampleStore(Path(":memory:")) as store:
        sample = Sampler(anchored, store, pool).values(np.array(found.theta))[0]
    certificate = theta_kkt(anchored, sample, envelope=found.envelope)
    assert certificate.active == ()
    assert certificate.stationarity > 0.1
