"""θ and controller in one search, on plants to first order in θ."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles.shipped_designs import RESULTS

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign.formulations import usual_name
from ccd_casadi.codesign.joint_model import JointModel, JointModelOptions, JointPoint, propose_step
from ccd_casadi.codesign.outer import Place
from ccd_casadi.codesign.outer_structured import StructuredOuter
from ccd_casadi.codesign.theta_joint import (
    JointSearchOptions,
    joint_search,
    objectives_beside,
    poll,
)
from ccd_casadi.codesign.working_set import WorkingSet, WorkingSetOptions
from ccd_casadi.fixed_structure.figures import assess, hessians
from ccd_casadi.fixed_structure.loop_problem import Constraints
from ccd_casadi.inner_problem.objective import hardware_at, objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.searched_problem import state_of, with_state
from ccd_casadi.inner_problem.structured_plant_set import nearby, structure_of, uncertain_plant
from ccd_casadi.inner_problem.structured_search import with_range
from ccd_casadi.plants.plant import Evaluate, Mechanics, mechanics, to_first_order
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers

ROOT = Path(__file__).parents[2]
STORED = json.loads(RESULTS.read_text())["two_mass_built"]


def built(start: tuple[float, float] = (55.0, 55.0)) -> CoDesignProblem:
    """runs/two_mass_built.toml from the controller that is stored, on the corners of its set."""
    problem = with_range(problem_of(load_case(ROOT / "runs" / "two_mass_built.toml")))
    corners = uncertain_plant(problem, problem.start).corners()
    members = tuple((option, tuple(map(float, point))) for option, point in corners)
    kappa = tuple(STORED["sections"]["kappa"])
    return replace(with_state(problem, warm_starts=(kappa,), scenarios=members), start=start)


def test_what_the_first_order_leaves_out_is_of_second_order() -> None:
    plant = plant_of(built())
    here, step = mechanics(plant, (60.0, 58.0)), np.array([0.4, -0.7])

    def missed(share: float) -> float:
        there = mechanics(plant, tuple(np.array([60.0, 58.0]) + share * step))
        reported = to_first_order(here, share * step)
        parts = [(getattr(there, name), getattr(reported, name)) for name in "KMBC"]
        return max(float(np.abs(a - b).max() / np.abs(a).max()) for a, b in parts)

    assert missed(1.0) < 1e-3
    assert missed(0.5) <= 0.3 * missed(1.0) + 1e-12


def curved(system: Mechanics, middle: tuple[float, ...]) -> Evaluate:
    """What moves with θ as a parabola does, with its slopes."""

    def at(theta: Sequence[float]) -> Mechanics:
        way = np.array(theta) - middle
        rates = (1.0 + 0.6 * way)[:, None, None]
        moved = to_first_order(system, way + 0.3 * way**2)
        return replace(moved, derivatives=tuple(rates * d for d in system.derivatives))

    return at


@pytest.mark.parametrize(("direction", "bending"), [(0, False), (1, False), (2, False), (3, True)])
def test_second_derivatives_over_theta_and_controller_are_those_of_the_peaks(
    direction: int, bending: bool
) -> None:
    """Of peaks that move, along random directions, the frequency of each found anew."""
    omega, stored = 2.0 * np.pi * STORED["bandwidth_hz"], tuple(STORED["sections"]["kappa"])
    problem, theta = built(), (60.0, 60.0)
    at = JointPoint(theta, stored, omega)
    models = nearby(problem, [theta], theta)
    if bending:
        models = (curved(mechanics(plant_of(problem), theta), theta),)
    model = JointModel(problem, models, at, 0.1, curved_plants=bending)
    family, start = model.loops, model.start
    z, kappa, tau = model.parts(start)
    loops = family(z)
    here = assess(loops, kappa, tau).peaks
    assert here is not None
    middle = model.at(start)
    assert middle is not None
    others = model.loops_beside(middle)
    chosen = here.only(here.value > -0.3)
    H = hessians(loops, kappa, tau, chosen, others)
    assert np.abs(H).max(axis=(1, 2)).min() > 0.0
    d = np.random.default_rng(direction).normal(size=len(kappa) + 3)
    e = 1e-4

    def there(sign: float) -> Constraints:
        at = start + sign * e * d
        found = assess(family(at[:2]), at[2:-1], float(at[-1])).peaks
        assert found is not None
        return found

    def same(found: Constraints, j: int) -> float:
        like = (found.curve == chosen.curve[j]) & (found.plant == chosen.plant[j])
        away = np.abs(np.log(found.v[like] / chosen.v[j]))
        assert away.min() < 1e-2
        return float(found.value[like][np.argmin(away)])

    up, down = there(1.0), there(-1.0)
    for j in range(len(chosen.v)):
        bending = (same(up, j) - 2.0 * chosen.value[j] + same(down, j)) / e**2
        reported = float(d @ H[j] @ d)
        assert reported == pytest.approx(bending, rel=0.03, abs=0.03 * float(np.abs(H[j]).max()))


@pytest.mark.slow
def test_it_ends_where_no_more_is_promised(tmp_path: Path) -> None:
    """From inside the box: J falls, a mass ends at its bound, and the true value says so."""
    problem = built(start=(58.0, 57.0))
    with SampleStore(tmp_path / "samples.sqlite") as store:
        sampler = Sampler(problem, store, Workers(1))
        first = sampler.values(np.array(problem.start))[0]
        at = JointPoint(first.theta, first.kappa, first.bandwidth)
        models = nearby(problem, [at.theta], at.theta)
        promised, whole = (
            propose_step(problem, models, at, 0.05, least) for least in (None, 1e-10)
        )
        assert promised.gain > 0.8 * whole.gain > 0.0
        _, best, settled = joint_search(sampler, np.array(problem.start))
        assert settled
        assert best.feasible
        assert objective_of(problem, best) < objective_of(problem, first) - 0.5 * promised.gain
        assert best.theta == pytest.approx((55.0, 55.0), abs=1e-6)
        assert best.bandwidth >= 0.99 * 2.0 * np.pi * STORED["bandwidth_hz"]
        spent = sampler.spent.total
        other = Sampler(problem, store, Workers(1))
        again = joint_search(other, np.array(problem.start))[1]
        assert (again.theta, again.kappa) == (best.theta, best.kappa)  # all from the store
        assert other.spent.total == spent
        # Beside it J is told by plants to first order as by true ones, but for their curvature.
        there = np.array(best.theta) + 0.03 * np.array([[1, 0], [0, 1], [1, 1]])
        reported = objectives_beside(problem, best, there)
        true = [objective_of(problem, one) for one in sampler.values(there)]
        assert reported == pytest.approx(np.array(true) - objective_of(problem, best), rel=0.02)


@pytest.mark.parametrize("theta", [(60.0, 58.0), (55.0, 58.0)])
def test_a_poll_has_the_best_place_along_the_axes(theta: tuple[float, float]) -> None:
    """Of those inside the box: at an end of it there is nothing beyond."""
    problem = built(start=theta)
    at = JointPoint(theta, tuple(STORED["sections"]["kappa"]), 2.0 * np.pi * 20.0)
    models = nearby(problem, (), theta)
    width = np.subtract(problem.upper, problem.lower)
    steps = [
        sign * JointSearchOptions().poll_step * row
        for row in np.diag(width)
        for sign in (1.0, -1.0)
    ]
    places = [place for step in steps if ((place := theta + step) >= problem.lower).all()]
    J = [JointModel(problem, models, replace(at, theta=tuple(place)), 0.0).adapt()[1]
         for place in places]  # fmt: skip
    assert np.isfinite(J).any()
    assert poll(problem, models, at).theta == pytest.approx(places[int(np.argmin(J))])


@pytest.mark.slow
def test_a_local_solve_takes_joint_steps_and_stops_where_another_has_ended(tmp_path: Path) -> None:
    problem = built()
    with SampleStore(tmp_path / "samples.sqlite") as store:
        sampler = Sampler(problem, store, Workers(1))
        outer = StructuredOuter(sampler)
        first, near = sampler.values(np.array([[58.0, 57.0], [55.2, 55.1]]))
        place = outer.local_solve(first, ())
        assert place is not None
        assert place.stationary
        assert place.objective < objective_of(problem, first)
        assert place.x == pytest.approx((55.0, 55.0), abs=0.02 * 15.0)
        # The controller is known where it ended, for a polish that goes on there.
        assert objective_of(problem, sampler.values(place.x)[0]) <= 0.999 * place.objective
        again = outer.local_solve(near, [place])
        assert again is not None
        assert again.x == pytest.approx(near.theta)
        assert again.objective == objective_of(problem, near)
        better = [Place(place.x, 0.9 * place.objective, True)]  # an end that it improves on
        beyond = outer.local_solve(near, better)
        assert beyond is not None
        assert beyond.objective < again.objective


def test_breaking_a_constraint_costs_more_than_the_hardware_that_it_saves() -> None:
    """J falls along a constraint's slope by less than the penalty rises, also where J is mass."""
    problem = problem_of(load_case(ROOT / "examples" / "guided_beam" / "case.toml"))
    problem = with_range(replace(problem, w1=1e6))
    kappa = np.zeros(len(structure_of(problem).names))
    at = JointPoint(problem.start, tuple(kappa), 2.0 * np.pi * 20.0)
    model = JointModel(problem, nearby(problem, (), at.theta), at, 0.3)
    own = hardware_at(problem, model.middle)
    assert len(own.constraints)
    saved = np.abs(own.cost_gradient).max() / model.unit
    rise = JointModelOptions().penalty * (model.weight[:, None] * np.abs(own.slopes)).max(axis=1)
    assert (rise >= saved).all()
    assert model.weight.max() > 1.0


