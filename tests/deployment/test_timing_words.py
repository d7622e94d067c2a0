"""A deployment that falls short names its true cause: what differs from the design, or the rate."""

import re
from types import SimpleNamespace

from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few

from ccd_casadi.deploy import needed_words, shortfall_words
from ccd_casadi.deployment.discretise import Conversion
from ccd_casadi.lti.loop import Sampling

RATES = st.sampled_from([500.0, 1000.0, 4000.0, 8000.0, 10000.0])
DELAYS = st.sampled_from([0.0, 20.0, 100.0, 300.0])


def short_of(rate_hz: float, delay_us: float, needed_hz: float | None, **more):  # type: ignore[no-untyped-def]
    """A deployment that exceeds a bound."""
    return SimpleNamespace(
        shortfalls=("peak of S 2.07 (+18 %)",), rate_hz=rate_hz, delay=1e-6 * delay_us,
        needed_hz=needed_hz, unverified="", **more,
    )  # fmt: skip


@few(max_examples=60)
@given(rate=RATES, delay=DELAYS, own_rate=RATES, own_delay=DELAYS, known=st.booleans())
def test_what_differs_from_the_design_is_the_cause_and_nothing_else(
    rate: float, delay: float, own_rate: float, own_delay: float, known: bool
) -> None:
    own = Sampling(own_rate, own_delay)
    found = short_of(rate, delay, own_rate if known else None, designed_for=own)
    words = shortfall_words(found)
    assert ("the delay exceeds" in words) == (delay > own_delay)
    assert ("the rate is below" in words) == (rate < own_rate)
    assert "is needed" not in words
    assert (f"loop.delay_us = {delay:g}" in words) == (delay > own_delay)
    assert (f"loop.rate_hz = {rate:g}" in words) == (rate < own_rate)
    assert ("as it was designed" in words) == ((rate, delay) == (own_rate, own_delay))
    assert f"{own_rate:g} Hz and {own_delay:g} us" in needed_words(found)


@few(max_examples=40)
@given(rate=RATES, needed=st.none() | RATES)
def test_a_rate_is_needed_only_where_the_loop_has_less(rate: float, needed: float | None) -> None:
    found = short_of(rate, 100.0, needed, designed_for=None, conversion=Conversion.LEAD)
    words = shortfall_words(found)
    said = re.search(r"([\d.]+) Hz is needed", words)
    assert (said is not None) == (needed is not None and needed > rate)
    assert said is None or float(said[1]) == needed
    assert ("shorten the delay" in words) == (needed is None)
