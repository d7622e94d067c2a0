"""Rigid is what K does not resist, in any units and beside any stiff link; the rest is flexible."""

from dataclasses import replace

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ccd_casadi.lti.loop import zoh
from ccd_casadi.lti.state_space import StateSpace, balance_system, closed_loop
from ccd_casadi.plants.as_written import as_written, driven_and_measured, natural_modes
from ccd_casadi.plants.modal import FREE, Perturbation, modal_plant, without_hidden_rigid_modes
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

decades = st.floats(-1.0, 1.0)


def springs(ends: list[tuple[int, int]], k: Array, n: int) -> Array:
    """K of springs between coordinates; -1 is the ground."""
    K = np.zeros((n, n))
    for (i, j), stiffness in zip(ends, k, strict=True):
        e = np.zeros(n)
        e[i] = 1.0
        if j >= 0:
            e[j] = -1.0
        K += stiffness * np.outer(e, e)
    return K


def chain(masses: Array, stiffness: Array, damping: float = 0.003) -> Mechanics:
    """A free chain, driven and measured at its first mass."""
    n = len(masses)
    K = springs([(i, i + 1) for i in range(n - 1)], stiffness, n)
    first = np.eye(n)[:, :1]
    none = tuple(np.zeros((0, *shape)) for shape in ((n, n), (n, n), (n, n), (n, 1), (1, n)))
    return Mechanics(np.diag(masses), 0.0 * K, K, first, first.T, damping, none)  # type: ignore[arg-type]


@settings(max_examples=25, deadline=None)
@given(m=st.lists(decades, min_size=3, max_size=5), k=decades, stiff=st.floats(2.0, 7.0),
       units=st.lists(st.floats(-3.0, 3.0), min_size=5, max_size=5))  # fmt: skip
def test_one_mode_of_a_free_chain_is_rigid_beside_any_stiff_link_in_any_units(
    m, k, stiff, units
) -> None:
    n = len(m)
    masses = 10.0 ** np.array(m)
    masses[-1] *= 1e-6  # a small node on a penalty link
    stiffness = 10.0 ** (4.0 + k) * np.ones(n - 1)
    stiffness[-1] *= 10.0**stiff
    system = chain(masses, stiffness)
    own = 10.0 ** np.array(units[:n])  # other units of each coordinate
    K, M = (part * own * own[:, None] for part in (system.K, system.M))
    lam, shapes, rigid = natural_modes(K, M)
    assert rigid.tolist() == [True] + [False] * (n - 1)
    with mp.workdps(60):
        root = mp.diag([1 / mp.sqrt(mp.mpf(value)) for value in masses.tolist()])
        truth = sorted(mp.eigsy(root * mp.matrix(system.K.tolist()) * root, eigvals_only=True))
        off = [abs(float(x / mp.mpf(own)) - 1.0) for own, x in zip(truth, lam, strict=True)][1:]
    assert max(off) < 1e-5  # 1e-7 was seen for links of 1e14 N/m
    assert np.abs(shapes.T @ M @ shapes - np.eye(n)).max() < 1e-6


def test_what_lies_between_rigid_and_held_is_refused_unless_the_case_states_it() -> None:
    system = chain(np.ones(3), np.array([1e6, 1e6]))
    held = system.K + np.diag([1e-5, 0.0, 0.0])  # 1e-11 of the springs
    with pytest.raises(PlantError, match=r"state \[suspension\] rigid_modes = 1"):
        natural_modes(held, system.M)
    assert natural_modes(held, system.M, stated=1)[2].tolist() == [True, False, False]
    soft = system.K + np.diag([1.0, 0.0, 0.0])
    lam, _, rigid = natural_modes(soft, system.M)
    assert not rigid.any()
    assert abs(lam[0] / (1.0 / 3.0) - 1.0) < 1e-5  # 1 N/m on 3 kg
    lam, _, rigid = natural_modes(system.K - np.diag([1.0, 0.0, 0.0]), system.M)
    assert not rigid.any()
    assert abs(lam[0] / (-1.0 / 3.0) - 1.0) < 1e-5  # what drives it away is no rigid-body mode


OFF = [Perturbation(), Perturbation(0.03, 0.5), Perturbation(-0.02, 2.0, (0.05, -0.04))]