def test_a_step_to_where_masses_are_no_longer_positive_is_no_step() -> None:
    """As placed masses do, whose M to first order is indefinite far away."""
    problem, theta = built(), (60.0, 60.0)
    found = mechanics(plant_of(problem), theta)
    falling = replace(found, derivatives=(np.array([-found.M, -found.M]), *found.derivatives[1:]))
    at = JointPoint(theta, tuple(STORED["sections"]["kappa"]), 2.0 * np.pi * 20.0)
    model = JointModel(problem, [lambda z: to_first_order(falling, np.array(z) - theta)], at, 0.3)
    far = model.start.copy()
    far[:2] += 0.2  # of the box: some kilograms, at a loss of all mass for each
    with pytest.raises(np.linalg.LinAlgError):
        model.loops(far[:2])
    assert model.at(far) is None
    assert model.at(model.start) is not None


def test_with_sections_the_smaller_plan_is_sampled() -> None:
    """Lifted and its 6 n designs, where nested has a grid of 5^n."""
    case = load_case(ROOT / "runs" / "two_mass_built.toml")
    coarse, default = case.sampling.points, type(case.sampling)()
    assert coarse**2 < 12 < default.points**2
    plain = replace(case, sampling=default)
    assert [usual_name(plain, n) for n in (1, 2, 4)] == ["nested", "lifted", "lifted"]
    assert usual_name(plain, 20) == "direct"
    mixed = replace(plain, controller=replace(plain.controller, structure="h_infinity"))
    assert usual_name(mixed, 2) == "nested"


