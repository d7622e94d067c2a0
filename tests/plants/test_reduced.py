"""The rib stage by a reduced basis, against its finite elements."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccd_casadi.extensions.rib_stage import reduced
from ccd_casadi.extensions.rib_stage.geometry import COARSE, Geometry, PointMass
from ccd_casadi.extensions.rib_stage.model import TWENTY, RibStage, fade
from ccd_casadi.extensions.rib_stage.stage_plant import plant_of_stage
from ccd_casadi.plants.plant import Mechanics, nearby_model
from ccd_casadi.plants.registry import two_mass_plant
from ccd_casadi.support.arrays import Array

HERE = np.array([1.2e-3, 3.3e-3, 5e-3, 5e-3, 14e-3, 74e-3])
STEP = np.array([1e-4, 1e-4, 3e-4, -3e-4, 8e-4, 8e-4])
BARE = RibStage(order=COARSE)
LOADED = replace(BARE, geometry=Geometry(point_masses=(PointMass(0.03, 0.0, 0.05),)))
FADING = replace(LOADED, fading=2)


def reduced_at(stage: RibStage, known: Sequence[Array], theta: Array) -> Mechanics:
    """By what is known."""
    made = reduced.bases(stage, tuple(tuple(place.tolist()) for place in known))
    return reduced.mechanics(stage, made, tuple(theta.tolist()))


def frequencies(system: Mechanics) -> Array:
    """Of the flexible modes, in rad/s."""
    return np.asarray(np.sqrt(np.diag(system.K)[3:]))


def strengths(system: Mechanics) -> Array:
    """c bᵀ of every mode (n, outputs, inputs), which no sign of a mode moves."""
    return np.asarray(system.C.T[:, :, None] * system.B[:, None, :])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stage", "within"),
    [(BARE, 1e-7), *(pytest.param(s, 1e-3, marks=pytest.mark.slow) for s in (LOADED, FADING))],
)
def test_at_a_known_theta_it_has_the_modes_of_the_elements(stage: RibStage, within: float) -> None:
    known = [HERE, HERE + STEP]
    for theta in known:
        reported = reduced_at(stage, known, theta)
        true = stage.mechanics(theta, derivatives=False)
        np.testing.assert_allclose(frequencies(reported), frequencies(true), rtol=within)
        size = np.abs(strengths(true)).max()
        np.testing.assert_allclose(strengths(reported), strengths(true), atol=10.0 * within * size)


@pytest.mark.parametrize(
    "stage",
    [replace(LOADED, modes=TWENTY), FADING,
     *(pytest.param(s, marks=pytest.mark.slow) for s in (BARE, replace(BARE, modes=TWENTY)))],
)
def test_at_a_known_theta_displacements_move_as_those_of_the_elements(stage: RibStage) -> None:
    """A search on a basis ends elsewhere where its slopes are not the elements'."""
    reported, true = reduced_at(stage, [HERE], HERE), stage.mechanics(tuple(HERE))
    signs = np.sign(np.einsum("im,im->i", reported.B, true.B))
    seen = np.abs(true.B).max(1) > 1e-6 * np.abs(true.B).max()  # what corners neither drive nor see
    moved = np.tensordot(STEP, true.derivatives[3], 1)[seen]
    found = (signs[:, None] * np.tensordot(STEP, reported.derivatives[3], 1))[seen]
    np.testing.assert_allclose(found, moved, atol=5e-3 * np.abs(moved).max())


@pytest.mark.slow
def test_beside_what_is_known_it_is_off_by_the_square_of_the_way() -> None:
    known = [HERE]

    def missed(share: float) -> float:
        theta = HERE + share * STEP
        reported, true = (reduced_at(BARE, known, theta), BARE.mechanics(theta))
        return float(np.abs(frequencies(reported) / frequencies(true) - 1.0).max())

    assert missed(1.0) < 1e-2
    assert missed(0.5) < 0.3 * missed(1.0)
    more = reduced_at(BARE, [*known, HERE + STEP], HERE + 0.5 * STEP)
    true = frequencies(BARE.mechanics(tuple(HERE + 0.5 * STEP)))
    assert np.abs(frequencies(more) / true - 1.0).max() < 0.1 * missed(0.5)


