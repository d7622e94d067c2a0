"""What limits the bandwidth: shares of γ that a certificate bounds, and the figures named."""

import numpy as np
import pytest
from oracles.helpers import HZ, problem
from scipy.signal import bilinear, freqz

from ccd_casadi.analysis.loop_view import LoopView
from ccd_casadi.inner_problem.kinds import design_view
from ccd_casadi.inner_problem.problem import scaled_plant
from ccd_casadi.inner_problem.sections_words import SectionWords, sampled_words
from ccd_casadi.reporting.limit_figures import limit_sentences, shares, table_limits
from ccd_casadi.support.text import display_unit
from ccd_casadi.synthesis.synthesis import synthesise


@pytest.fixture(scope="module")
def loop() -> LoopView:
    plant = scaled_plant(problem(), (60.0, 60.0))
    weights = problem().weights.at(HZ * 800.0, HZ * 40.0)
    design = synthesise(plant, weights, omega_low=HZ)
    return design_view(
        problem(), (60.0, 60.0), design.controller, weights=weights, gamma=design.figures.gamma,
        bandwidth_hz=design.figures.bandwidth / HZ,
    )  # fmt: skip


def test_no_share_exceeds_the_certified_norm(loop: LoopView) -> None:
    found = np.array([shares(loop, hz) for hz in loop.hz])
    assert found.max() <= 1.0
    assert np.sqrt((found**2).sum(axis=1)).max() == pytest.approx(1.0, abs=1e-3)


def test_the_words_name_the_zero_that_limits_case_a(loop: LoopView) -> None:
    words = " ".join(limit_sentences(loop))
    assert "At ω_b = 55.56 Hz |S| is at 98 % of its bound" in words
    assert "nearest transmission zero is at 147.9 Hz" in words
    table = table_limits(loop)
    places = [row[0] for row in table.rows]
    assert places[:2] == ["half the bandwidth", "bandwidth ω_b"]
    assert places.count("peak of S") == 1  # others are local
    assert all(0.0 < value < 100.0 for row in table.rows for value in row[2:5])


def test_lengths_of_a_stage_are_shown_in_mm() -> None:
    assert display_unit("m", 95e-3) == ("mm", 1e3)
    assert display_unit("m", 2.0) == ("m", 1.0)
    assert display_unit("kg", 1e-3) == ("kg", 1.0)


def test_a_root_acts_where_the_words_place_it_in_the_sampled_controller() -> None:
    """What a section has at f its K(z) by SciPy's bilinear transform has at the frequency named."""
    f, rate, zeta = 6366.2, 20000.0, 0.1
    words = sampled_words([SectionWords("roll-off", None, None, f, zeta)], rate)
    acts = float(words.split(" to ")[1].removesuffix(" Hz"))
    assert words == f"at 20000 Hz Tustin's rule takes 6366 Hz to {acts:.4g} Hz"
    w = HZ * f
    b, a = bilinear([1.0], [1.0 / w**2, 2.0 * zeta / w, 1.0], rate)
    _, gain = freqz(b, a, worN=[acts], fs=rate)
    assert gain[0] == pytest.approx(1.0 / (2.0j * zeta), rel=2e-3)
    assert not sampled_words([SectionWords("lead", 10.0, None, 900.0)], rate)
    assert not sampled_words([SectionWords("roll-off", pole_hz=f)], None)
