"""Slopes of plants behind hold and delay to their parameters, against differences."""

from dataclasses import replace

import numpy as np
import pytest

from ccd_casadi.fixed_structure.channel_structure import Decoupling
from ccd_casadi.fixed_structure.plant_set import plant_set
from ccd_casadi.kernels.modes import form_slopes
from ccd_casadi.lti.loop import Sampling, zoh
from ccd_casadi.lti.state_space import strictly_proper
from ccd_casadi.plants.scaling import ScaledPlant

P, M, PARAMETERS, STEP = 2, 3, 2, 1e-6
ORDERS = (6, 4, 5)
DIRECTIONS = Decoupling(("a", "b"), np.array([[1.0, 0.4], [0.2, 1.0]]), np.eye(M)[:, :P])


def drawn(rng: np.random.Generator, order: int) -> ScaledPlant:
    """A stable plant as `plant_set` takes it, with slopes to two parameters."""
    A = rng.standard_normal((order, order))
    A -= np.eye(order) * (np.linalg.eigvals(A).real.max() + 0.2)
    B, C = rng.standard_normal((order, M)), rng.standard_normal((P, order))
    slopes = {f"d{name}": rng.standard_normal((PARAMETERS, *matrix.shape))
              for name, matrix in (("A", A), ("B", B), ("C", C))}  # fmt: skip
    none = np.zeros(0)
    return ScaledPlant(A, B, C, 1.0, 1.0, none, none, none, **slopes)


def response(
    plant: ScaledPlant, parameter: int, step: float, omega: float, sampling: Sampling | None
) -> np.ndarray:
    """G(jω) at a moved parameter."""
    A, B, C = (getattr(plant, name) + step * getattr(plant, f"d{name}")[parameter]
               for name in "ABC")  # fmt: skip
    G = strictly_proper(A, B, C)
    if sampling is None:
        return G.response(np.array([omega]))[0]
    return zoh(G, sampling.period, sampling.delay).response(np.array([omega]))[0]


@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("sampling", [None, Sampling(60.0), Sampling(60.0, 2.4e4)])
def test_they_are_differences_of_the_response(sampling: Sampling | None, free: bool) -> None:
    rng = np.random.default_rng(1)
    plants = [drawn(rng, order) for order in ORDERS]
    family = plant_set(plants, sampling, DIRECTIONS)
    which = rng.integers(0, len(plants), 12)
    omega = np.exp(rng.uniform(-1.0, 3.0, len(which)))
    x, y = (rng.standard_normal((len(which), k, 2)) @ np.array([1.0, 1j]) for k in (P, M))
    found = form_slopes(family.slopes, which, family.variable(omega), x, y, free)
    held = None if free else sampling
    for j, i in enumerate(which):
        for t in range(PARAMETERS):
            up, down = (response(plants[i], t, s * STEP, omega[j], held) for s in (1.0, -1.0))
            moved = (x[j] @ (up - down) @ y[j]).real / (2.0 * STEP)
            assert found[j, t] == pytest.approx(moved, rel=1e-6, abs=1e-7)


def test_poles_that_are_one_have_the_derivative_between_them() -> None:
    """Of two equal lags and one beside them: f[p, p] = f'(p), met to the square of the gap."""
    rng, gap = np.random.default_rng(2), 1e-8
    plant = replace(drawn(rng, 4), A=np.diag([-1.0, -1.0 - gap, -1.0 - 2.0 * gap, -3.0]))
    family = plant_set([plant], Sampling(60.0, 2.4e4), DIRECTIONS)
    x, y = rng.standard_normal((1, P)) + 0j, rng.standard_normal((1, M)) + 0j
    found = form_slopes(family.slopes, np.array([0]), family.variable(np.array([2.0])), x, y, False)
    for t in range(PARAMETERS):
        up, down = (response(plant, t, s * STEP, 2.0, Sampling(60.0, 2.4e4)) for s in (1.0, -1.0))
        assert found[0, t] == pytest.approx(float((x[0] @ (up - down) @ y[0]).real) / (2 * STEP),
                                            rel=1e-6)  # fmt: skip
