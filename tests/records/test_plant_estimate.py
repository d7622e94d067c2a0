"""The plant by a record of its closed loop: no bias of the noise, within the stated spread."""

from dataclasses import replace

import numpy as np
import pytest
from oracles.closed_loops import RATE, Loop, by_ratio, random_loop, recorded

from ccd_casadi.extensions.records.plant_estimate import (
    EstimateOptions,
    PlantEstimate,
    estimate_plant,
)
from ccd_casadi.extensions.records.record_findings import findings
from ccd_casadi.extensions.records.time_series import TimeSeries
from ccd_casadi.support.errors import UserError

OPTIONS = EstimateOptions()
SAMPLES, NOISES = 4096, 8


@pytest.fixture(scope="module", params=[3, 8])
def loop(request: pytest.FixtureRequest) -> Loop:
    return random_loop(np.random.default_rng(request.param))


@pytest.fixture(scope="module")
def records(loop: Loop) -> list[TimeSeries]:
    rng = np.random.default_rng(1)
    return [recorded(loop, rng, SAMPLES, 0.3) for _ in range(NOISES)]


@pytest.fixture(scope="module")
def estimates(records: list[TimeSeries]) -> list[PlantEstimate]:
    return [estimate_plant(one) for one in records]


def test_noise_in_the_loop_does_not_bias_the_estimate_as_it_does_the_ratio(
    loop: Loop, records: list[TimeSeries], estimates: list[PlantEstimate]
) -> None:
    """Over noises and neighbouring lines. Measured: 2 and 2.5 %, what is left of the noise, beside
    12 and 20 % of y/u; with longer records of 50 loops at most 1.8 % beside 10 to 28 %
    (oracles/closed_loops.py)."""
    hz = estimates[0].hz
    kept = (hz > 2.0) & (hz < 0.4 * RATE) & (estimates[0].coherence > 0.8)
    G = loop.response(hz[kept])
    ours = np.mean([one.G[kept] / G - 1.0 for one in estimates], axis=0)
    ratio = np.mean([by_ratio(one, hz[kept]) / G - 1.0 for one in records], axis=0)
    bias, other = (
        np.median([abs(part.mean()) for part in np.array_split(one, max(1, len(one) // 40))])
        for one in (ours, ratio)
    )
    assert bias < 0.04
    assert other > max(0.08, 3.0 * bias)


def test_the_plant_lies_within_the_spread_on_the_stated_share_of_lines(
    loop: Loop, records: list[TimeSeries], estimates: list[PlantEstimate]
) -> None:
    """Measured: 96.3 and 96.1 % with 95 % stated; on 50 loops: 95.5 to 96.6 %."""
    hz = estimates[0].hz
    kept = (hz > 2.0) & (hz < 0.4 * RATE)
    inside = [np.abs(one.G - loop.response(hz)) <= one.spread for one in estimates]
    share = np.mean(inside, axis=0)[kept].mean()
    assert 0.93 < share < 0.99
    several = estimate_plant(records)  # measured: 0.27, and 94.9 and 94.6 %
    assert np.median(several.spread / estimates[0].spread) < 0.6
    assert np.mean((np.abs(several.G - loop.response(hz)) <= several.spread)[kept]) > 0.92


def test_a_higher_confidence_is_a_wider_spread(records: list[TimeSeries]) -> None:
    usual, sure = (
        estimate_plant(records[0], EstimateOptions(confidence=share)) for share in (0.95, 0.99)
    )
    assert np.array_equal(usual.G, sure.G)
    assert (sure.spread > usual.spread).all()


def test_units_scale_the_estimate(records: list[TimeSeries]) -> None:
    first = records[0]
    one = estimate_plant(first)
    other = estimate_plant(replace(first, position=1e6 * first.position, force=0.1 * first.force))
    np.testing.assert_allclose(other.G, 1e7 * one.G, rtol=1e-6)
    np.testing.assert_allclose(other.spread, 1e7 * one.spread, rtol=1e-6)


def test_a_periodic_excitation_is_found_and_gives_its_own_lines(loop: Loop) -> None:
    """Four periods of 1000 samples: 2 Hz from line to line, without leakage."""
    rng = np.random.default_rng(5)
    found = estimate_plant(_driven(loop, np.tile(rng.standard_normal(1000), 6)[:5500]))
    assert found.periods == 5
    assert found.hz[0] == pytest.approx(2.0)
    kept = found.hz < 0.3 * RATE
    error = np.abs(found.G / loop.response(found.hz) - 1.0)[kept]
    assert np.median(error) < 1e-3  # measured: 2e-6


def _driven(loop: Loop, r: np.ndarray) -> TimeSeries:
    from oracles.closed_loops import _run

    y, u = _run(loop, np.stack([r, 0.0 * r]))
    return TimeSeries(1.0 / RATE, r, u, y)


def test_a_step_excites_what_a_pulse_does(loop: Loop) -> None:
    """First differences make a pulse of it: without noise the plant is there at all lines."""
    r = np.where((np.arange(8000) > 2000) & (np.arange(8000) < 5000), 1.0, 0.0)
    found = estimate_plant(_driven(loop, r))
    kept = (found.hz > 2.0) & (found.hz < 300.0)
    assert np.median(np.abs(found.G / loop.response(found.hz) - 1.0)[kept]) < 0.01


def test_what_is_missing_has_its_frequencies(loop: Loop, estimates: list[PlantEstimate]) -> None:
    hz = np.arange(1.0, 101.0)
    weak = (hz < 3.0) | ((hz > 40.0) & (hz < 45.0)) | (hz > 80.0)
    G, ones = np.ones(100, complex), np.ones(100)
    spread = np.where(weak, 2.0, 0.1)
    found = PlantEstimate(hz, G, spread, ones, 1, 1.0, weak, 1.0, 0.95 * (hz > 70.0), 0.5)
    rows = dict(findings(found, 0.002, OPTIONS))
    assert rows["missing"].startswith("1 to 3 Hz, 41 to 44 Hz, 80 to 250 Hz")
    assert "71 to 80 Hz" in rows["leakage"]
    assert "50 %" in rows["drift"]
    assert "95 % confidence" in rows["spread"]
    nothing = PlantEstimate(hz, G, 9.0 * ones, ones, 1, 1.0, ones > 0.0, 1.0, 0.0 * ones, 0.0)
    assert "every line" in dict(findings(nothing, 0.002, OPTIONS))["missing"]


@pytest.mark.parametrize("dead", ["excitation", "force", "position"])
def test_a_dead_signal_is_named(records: list[TimeSeries], dead: str) -> None:
    still = replace(records[0], **{dead: np.zeros(SAMPLES)})
    with pytest.raises(UserError, match=f"{dead} is constant"):
        estimate_plant(still)
