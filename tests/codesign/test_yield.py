"""The yield bound is exact: it covers the truth as often as it says, and SciPy agrees."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta

from ccd_casadi.analysis.yield_bound import Yield, YieldOptions, yield_bound


@given(st.integers(1, 5000), st.data(), st.floats(0.5, 1.0 - 1e-7))
def test_it_is_the_quantile_of_the_beta_distribution(
    draws: int, data: st.DataObject, confidence: float
) -> None:
    survived = data.draw(st.integers(1, draws))
    expected = beta.ppf(1.0 - confidence, survived, draws - survived + 1)
    assert yield_bound(survived, draws, confidence) == pytest.approx(expected, rel=1e-8)


def test_it_covers_the_true_yield_of_a_thousand_toys() -> None:
    """At 90 % confidence at most 10 % of the bounds may exceed the truth: 3 deviations above."""
    rng, toys, confidence = np.random.default_rng(7), 1000, 0.9
    share = rng.uniform(0.5, 1.0, toys)
    draws = rng.integers(5, 400, toys)
    wrong = sum(
        yield_bound(int(rng.binomial(n, q)), int(n), confidence) > q
        for q, n in zip(share, draws, strict=True)
    )
    assert wrong <= 100 + 3.0 * np.sqrt(1000 * 0.1 * 0.9)
    assert wrong >= 50  # and it is not loose: the binomial's steps cost less than half


def test_fourteen_thousand_draws_prove_a_thousandth() -> None:
    assert yield_bound(14_000, 14_000) >= 0.999 > yield_bound(13_800, 13_800)
    assert yield_bound(0, 100) == 0.0


def test_words_round_the_share_down() -> None:
    found = Yield(1500, 1500)
    stated = float(found.words.split("at least ")[1].split(" %")[0]) / 100.0
    assert stated <= found.least < stated + 1e-4
    assert found.entry["confidence"] == YieldOptions().confidence


@pytest.mark.parametrize(("survived", "draws"), [(-1, 3), (4, 3)])
def test_more_survivors_than_draws_are_refused(survived: int, draws: int) -> None:
    with pytest.raises(ValueError, match="draws survived"):
        yield_bound(survived, draws)


def test_a_design_that_draws_have_changed_counts_every_set_of_them() -> None:
    """Each may be wrong with 1e-6: the share is that of the last, the confidence that of all."""
    first, third = Yield(3000, 3000), Yield(3000, 3000, 3)
    assert third.least == first.least
    assert "confidence 1 - 1e-6)" in first.words
    assert "confidence 1 - 3e-6)" in third.words
    assert 1.0 - third.entry["confidence"] == pytest.approx(3e-6)
