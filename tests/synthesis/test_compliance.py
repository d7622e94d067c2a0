"""‖GS‖∞ of full-order controllers: measured, differentiated, and a bound of the inner problem."""

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from oracles.helpers import HZ, problem

from ccd_casadi.codesign.optimality import TrueDesign, first_order
from ccd_casadi.codesign.outer_problem import outer_program
from ccd_casadi.inner_problem.controller_problem import RobustSet
from ccd_casadi.inner_problem.kinds import bandwidth_gradient
from ccd_casadi.inner_problem.objective import TrueQuantities
from ccd_casadi.inner_problem.problem import scaled_plant, true_design, true_inner
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.synthesis.statics import compliance_of, compliance_words
from ccd_casadi.synthesis.synthesis import synthesise

THETA = (60.0, 62.0)
POINT = (800.0 * HZ, 40.0 * HZ)


def bounded(by: float, disturbance: float = 0.0, robust: RobustSet | None = None):  # type: ignore[no-untyped-def]
    case = problem(robust=robust)
    return replace(
        case,
        inner=replace(case.inner, compliance_max=by),
        weights=replace(case.weights, disturbance=disturbance),
    )


@pytest.mark.parametrize("disturbance", [0.0, 2e8])
def test_the_largest_compliance_is_that_of_the_frequency_response(disturbance: float) -> None:
    case = bounded(1.0, disturbance)
    plant = scaled_plant(case, THETA)
    made = synthesise(plant, case.weights.at(*POINT), omega_low=HZ)
    found = compliance_of(plant, made.controller)
    G, K = plant.plant_si(), made.controller

    def response(system, omega):  # type: ignore[no-untyped-def]
        inside = 1j * omega[:, None, None] * np.eye(len(system.A)) - system.A
        return (system.C @ np.linalg.solve(inside, system.B + 0j) + system.D)[:, 0, 0]

    omega = np.append(np.geomspace(1e-4, 1e5, 20_000), found.omega)
    g, k = response(G, omega), response(K, omega)
    gain = np.abs(g / (1.0 + g * k))
    assert gain.max() <= found.gain * (1.0 + 1e-9)
    assert gain.max() >= found.gain * (1.0 - 1e-9)


@pytest.mark.parametrize("disturbance", [0.0, 2e8])
@pytest.mark.parametrize("robust", [None, RobustSet(0.02, 3, (), -0.02)])
def test_its_derivatives_are_those_of_differences(
    disturbance: float, robust: RobustSet | None
) -> None:
    case = bounded(1.0, disturbance, robust)
    design = true_design(case, THETA, *POINT)
    assert design.figures.certified
    assert len(design.values) == len(design.to_theta) == 5
    assert design.values[3] == np.log(design.figures.compliance)
    if robust is not None:
        alone = true_design(bounded(1.0, disturbance), THETA, *POINT)
        assert design.figures.compliance != alone.figures.compliance

    def value(k: int, h: float) -> float:
        theta, point = np.array(THETA), np.log(POINT)
        if k < 2:
            theta[k] *= np.exp(h)
        else:
            point[k - 2] += h
        return float(true_design(case, tuple(theta), *np.exp(point)).values[3])

    exact = np.append(design.to_theta[3] * THETA, design.to_break_frequencies[3])
    h = 2e-3
    for k, slope in enumerate(exact):
        near, far = (value(k, s * h) - value(k, -s * h) for s in (1.0, 2.0))
        assert (8.0 * near - far) / (12.0 * h) == pytest.approx(slope, rel=1e-5, abs=1e-6)


def test_the_inner_problem_keeps_it_and_knows_its_price() -> None:
    """A bound 3 % below what the fastest design has: it binds, and dω_b*/dθ goes along it."""
    case = bounded(1.0)
    free = true_inner(case, THETA)
    assert free.optimum is not None
    required = bounded(0.97 * free.optimum.figures.compliance)
    kept = true_inner(required, THETA)
    assert kept.optimum is not None
    assert "compliance_max" in kept.active
    assert required.inner.feasible(kept.optimum.figures)
    assert kept.bandwidth < free.bandwidth
    gradient = bandwidth_gradient(kept.optimum, kept.active, tuple(required.inner.bounds))
    h = 0.5
    ends = [true_inner(required, (THETA[0], THETA[1] + s * h)).bandwidth for s in (1.0, -1.0)]
    assert (ends[0] - ends[1]) / (2.0 * h) == pytest.approx(gradient[1], rel=2e-3)


def test_what_cannot_be_had_is_said() -> None:
    found = true_inner(bounded(1e-6), THETA)
    assert found.optimum is None
    assert "compliance_max = 1e-06" in found.shortfall


def test_it_is_a_constraint_of_the_outer_problem() -> None:
    case = bounded(2.7e-5)
    quantities = TrueQuantities(case)
    program = outer_program(case, quantities)
    x = np.array([*THETA, *np.log(POINT)])
    design = quantities.at(x)
    assert program.g.shape[0] == 3
    here = first_order(TrueDesign(quantities, x))
    row = here.names.index("compliance_max")
    assert here.g[row] == pytest.approx(np.log(design.figures.compliance / 2.7e-5))
    assert np.isfinite(here.jacobian[row]).all()
    assert np.abs(here.jacobian[row]).max() > 0.0


def test_it_is_part_of_what_a_sample_is_only_where_it_is_required() -> None:
    case = problem()
    assert bounded(1e-5).identity() == bounded(2e-5).identity() != case.identity()
    assert bounded(1e-5).inner_identity() != bounded(2e-5).inner_identity()


def test_a_store_of_before_gains_its_column(tmp_path: Path) -> None:
    path = tmp_path / "samples.sqlite"
    with SampleStore(path):
        pass
    with closing(sqlite3.connect(path)) as db, db:
        db.execute("alter table samples drop column compliance")
    with SampleStore(path) as store:
        assert store.select() == []
    with closing(sqlite3.connect(path)) as db, db:
        assert "compliance" in {row[1] for row in db.execute("pragma table_info(samples)")}


def test_words_tell_an_integrator_from_a_stiff_controller() -> None:
    assert "none at rest" in compliance_words(1e-6, 0.0, 1e-7, 1.0)
    assert "0.5 um/N at rest" in compliance_words(1e-6, 5e-7, 1e-7, 1.0)


def test_a_plant_without_slopes_has_a_gradient_of_none() -> None:
    """The explorer's matrices in modal form: an optimum on a bound was an error there."""
    optimum = SimpleNamespace(
        to_break_frequencies=np.array([[1.0, 0.0], [0.5, 0.0]]), to_theta=np.zeros((2, 0))
    )
    assert bandwidth_gradient(optimum, ("S_max", "omega_T lower"), ("S_max",)).shape == (0,)
