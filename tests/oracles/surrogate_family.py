"""One smooth function of three inputs of different units, and a process of each kernel."""

import casadi as ca
import numpy as np
import pytest

from surrogates import GaussianProcess, Hyperparameters, condition, design

LOW, HIGH = np.array([-2.0, 10.0, 0.0]), np.array([2.0, 30.0, 1e-3])
SPAN = HIGH - LOW
W = np.array([1.0, 2.0, 1.5])


def f(X: np.ndarray) -> np.ndarray:
    return 50.0 * np.exp(np.sin((X - LOW) / SPAN @ W))


def slopes(X: np.ndarray) -> np.ndarray:
    return f(X)[:, None] * np.cos((X - LOW) / SPAN @ W)[:, None] * W / SPAN


X = design("sobol", LOW, HIGH, 48, seed=1)
Y, DY = f(X), slopes(X)
T = design("lhs", LOW, HIGH, 60, seed=2)
BOX = {"lower": LOW, "upper": HIGH}


def process(kernel: str, gradients: bool) -> GaussianProcess:
    p = Hyperparameters(np.array([0.7, 0.5, 0.6]), 2.0, 1e-5, 1e-4)
    return condition(p, X, Y, **BOX, kernel=kernel, dY=DY if gradients else None)


MAKERS = {
    "matern52": lambda: process("matern52", False),
    "rbf": lambda: process("rbf", False),
    "matern52+gradients": lambda: process("matern52", True),
    "rbf+gradients": lambda: process("rbf", True),
}
MADE: dict[str, GaussianProcess] = {}
MEMBERS = pytest.mark.parametrize("name", list(MAKERS))


def member(name: str) -> GaussianProcess:
    if name not in MADE:  # the same surrogate serves several tests; it is immutable
        MADE[name] = MAKERS[name]()
    return MADE[name]


def flat(value: ca.DM) -> np.ndarray:
    return np.array(value).ravel()
