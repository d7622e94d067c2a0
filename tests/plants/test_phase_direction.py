"""The sign of im: true stable responses are read, and their conjugates are refused by name."""

import numpy as np
import pytest

import ccd_casadi as ccd
from ccd_casadi.extensions.measured.measured_loop import winding
from ccd_casadi.plants.measured import MeasuredResponse
from ccd_casadi.plants.response_table import least_phase
from ccd_casadi.support.errors import UserError


def stage(seed: int, light: bool) -> MeasuredResponse:
    """A held stage by its aliases: collocated or not, with zeros of any side, delay and noise."""
    rng = np.random.default_rng(seed)
    rate, top = (rng.choice([1000.0, 4000.0, 10000.0]), rng.uniform(0.3, 0.49))
    top = top * rate
    n = int(rng.integers(2, 13) if light else rng.integers(0, 4))
    w = ccd.HZ * np.exp(rng.uniform(np.log(20.0), np.log(0.8 * top), n))
    zeta = 10.0 ** rng.uniform(-2.7, -1.3, n) if light else rng.uniform(0.05, 0.7, n)
    kind, r = rng.integers(0, 4), rng.uniform(0.02, 1.0, n)
    signs = [np.ones(n), (-1.0) ** np.arange(n), *[rng.choice([-1.0, 1.0], n)] * 2][kind]
    first = np.array([0.0, rng.uniform(1.0, 60.0)])[rng.integers(0, 2)]
    delay = rng.uniform(0.0, 2.0) / rate
    hz = np.geomspace(rng.choice([0.5, 2.0]), top, rng.choice([250, 400, 900]))
    if rng.random() < 0.3:
        hz = np.arange(1.0, top, top / rng.choice([400, 900]))
    G = np.zeros(len(hz), complex)
    for k in range(-3, 4):
        x = 2j * np.pi * (hz + k * rate)
        P = 1.0 / (x * x + 0.8 * first * x + first**2)
        P = P + sum(a / (x * x + 2.0 * z * v * x + v * v)
                    for a, z, v in zip(r * signs, zeta, w, strict=True))  # fmt: skip
        if kind == 3:
            P = P * (1.0 - x / 500.0) / (1.0 + x / 500.0)
        G += P * np.exp(-x * delay) * (1.0 - np.exp(-x / rate)) / x * rate
    white = (rng.normal(size=(2, len(hz))) + 1j * rng.normal(size=(2, len(hz)))) * np.sqrt(0.5)
    G = G * (1.0 + rng.choice([0.0, 1e-3, 1e-2, 5e-2]) * white[0])
    floor = rng.choice([0.0, 0.0, 1e-4, 1e-3]) * np.median(np.abs(G))
    return MeasuredResponse(hz, G + floor * white[1])


def refusal(lines: MeasuredResponse) -> str:
    try:
        lines.require_causal()
    except UserError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(("light", "missed"), [(True, 2), (False, 8)])  # 0, 4
def test_a_conjugate_is_refused_and_no_true_response_is(light: bool, missed: int) -> None:
    found = 0
    for seed in range(100):
        true = stage(seed, light)
        turned = MeasuredResponse(true.hz, true.G.conj())
        assert not refusal(true), seed
        words = refusal(turned)
        assert not words or ("e^-jwt" in words and "or state unstable poles" in words)
        found += bool(words)
        if seed < 10:
            assert not refusal(MeasuredResponse(true.hz, turned.G, unstable_poles=40))
    assert found >= 100 - missed


def test_channels_and_re_for_im_are_refused_too() -> None:
    one, other = stage(1, True), stage(1, True)
    G = np.stack([[one.G, 0.2 * other.G], [-0.1 * one.G, other.G]]).transpose(2, 0, 1)
    assert not refusal(MeasuredResponse(one.hz, G))
    assert refusal(MeasuredResponse(one.hz, G.conj()))
    twice = MeasuredResponse(one.hz, np.stack([[one.G, one.G]] * 2).transpose(2, 0, 1))
    assert not refusal(twice)  # det G = 0
    assert twice.rise(one.hz[-1]).half_turns == 0.0
    assert refusal(MeasuredResponse(one.hz, 1j * one.G.conj()))  # re and im exchanged


@pytest.mark.parametrize("many", [5, 40])
def test_the_least_phase_is_that_of_a_minimum_phase_system(many: int) -> None:
    """Within lines that are as far apart as a pair of a zero and a pole, too."""
    hz = np.geomspace(0.01, 1e4, many * 100)
    s = 1j * hz
    G = (s * s + 0.3 * s + 100.0) / (s * s + 0.3 * s + 140.0) / (s + 1.0) ** 2
    at = np.log(np.geomspace(0.1, 1e3, 50))
    found = least_phase(np.log(np.abs(G)), np.log(hz), at)
    truth = np.interp(at, np.log(hz), np.unwrap(np.angle(G)))
    assert np.abs(found - truth).max() < 0.02


def test_lines_that_are_too_far_apart_are_not_unstable_poles() -> None:
    """A mode of damping 0.001 whose lines do not show which way the angle turns."""
    hz = np.geomspace(1.0, 900.0, 120)
    said = []
    for at in np.geomspace(100.0, 300.0, 40):
        x, w = 2j * np.pi * hz, ccd.HZ * at
        v = 1.1 * w
        G = (x * x + 0.004 * w * x + w * w) / (x * x + 0.004 * v * x + v * v) / x**2
        lines = MeasuredResponse(hz, G * np.exp(-2e-4 * x), poles_at_zero=2)
        L = 1e9 * lines.followed.matrix
        said += winding(lines, L)[1]
    assert not any("state its unstable poles" in words for words in said)
