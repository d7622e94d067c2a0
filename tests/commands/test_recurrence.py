"""The states of a discrete system in pieces are those of one step after the other."""

import numpy as np
import pytest

from ccd_casadi.support.arrays import states


@pytest.mark.parametrize("steps", [0, 1, 2, 3, 16, 17, 1000])
@pytest.mark.parametrize("radius", [0.3, 0.999, 1.0])
def test_pieces_side_by_side_are_one_step_after_the_other(steps: int, radius: float) -> None:
    rng = np.random.default_rng(steps)
    A = rng.normal(size=(5, 5))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    driven = rng.normal(size=(steps, 5))
    x, found = np.zeros(5), []
    for d in driven:
        found.append(x)
        x = A @ x + d
    expected = np.array(found).reshape(-1, 5)
    assert states(A, driven) == pytest.approx(expected, rel=1e-9, abs=1e-10 * max(steps, 1))
