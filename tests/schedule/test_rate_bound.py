"""The allowed rate of a schedule: no path at that rate lets V rise, and a faster one does."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.linalg import expm

from ccd_casadi.extensions.schedule.rate_bound import (
    Decay,
    RateBound,
    borders,
    lyapunov_functions,
    rate_bound,
)
from ccd_casadi.support.arrays import Array

PERIOD, PATHS = 1e-3, 50
PARTS = cast(Any, [SimpleNamespace(low=0.0, high=0.55), SimpleNamespace(low=0.45, high=1.0)])


def oscillators(seed: int, places: Array) -> Array:
    """A(p), sampled, of q̈ + D q̇ + (K_0 + p K_1) q = 0 with two light modes that turn with p."""
    rng = np.random.default_rng(seed)
    W, turn = rng.standard_normal((2, 2, 2))
    K = 2e3 * np.eye(2) + 3e3 * W @ W.T
    F = np.zeros((len(places), 4, 4))
    F[:, :2, 2:] = 50.0 * np.eye(2)
    F[:, 2:, :2] = -(K + places[:, None, None] * 4e2 * (turn + turn.T)) / 50.0
    F[:, 2:, 2:] = -np.diag(rng.uniform(1.0, 4.0, 2))
    return np.asarray(expm(F * PERIOD))


def inside(decay: Decay) -> float:
    """The highest rate at which V does not rise."""
    low, high = 0.0, decay.fastest
    for _ in range(40):
        rate = 0.5 * (low + high)
        low, high = (rate, high) if decay.at(rate) >= 0.0 else (low, rate)
    return low


def greedy(seed: int, P: Array, step: float, count: int) -> Array:
    """V of paths that move p by a step at most in each period, where V then is largest."""
    fine = np.arange(0.0, 1.0, step)
    A, share = oscillators(seed, fine), fine * (len(P) - 1)
    k = share.astype(int)
    between = P[k] + (share - k)[:, None, None] * (P[k + 1] - P[k])
    rng = np.random.default_rng(seed)
    j = rng.integers(len(fine), size=PATHS)
    x = rng.standard_normal((PATHS, 4))
    found = [np.einsum("ci,cij,cj->c", x, between[j], x)]
    for _ in range(count):
        x = np.einsum("cij,cj->ci", A[j], x)
        near = np.clip(j + np.array([[-1], [0], [1]]), 0, len(fine) - 1)
        V = np.einsum("ci,scij,cj->sc", x, between[near], x)
        best = V.argmax(axis=0)
        j, own = near[best, np.arange(PATHS)], V.max(axis=0)
        found.append(own)
    return np.array(found)


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_no_path_lets_V_rise_at_the_bound(seed: int) -> None:
    """Of 50 greedy paths, each step decays by m at least; at 0.5 r by the m of that rate."""
    A = oscillators(seed, np.linspace(0.0, 1.0, 101))
    for P in lyapunov_functions(A).values():
        decay = Decay(A, P, 0.01 / PERIOD, PERIOD)
        for rate in (inside(decay), 0.5 * inside(decay)):
            V = greedy(seed, P, rate * PERIOD, 400)
            assert (V[1:] <= V[:-1] * np.exp(-decay.at(rate) * PERIOD)).all()


def test_a_faster_path_lets_V_rise() -> None:
    """The paths are bad enough: 20 times the bound of the best kind lets V grow a hundredfold."""
    A = oscillators(4, np.linspace(0.0, 1.0, 101))
    P = lyapunov_functions(A)["modes"]
    decay = Decay(A, P, 0.01 / PERIOD, PERIOD)
    V = greedy(4, P, 20.0 * inside(decay) * PERIOD, 1500)
    assert V.max() > 100.0 * V[0].max()


def two_parts(seed: int) -> tuple[list[Array], Array, RateBound]:
    """Loops whose first mode has other units in the second part, and a handover that mixes."""
    loops = [oscillators(seed, np.linspace(one.low, one.high, 101)) for one in PARTS]
    mixed = np.random.default_rng(seed).standard_normal((2, 4, 4))
    E = np.array([[np.eye(4), mixed[0]], [mixed[1], np.eye(4)]])
    return loops, E, rate_bound(loops, E, PARTS, PERIOD)


def test_handovers_take_the_rate_down_and_the_way_decays() -> None:
    """Forth and back at the bound: whatever the state, its V is less when the way is done."""
    for seed in range(3):
        loops, E, found = two_parts(seed)
        way = borders(PARTS)
        assert [(one.first, one.then, one.at) for one in way] == [(0, 1, 0.55), (1, 0, 0.45)]
        assert [one.way for one in way] == pytest.approx([1.0, 1.0])
        assert found.rate > 0.0
        assert found.at in (0.45, 0.55)
        assert found.waits[found.part] == pytest.approx(1.0 / found.rate, rel=1e-3)
        step = found.rate * PERIOD
        up = np.arange(0.0, 1.0, step)
        A, k = oscillators(seed, up), np.searchsorted(up, [0.45, 0.55])
        product = np.eye(4)  # from the handover at 0.55 to the next one there
        for part in (E[0, 1], *A[k[1] :], *A[: k[0] : -1], E[1, 0], *A[k[0] :: -1], *A[: k[1]]):
            product = part @ product
        P = lyapunov_functions(loops[0])[found.kind][-1]
        root = np.linalg.cholesky(P).T
        assert np.linalg.norm(root @ product @ np.linalg.inv(root), 2) < 1.0
