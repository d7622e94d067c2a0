"""Two flat maxima side by side: each lies in a bracket, shown by a grid point or not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ccd_casadi.fixed_structure.figures import hidden_peaks, local_peaks
from ccd_casadi.fixed_structure.loop_problem import LoopProblem
from ccd_casadi.kernels.sections import LoopCurve

STEP = np.log(10.0) / LoopProblem.per_decade
HALF = 0.09  # of the distance of the maxima in ln v: one in five shows on no grid


def two_maxima(x: np.ndarray, height: float, tilt: float) -> np.ndarray:
    return -height * ((x / HALF) ** 2 - 1.0) ** 2 + tilt * x / HALF


@pytest.mark.parametrize("seed", range(60))
def test_every_maximum_lies_in_a_bracket(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height = 10.0 ** rng.uniform(-5.0, -3.0)
    curve = (height, height * rng.uniform(-0.5, 0.5))
    x = -1.5 + STEP * (np.arange(32) + rng.uniform() + rng.uniform(-0.2, 0.2, 32))
    v, value = np.exp(x)[None], two_maxima(x, *curve)[None, :, None, None]
    loop: Any = SimpleNamespace(out=np.eye(1))
    curves = np.array([LoopCurve.S_MAX])
    shown = local_peaks(loop, curves, v, value, -1.0, np.zeros((1, 1)), np.full((1, 1), np.inf))
    found = shown.and_those(hidden_peaks(curves, v, value))
    fine = np.linspace(-0.3, 0.3, 6001)
    y = two_maxima(fine, *curve)
    tops = np.exp(fine[1:-1][(y[1:-1] > y[:-2]) & (y[1:-1] > y[2:])])
    assert len(tops) == 2
    for top in tops:
        assert ((found.low < top) & (top < found.high)).any()