@pytest.mark.parametrize("off", OFF, ids=["model", "common", "single"])
def test_the_plant_as_written_answers_as_its_modes_do(off) -> None:
    system = chain(np.array([4.0, 1.0, 0.3]), np.array([2500.0, 9000.0]))
    modal = modal_plant(system, FREE, off).state_space
    written = as_written(system, shift=off.shift, modes=off.modes, damping=off.damping)
    s = 2j * np.pi * np.geomspace(0.05, 500.0, 400)
    a, b = modal.at(s), written.at(s)
    assert np.abs(a - b).max(axis=(1, 2)) / np.abs(a).max(axis=(1, 2)) == pytest.approx(0, abs=1e-9)
    held = [zoh(own, 1e-3, 4e-4) for own in (modal, written)]
    z = np.exp(1e-3 * s)
    a, b = (own.at(z) for own in held)
    assert np.abs(a / b - 1.0).max() < 1e-6


def test_free_motions_that_nothing_drives_or_reads_are_left_out_and_halves_are_refused() -> None:
    system = chain(np.array([4.0, 1.0, 2.0]), np.array([2500.0, 0.0]))  # the last one flies alone
    assert natural_modes(system.K, system.M)[2].sum() == 2
    seen = without_hidden_rigid_modes(modal_plant(system, FREE))
    s = 2j * np.pi * np.geomspace(0.1, 100.0, 50)
    pair = chain(np.array([4.0, 1.0]), np.array([2500.0]))
    for found in (seen.state_space, as_written(system)):
        assert len(found.A) == 4
        assert np.abs(found.at(s) / as_written(pair).at(s) - 1.0).max() < 1e-9
    pushed = replace(system, B=np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]))
    with pytest.raises(PlantError, match="driven and not measured"):
        as_written(pushed)
    read = replace(system, C=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    with pytest.raises(PlantError, match="measured and not driven"):
        without_hidden_rigid_modes(modal_plant(read, FREE))


@settings(max_examples=10, deadline=None)
@given(apart=st.floats(1.5, 3.5), node=st.floats(-6.0, -4.0), soft=st.floats(6.0, 7.5))
def test_the_loop_of_the_plant_as_written_keeps_its_slow_poles_beside_a_stiff_link(
    apart, node, soft
) -> None:
    """In the chain's own coordinates double precision says that loops of this kind are unstable.

    Below a ratio of about 10 of both stiffnesses some are lost in any coordinates."""
    masses = np.array([100.0, 70.0, 10.0**node])
    stiffness = 10.0 ** np.array([soft, soft + apart])
    system = chain(masses, stiffness, damping=0.01)
    crossing = 0.1 * np.sqrt(10.0**soft / 100.0)
    gain, lead, slow = 170.0 * crossing**2, 3.0, 1e-3 * crossing
    roll_off = 1e8
    rates = np.array([0.0, lead * crossing, roll_off])
    read = [
        gain / lead * slow,
        -gain * (lead - 1.0 / lead) * lead * crossing,
        gain * lead * roll_off,
    ]
    controller = StateSpace(-np.diag(rates), np.ones((3, 1)), np.array([read]), np.zeros((1, 1)))
    loop = closed_loop(as_written(system), controller)
    found = np.linalg.eigvals(balance_system(loop.A, loop.B_r, loop.C_y)[0])
    with mp.workdps(60):
        root = [mp.sqrt(m) for m in masses.tolist()]
        scaled = mp.matrix(3, 3)
        for i, j in np.ndindex(3, 3):
            scaled[i, j] = mp.mpf(system.K[i, j]) / root[i] / root[j]
        lam, shapes = mp.eigsy(scaled)
        A = mp.zeros(9, 9)
        for i in range(3):
            omega = mp.sqrt(lam[i]) if i else mp.mpf(0)
            A[i, 3 + i], A[3 + i, i], A[3 + i, 3 + i] = 1, -(omega**2), -2 * omega / 100
            seen = shapes[0, i] / root[0]
            for k in range(3):
                A[3 + i, 6 + k], A[6 + k, i] = seen * mp.mpf(float(read[k])), -seen
        for k in range(3):
            A[6 + k, 6 + k] = -mp.mpf(float(rates[k]))
        true = np.array([complex(pole) for pole in mp.eig(A, right=False)])
    slowest = true[np.argsort(np.abs(true))[:3]]
    off = np.abs(slowest[:, None] - found).min(axis=1) / np.abs(slowest)
    assert off.max() < 1e-4


def test_a_rigid_body_that_is_weakly_driven_and_measured_is_kept() -> None:
    """A thousandth of the other's force and reading is a motion that the loop has to hold."""
    for share, kept in ((1e-3, 2), (1e-6, 2), (1e-12, 1)):
        sides = np.diag([1.0, share])
        T, back = driven_and_measured(sides, sides)
        assert T.shape == (2, kept)
        assert back @ T == pytest.approx(np.eye(kept))
