"""Undamped modes: the judge has their poles on the axis, where S is 0 and GS is 1/K."""

import numpy as np
import pytest

from ccd_casadi.fixed_structure import Bounds, Sampling
from ccd_casadi.fixed_structure.certificate import judge_plants
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.modal import FREE, modal_plant, require_damping
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.errors import PlantError

K = StateSpace(np.array([[-40.0]]), np.array([[1.0]]), np.array([[-1500.0]]), np.array([[40.0]]))
BOUNDS = Bounds(S_max=4.0, S_low=0.9, omega_low=0.01, compliance_max=100.0)


def two_masses(damping: float, force: float = 1.0, sensor: float = 1.0) -> Mechanics:
    """On a spring, held by another so that no body is free; the second mode as driven and seen."""
    K = np.array([[1.5, -1.0], [-1.0, 1.0]])
    B, C = np.array([[force], [0.0]]), np.array([[sensor, 0.0]])
    none = tuple(np.zeros((0, *part.shape)) for part in (K, K, K, B, C))
    return Mechanics(np.eye(2), damping * K, K, B, C, None, none)  # type: ignore[arg-type]


@pytest.mark.parametrize("sampling", [None, Sampling(40.0, 5_000.0)])
def test_figures_are_the_limit_of_ever_less_damping(sampling: Sampling | None) -> None:
    plants = [modal_plant(two_masses(d), FREE).state_space for d in (0.0, 1e-7, 1e-2)]
    none, little, more = (judge_plants([own], K, BOUNDS, sampling, False)[0] for own in plants)
    assert none.stable
    for name in ("S_peak", "KS", "T", "GS", "crossing"):
        assert getattr(none, name) == pytest.approx(getattr(little, name), rel=1e-4)
    assert none.confirmed
    assert more.S_peak != none.S_peak


def test_at_the_pole_the_loop_has_its_limits() -> None:
    plant = modal_plant(two_masses(0.0), FREE).state_space
    loop, omega = Loop(plant, K, None, ()), np.sort(plant.on_axis)
    assert omega**2 == pytest.approx(np.linalg.eigvalsh(two_masses(0.0).K))
    alias = 2.0 * np.pi / 3.0 - omega[1:]  # of a period of 3 s
    assert (plant.off_poles(alias, 3.0) > alias).all()
    curves = loop.curves(omega)
    assert np.abs(curves["S"]).max() < 1e-6
    assert curves["T"] == pytest.approx(1.0, rel=1e-6)
    inverse = 1.0 / K.response(omega)
    assert curves["GS"] == pytest.approx(inverse, rel=1e-5)


def test_a_loop_damps_what_it_reaches() -> None:
    assert require_damping(modal_plant(two_masses(0.0), FREE))
    assert not require_damping(modal_plant(two_masses(0.01), FREE))
    hidden = two_masses(0.0)
    hidden.K[:] = np.diag([1.0, 2.0])
    with pytest.raises(PlantError, match="is not damped: the loop does not reach it"):
        require_damping(modal_plant(hidden, FREE))
    with pytest.raises(PlantError, match="has a negative damping; correct the damping, or A"):
        require_damping(modal_plant(two_masses(-0.01), FREE))