def test_where_each_theta_is_dear_none_is_sampled() -> None:
    names = ("rib_stage_built", "two_mass_built", "rib_stage")
    cases = {name: load_case(ROOT / "runs" / f"{name}.toml") for name in names}
    chosen = {name: usual_name(case, len(case.theta)) for name, case in cases.items()}
    assert chosen == {
        "rib_stage_built": "direct", "two_mass_built": "nested", "rib_stage": "nested"
    }  # fmt: skip


def test_a_working_set_keeps_the_model_as_its_first_plant(tmp_path: Path) -> None:
    """Figures "of the model" are of the first, though at the optimum others hold the controller."""
    problem = built()
    theta = problem.start
    at = JointPoint(theta, tuple(STORED["sections"]["kappa"]), 2.0 * np.pi * STORED["bandwidth_hz"])
    with SampleStore(tmp_path / "samples.sqlite") as store:
        working = WorkingSet(Sampler(problem, store, Workers(1)))
        few = working.reduce(nearby(problem, (), theta), at, WorkingSetOptions(most_plants=1))
    left = state_of(few.sampler.problem).scenarios
    assert left[0] == (0, tuple(map(float, uncertain_plant(problem, theta).nominal)))
    assert left[0] not in few.aside
    assert set(left) | set(few.aside) == set(state_of(problem).scenarios)
    assert few.aside
