"""Systems to draw, for tests of the kernels' parts."""

import numpy as np
from hypothesis import strategies as st

from ccd_casadi.lti.state_space import StateSpace
from oracles.helpers import HZ, PAPER

seeds = st.integers(0, 10**6)
WEIGHTS = PAPER.at(800.0 * HZ, 40.0 * HZ)


def complex_matrix(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def random_system(seed: int, n: int, m: int, p: int) -> StateSpace:
    """Real and complex poles, some of them double."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) - 2.0 * np.eye(n)
    return StateSpace(A, rng.normal(size=(n, m)), rng.normal(size=(p, n)), np.zeros((p, m)))
