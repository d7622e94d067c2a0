"""Each plant that others found hard: a back end's controller keeps its norm, judged apart."""

from collections.abc import Iterator

import numpy as np
import pytest
from oracles import lmi
from oracles.hard_plants import HARD, close, regularised

from ccd_casadi.extensions.cross_check.backends import solve_slicot
from ccd_casadi.lti.norms import gains
from ccd_casadi.support.worker_process import Runner

pytest.importorskip("cvxpy")
LIMIT = 60.0  # seconds a back end: 5 where the machine is idle
BACKOFF = 1.02
ADDED = (1e-6, 1e-4, 1e-2)  # disturbances and costs of an irregular plant, relative


@pytest.fixture(scope="module")
def runner() -> Iterator[Runner]:
    with Runner() as process:
        process.call(300.0, lmi.solve, HARD["Slycot SB10AD"].plant)  # imports cvxpy
        yield process


@pytest.mark.parametrize("source", HARD)
def test_one_back_end_at_least_keeps_what_it_claims(source: str, runner: Runner) -> None:
    hard = HARD[source]
    grid = np.concatenate([[0.0, np.inf], np.geomspace(1e-5, 1e5, 500)])
    kept = []
    for solve in (solve_slicot, lmi.solve):
        for size in ADDED if hard.irregular else (0.0, *ADDED):
            given = regularised(hard.plant, size) if size else hard.plant
            found = runner.call(LIMIT, solve, given, gamma_backoff=BACKOFF)
            if found.controller is None:
                continue
            loop = close(hard.plant, found.controller)
            if np.linalg.eigvals(loop.A).real.max() < 0.0:
                peak = gains(loop, grid).max()
                if peak <= found.gamma * (1.0 + 1e-6) + 1e-12:
                    kept.append((peak, found.gamma_opt))
                    break
    assert kept
    if hard.gamma is not None:
        assert min(gamma for _, gamma in kept) == pytest.approx(hard.gamma, abs=hard.digits)
        assert min(kept)[0] <= BACKOFF * (hard.gamma + hard.digits)
