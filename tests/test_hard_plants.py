"""Each plant that others found hard: a certified answer or a worded reason, within the limit."""

from collections.abc import Iterator

import numpy as np
import pytest
from hard_plants import HARD

from ccd_casadi.support.deadline import Runner
from ccd_casadi.synthesis.backends import lmi
from ccd_casadi.synthesis.backends.general import synthesise_standard
from ccd_casadi.synthesis.backends.standard_plant import (
    certify,
    close,
    irregularities,
    obstacles,
    regularised,
)
from ccd_casadi.synthesis.norms import gains

pytest.importorskip("cvxpy")
pytest.importorskip("slycot")
LIMIT = 120.0  # seconds a plant: 10 where the machine is idle
BACKOFF = 1.02


@pytest.fixture(scope="module")
def runner() -> Iterator[Runner]:
    with Runner() as process:
        process.call(300.0, lmi.solve, HARD["Slycot SB10AD"].plant)  # imports cvxpy
        yield process


@pytest.mark.parametrize("source", HARD)
def test_certified_or_explained(source: str, runner: Runner) -> None:
    hard = HARD[source]
    found = synthesise_standard(hard.plant, runner, limit=LIMIT, gamma_backoff=BACKOFF)
    if hard.reason:
        assert not found.certified
        assert any(hard.reason in words for words in found.reasons)
        return
    assert found.controller is not None
    assert found.certificate is not None
    loop = close(hard.plant, found.controller)
    assert np.linalg.eigvals(loop.A).real.max() < 0.0
    grid = np.concatenate([[0.0, np.inf], np.geomspace(1e-5, 1e5, 500)])
    assert gains(loop, grid).max() <= found.certificate.norm * (1.0 + 1e-6) + 1e-12
    if hard.gamma is not None:
        assert found.gamma_opt == pytest.approx(hard.gamma, abs=hard.digits)
        assert found.certificate.norm <= BACKOFF * (hard.gamma + hard.digits)


def test_irregular_plants_are_named_before_anything_hangs_on_them() -> None:
    """On these three SB10AD as it is called by others does not end."""
    for number, words in (("152", "D12"), ("973", "D12"), ("367", "D21")):
        plant = HARD[f"python-control #{number}"].plant
        assert not obstacles(plant)
        assert words in irregularities(plant)[0]
        assert not irregularities(regularised(plant, 1e-4))


def test_a_controller_that_does_not_hold_is_not_certified() -> None:
    plant = HARD["COMPleib AC4"].plant
    K = lmi.solve(plant).controller
    assert K is not None
    proof = certify(plant, K, 1.0)
    assert proof.passed
    assert not certify(plant, K, 0.999 * proof.norm).passed
    assert not certify(plant, type(K)(K.A, -K.B, K.C, -K.D), 1e9).passed
    assert not certify(plant, type(K)(K.A, np.nan * K.B, K.C, K.D), 1e9).passed
