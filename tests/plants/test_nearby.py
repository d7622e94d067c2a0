"""Finite elements without derivatives, and a reduced basis around one θ."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.case_studies.rib_stage import nearby
from ccd_casadi.case_studies.rib_stage.geometry import Geometry, PointMass
from ccd_casadi.case_studies.rib_stage.mesh import COARSE
from ccd_casadi.case_studies.rib_stage.model import RibStage
from ccd_casadi.case_studies.rib_stage.plant import plant_of_stage
from ccd_casadi.cases.run_folder import FinishedRun, read_run
from ccd_casadi.inner_problem.problem import plant_of
from ccd_casadi.plants.plant import Mechanics, Plant
from ccd_casadi.robust.hardware import tolerances
from ccd_casadi.support.process_pool import Workers

THETA = (1.2e-3, 3.3e-3, 7e-3, 7e-3, 16e-3, 70e-3)
STAGE = RibStage(order=COARSE)


def test_without_derivatives_the_matrices_are_the_same_to_the_bit() -> None:
    whole = STAGE.mechanics(THETA)
    bare = STAGE.mechanics(THETA, derivatives=False)
    for name in ("M", "D", "K", "B", "C"):
        np.testing.assert_array_equal(getattr(bare, name), getattr(whole, name))
    assert [len(item) for item in bare.derivatives] == [0] * 5


@pytest.mark.slow
def test_a_reduced_basis_gives_the_matrices_within_its_reach() -> None:
    names = ("H", "h", "t_o", "t_i", "t_c", "x_i")  # in another order than the stage's own
    theta = np.array([THETA[4], *THETA[:4], THETA[5]])
    plant = plant_of_stage(replace(STAGE, outputs="modal4"), names)
    assert plant.nearby is not None
    assert plant.values is not None
    evaluate = plant.nearby(theta, 0.01, Workers(1))
    rng = np.random.default_rng(5)
    for x in (*rng.uniform(-1.0, 1.0, (3, 6)), np.sign(rng.uniform(-1.0, 1.0, 6))):
        here = theta * (1.0 + 0.01 * x)
        near, true = evaluate(here), plant.values(here)
        np.testing.assert_allclose(np.diag(near.K), np.diag(true.K), rtol=1e-7)
        size = np.abs(true.B).max()
        np.testing.assert_allclose(near.B, true.B, atol=1e-5 * size)
        np.testing.assert_allclose(near.C, true.C, atol=1e-5 * size)


def test_it_does_not_apply_to_a_stage_without_symmetry() -> None:
    masses = (PointMass(0.1, 0.02, 0.05),)
    assert nearby.applies(STAGE)
    assert not nearby.applies(replace(STAGE, geometry=Geometry(point_masses=masses)))
    assert not nearby.applies(replace(STAGE, truncation="frequency"))


@pytest.fixture(scope="module")
def run(two_mass_run: Path) -> FinishedRun:
    return read_run(two_mass_run)


def reduced_by(factor: float, plant: Plant) -> Plant:
    """The plant with a reduced model whose stiffness is off by a factor."""

    def make(theta: Sequence[float], reach: float, pool: object) -> object:
        def values(theta: Sequence[float]) -> Mechanics:
            true = plant.evaluate(theta)
            return replace(true, K=factor * true.K)

        return values

    return replace(plant, nearby=make)  # type: ignore[arg-type]


def test_a_reduced_model_is_used_where_it_agrees_and_only_there(
    run: FinishedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    true = tolerances(run, 0.001, 12, 3, quiet=True)
    assert true.difference is None
    for factor, used in ((1.0, True), (1.001, False)):
        plant = reduced_by(factor, plant_of(run.problem))
        monkeypatch.setattr("ccd_casadi.robust.hardware.plant_of", lambda _, plant=plant: plant)
        found = tolerances(run, 0.001, 12, 3, quiet=True)
        assert (found.difference is not None) == used
        assert repr(found.judged) == repr(true.judged)
        assert repr(found.worst) == repr(true.worst)
