"""The allowed rate of a schedule: no path at that rate exceeds it, and it is not far below."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.linalg import expm

from ccd_casadi.extensions.schedule.handover import borders, modes_of, rate_bound
from ccd_casadi.support.arrays import Array

PERIOD, PATHS, PLACES = 1e-3, 50, np.linspace(0.0, 1.0, 101)
WHOLE = cast(Any, [SimpleNamespace(low=0.0, high=1.0)])
PARTS = cast(Any, [SimpleNamespace(low=0.0, high=0.55), SimpleNamespace(low=0.45, high=1.0)])


def oscillators(seed: int, places: Array) -> Array:
    """A(p), sampled, of q̈ + D q̇ + (K_0 + p K_1) q = 0: two light modes that turn with p, and a
    slow state that they drive."""
    rng = np.random.default_rng(seed)
    W, turn = rng.standard_normal((2, 2, 2))
    F = np.zeros((len(places), 5, 5))
    F[:, :2, 2:4] = 50.0 * np.eye(2)
    F[:, 2:4, :2] = -2e3 * np.eye(2) - 3e3 * W @ W.T
    F[:, 2:4, :2] -= places[:, None, None] * 4e2 * (turn + turn.T)
    F[:, 2:4, :2] /= 50.0
    F[:, 2:4, 2:4] = -np.diag(rng.uniform(1.0, 4.0, 2))
    F[:, 4, :2], F[:, 4, 4] = rng.standard_normal(2) * (1.0 + places[:, None]), -0.3
    return np.asarray(expm(F * PERIOD))


@pytest.mark.parametrize("seed", [0, 2, 4])
@pytest.mark.parametrize("part_of_it", [1.0, 0.5])
def test_no_path_exceeds_what_is_bounded(seed: int, part_of_it: float) -> None:
    """50 paths, whose steps are those that raise n most: n of each stays below that of N."""
    A = oscillators(seed, PLACES)
    found = rate_bound([A], np.empty((1, 1, 5, 5)), WHOLE, PERIOD)
    modes, step = modes_of(A), part_of_it * found.rate * PERIOD
    assert modes.slow == 1
    N = modes.step(step / 0.01)
    assert np.abs(np.linalg.eigvals(N)).max() < 1.0
    fine = np.arange(0.0, 1.0, step)
    A, share = oscillators(seed, fine), fine * (len(PLACES) - 1)
    k = share.astype(int)
    Y = modes.Y[k] + (share - k)[:, None, None] * (modes.Y[k + 1] - modes.Y[k])

    def sizes(j: np.ndarray, x: Array) -> Array:
        z = np.abs(np.einsum("...ij,...j->...i", Y[j], x))
        return np.stack([z[..., 0], np.linalg.norm(z[..., 1:], axis=-1)], axis=-1)

    rng = np.random.default_rng(seed)
    j, x = rng.integers(len(fine), size=PATHS), rng.standard_normal((PATHS, 5))
    most = sizes(j, x)
    for _ in range(400):
        x = np.einsum("cij,cj->ci", A[j], x)
        near = np.clip(j + np.array([[-1], [0], [1]]), 0, len(fine) - 1)
        n, most = sizes(near, np.broadcast_to(x, (3, *x.shape))), most @ N.T
        best = (n / most).max(axis=2).argmax(axis=0)
        own = np.arange(PATHS)
        j = near[best, own]
        assert (n[best, own] <= most).all()


@pytest.mark.parametrize("seed", range(3))
def test_the_way_decays_at_the_bound_and_not_far_above(seed: int) -> None:
    """Handovers that turn and double x: forth and back leaves less at r, more at 8 r."""
    Q = np.linalg.qr(np.random.default_rng(seed).standard_normal((5, 5)))[0]
    E = np.array([[np.eye(5), 2.0 * Q], [2.0 * Q.T, np.eye(5)]])
    loops = [oscillators(seed, np.linspace(one.low, one.high, 101)) for one in PARTS]
    found = rate_bound(loops, E, PARTS, PERIOD)
    way = borders(PARTS)
    assert [(one.first, one.then, one.at) for one in way] == [(0, 1, 0.55), (1, 0, 0.45)]
    assert [one.way for one in way] == pytest.approx([1.0, 1.0])
    assert found.at in (0.45, 0.55)
    assert found.waits == pytest.approx([1.0 / found.rate] * 2)

    def left(rate: float) -> float:
        up = np.arange(0.0, 1.0, rate * PERIOD)
        A, (k, m) = oscillators(seed, up), np.searchsorted(up, [0.45, 0.55])
        product = np.eye(5)  # from the handover at 0.55 to the next one there
        for part in (E[0, 1], *A[m:], *A[:k:-1], E[1, 0], *A[k::-1], *A[:m]):
            product = part @ product
        return float(np.abs(np.linalg.eigvals(product)).max())

    assert left(found.rate) < 1.0 < left(8.0 * found.rate)
