"""Samples and hyperparameters to draw, for tests of the Gaussian process."""

from functools import partial

import numpy as np
import pytest
from hypothesis import strategies as st

from oracles import draws
from surrogates import Hyperparameters, Kernel

KERNELS = pytest.mark.parametrize("kernel", list(Kernel))
BOX = {"lower": [-2.0, -2.0], "upper": [2.0, 2.0]}
few = partial(draws.few, max_examples=10)
seeds = st.integers(0, 10**6)


def smooth(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A function of any number of inputs and its gradient."""
    w = np.linspace(1.0, 0.4, X.shape[1])
    return np.sin(X @ w) + 0.1 * (X**2).sum(1), np.cos(X @ w)[:, None] * w + 0.2 * X


def drawn(seed: int, d: int = 2) -> tuple[np.random.Generator, Hyperparameters]:
    rng = np.random.default_rng(seed)
    return rng, Hyperparameters(
        length_scales=rng.uniform(0.2, 1.5, d),
        signal_variance=float(rng.uniform(0.5, 4.0)),
        noise_variance=1e-3,
        gradient_noise_variance=1e-2,
    )