@pytest.mark.slow
@pytest.mark.parametrize("stage", [BARE, LOADED, FADING])
def test_its_derivatives_are_those_of_the_small_problem(stage: RibStage) -> None:
    known = [HERE, HERE + STEP, HERE - STEP]
    here, e = HERE + 0.3 * STEP, 1e-4
    reported = reduced_at(stage, known, here)
    up, down = (reduced_at(stage, known, here + s * e * STEP) for s in (1.0, -1.0))
    slope = np.einsum("t,tii->i", STEP, reported.derivatives[2])
    moved = (np.diag(up.K) - np.diag(down.K)) / (2.0 * e)
    np.testing.assert_allclose(slope, moved, atol=1e-3 * np.abs(moved).max())
    dB, dC = (np.tensordot(STEP, reported.derivatives[k], 1) for k in (3, 4))
    slope = dC.T[:, :, None] * reported.B[:, None, :] + reported.C.T[:, :, None] * dB[:, None, :]
    moved = (strengths(up) - strengths(down)) / (2.0 * e)
    # What masses bend of higher modes turns with θ; its slope is that of modes that stay.
    within = 1e-4 if stage is BARE else 0.1
    np.testing.assert_allclose(slope, moved, atol=within * np.abs(moved).max())


@given(st.lists(st.floats(1.0, 5.0), min_size=5, max_size=8), st.integers(1, 3))
def test_what_fades_is_whole_at_one_end_and_gone_at_the_other(
    steps: list[float], fading: int
) -> None:
    values, rates = np.cumsum(steps), np.array(steps[::-1])[None]
    full = len(values) - 1 - fading
    w, dw = fade(values, rates, full)
    assert (w[:full] == 1.0).all()
    assert (dw[:, :full] == 0.0).all()
    assert (np.diff(w) <= 0.0).all()
    assert (w > 0.0).all()
    up, down = (fade(values + s * 1e-6 * rates[0], rates, full)[0] for s in (1.0, -1.0))
    np.testing.assert_allclose(dw[0], (up - down) / 2e-6, atol=1e-8)
    # The next one takes the place of the last one that counts whole, and one that is gone comes.
    meet = np.insert(values, full, values[full - 1])[: len(values)]
    assert fade(meet, np.zeros((1, len(meet))), full)[0][full] == 1.0


@pytest.mark.slow
def test_with_fading_modes_an_answer_moves_without_a_jump() -> None:
    """Where the ribs move, the twentieth mode and the next meet and change their shapes."""
    along = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 3.0 * STEP[5]])
    way = [HERE + share * along for share in np.linspace(0.35, 0.6, 16)]

    def jump(stage: RibStage) -> float:
        """The largest step of what a static force bends of the flexible modes."""
        static = []
        for theta in way:
            found = reduced_at(stage, [HERE], theta)
            B, lam = found.B[3:], np.diag(found.K)[3:]
            static.append(B.T @ (B / lam[:, None]))
        return float(np.abs(np.diff(static, axis=0)).max())

    assert jump(replace(FADING, modes=TWENTY)) < 0.3 * jump(replace(LOADED, modes=TWENTY))


def test_a_plant_evaluates_it_in_its_own_order_of_parameters() -> None:
    names = ("H", "h", "t_o", "t_i", "t_c", "x_i")
    plant, place = plant_of_stage(BARE, names), [4, 0, 1, 2, 3, 5]
    there = HERE[place] + 0.1 * STEP[place]
    reported, true = nearby_model(plant, [HERE[place]], HERE[place])(there), plant.evaluate(there)
    np.testing.assert_allclose(frequencies(reported), frequencies(true), rtol=1e-3)
    np.testing.assert_allclose(
        reported.derivatives[2], true.derivatives[2], atol=0.1 * np.abs(true.derivatives[2]).max()
    )


def test_modes_that_may_cross_have_places_of_their_own() -> None:
    """A payload on the axis y = 0 leaves even modes and odd ones: as many of each, lowest first."""
    true = LOADED.mechanics(tuple(HERE), derivatives=False)
    for found in (true, reduced_at(LOADED, [HERE], HERE)):
        mirrored = found.B[3:, [3, 2, 1, 0]]  # the corners (a, a), (-a, a), (-a, -a), (a, -a)
        size = 1e-6 * np.abs(found.B).max()
        np.testing.assert_allclose(mirrored[:5], found.B[3:8], atol=size)
        np.testing.assert_allclose(mirrored[5:], -found.B[8:], atol=size)
        for part in np.split(frequencies(found), 2):
            np.testing.assert_array_equal(part, np.sort(part))


def test_where_the_order_of_modes_is_not_kept_it_does_not_apply() -> None:
    middle = Geometry(point_masses=(PointMass(0.0, 0.0, 0.05),))
    assert reduced.applies(BARE)
    assert reduced.applies(LOADED)
    assert not reduced.applies(replace(BARE, geometry=middle))
    assert not reduced.applies(replace(BARE, truncation="frequency"))


def test_a_model_nearby_is_a_speed_up_and_decides_no_strategy() -> None:
    """What a search saves is said by the plant's own cost."""
    plant = plant_of_stage(BARE)
    assert plant.expensive
    assert plant.nearby is not None
    assert replace(plant, nearby=None).expensive
    cheap = replace(two_mass_plant(("m1", "m2")), nearby=plant.nearby)
    assert not cheap.expensive
