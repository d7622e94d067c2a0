"""The bound of the structured singular value by diagonal scalings."""

import numpy as np
import pytest

from ccd_casadi.robust.margins import mu_bound


def drawn(count: int, n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    M = rng.standard_normal((count, n, n)) + 1j * rng.standard_normal((count, n, n))
    return M * np.exp(2.0 * rng.standard_normal((count, n, 1)))


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
def test_it_is_between_the_spectral_radius_and_what_balancing_gives(n: int) -> None:
    """δ = e^jφ on all diagonals alike makes 1 - M δ singular at the spectral radius."""
    M = drawn(20, n)
    bound = mu_bound(M)
    assert (bound >= np.abs(np.linalg.eigvals(M)).max(axis=1) * (1.0 - 1e-12)).all()
    assert (bound <= np.linalg.norm(M, axis=(1, 2)) * (1.0 + 1e-9)).all()


def test_a_diagonal_scaling_changes_nothing() -> None:
    M = drawn(10, 4)
    d = np.exp(np.random.default_rng(1).standard_normal((10, 4)))
    np.testing.assert_allclose(mu_bound(d[:, :, None] * M / d[:, None, :]), mu_bound(M), rtol=2e-4)


def test_of_rank_one_it_is_the_sum_of_products() -> None:
    """μ(u vᴴ) = Σ |u_i v_i| for complex scalars."""
    rng = np.random.default_rng(2)
    u, v = (rng.standard_normal((6, 5)) + 1j * rng.standard_normal((6, 5)) for _ in range(2))
    M = u[:, :, None] * v.conj()[:, None, :]
    np.testing.assert_allclose(mu_bound(M), np.abs(u * v).sum(axis=1), rtol=1e-6)


def test_triangular_matrices_and_zeros_come_to_an_end() -> None:
    M = np.stack([np.triu(np.ones((3, 3))), np.zeros((3, 3)), np.eye(3)]).astype(complex)
    bound = mu_bound(M)
    assert np.isfinite(bound).all()
    assert bound[0] >= 1.0
    assert bound[1:] == pytest.approx([0.0, 1.0], abs=1e-12)


@pytest.mark.parametrize("n", [2, 3, 6])
def test_it_is_a_few_per_cent_looser_than_slicots_at_most(n: int) -> None:
    import slycot

    M = drawn(8, n, seed=n)
    ones = np.ones(n, dtype=int)
    theirs = [slycot.ab13md(m, ones, 2 * ones)[0] for m in M]
    ratio = mu_bound(M) / np.array(theirs)
    assert (ratio >= 1.0 - 2e-4).all()
    assert (ratio <= 1.15).all()  # at most 1.08 was seen
