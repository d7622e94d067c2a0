"""One evaluation of the rib stage: cached, alike with threads, bare of derivatives, refused."""

import numpy as np
import pytest

from ccd_casadi.extensions.rib_stage.geometry import COARSE
from ccd_casadi.extensions.rib_stage.model import RibStage, modes_at, orthonormal_directions
from ccd_casadi.plants.finite_elements import StageError
from ccd_casadi.support.worker_process import threads_permitted

A = tuple(1e-3 * np.array([1.0, 3.0, 8.0, 8.0, 16.806, 67.5]))
B = tuple(1e-3 * np.array([1.0, 3.0, 4.2446, 4.0588, 11.917, 74.974]))


def test_evaluations_are_cached_and_cannot_be_spoilt() -> None:
    stage = RibStage(order=COARSE)
    first = stage.mechanics(list(B))
    assert RibStage(order=COARSE).mechanics(np.array(B)) is first
    with pytest.raises(ValueError, match="read-only"):
        first.B[0, 0] = 0.0
    assert modes_at(stage, B) is not None


def test_threads_change_no_digit() -> None:
    """Symmetries solved side by side are those solved in turn, at a θ that no cache knows."""
    stage, other = RibStage(order=COARSE), RibStage(order=COARSE, damping_ratio=0.02)
    theta = tuple(1.01 * np.array(B))
    alone = stage.mechanics(theta)
    modes_at(stage, B), modes_at(stage, A)  # two others push θ out of the cache of spectra
    with threads_permitted(2):
        together = other.mechanics(theta)
    for one, two in zip(
        (alone.K, alone.B, alone.C, *alone.derivatives),
        (together.K, together.B, together.C, *together.derivatives),
        strict=True,
    ):
        np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize(
    "call",
    [
        lambda: RibStage(outputs="all"),
        lambda: RibStage(truncation="none"),
        lambda: RibStage(actuators=((0.2, 0.0),) * 4),
        lambda: RibStage(outputs="modal4", sensors=((0.1, 0.1), (-0.1, 0.1), (0.0, 0.0))),
        lambda: RibStage().mechanics((1e-3,) * 5),
        lambda: RibStage().mechanics((1e-3, 3e-3, 8e-3, 8e-3, 0.0, 70e-3)),
        lambda: RibStage().mechanics((1e-3, 8e-3, 8e-3, 8e-3, 9e-3, 145e-3)),
        lambda: orthonormal_directions(((0.0, 0.0), (0.1, 0.1), (0.05, 0.05)), 3),
    ],
)
def test_refusals_say_what_to_change(call) -> None:
    with pytest.raises(StageError, match=r"give|move|needs|must|keep"):
        call()


def test_without_derivatives_the_matrices_are_the_same_to_the_bit() -> None:
    stage, theta = RibStage(order=COARSE), (1.2e-3, 3.3e-3, 7e-3, 7e-3, 16e-3, 70e-3)
    whole = stage.mechanics(theta)
    bare = stage.mechanics(theta, derivatives=False)
    for name in ("M", "D", "K", "B", "C"):
        np.testing.assert_array_equal(getattr(bare, name), getattr(whole, name))
    assert [len(item) for item in bare.derivatives] == [0] * 5
