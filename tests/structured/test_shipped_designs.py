"""Stored structured designs: no root of K with damping below 0.1 within 20 % of ω_b."""

import json
import tomllib
from typing import Any

import pytest
from oracles.shipped_designs import RESULTS, shipped

STORED = json.loads(RESULTS.read_text())


def light(sections: list[dict[str, Any]], hz: float) -> list[tuple[float, float]]:
    """Frequency in Hz and damping of the roots that the rule forbids, by the sections alone."""
    roots = [
        (section[f"{word}_hz"], section[f"{word}_damping"])
        for section in sections
        for word in ("zero", "pole")
        if section[f"{word}_damping"] is not None
    ]
    # a root on `least_damping = 0.1` is 0.1 to rounding
    return [(w, d) for w, d in roots if abs(w / hz - 1.0) <= 0.2 and d < 0.1 - 1e-9]


def test_the_rule_finds_a_filter_at_the_bandwidth() -> None:
    filter_at = {"zero_hz": 51.5, "zero_damping": 0.05, "pole_hz": 50.6, "pole_damping": 0.08}
    assert len(light([filter_at], 50.5)) == 2
    assert not light([filter_at], 20.0)


@pytest.mark.parametrize("name", sorted(STORED))
def test_no_light_root_lies_at_the_bandwidth(name: str) -> None:
    one = STORED[name]
    assert one["status"] == "verified"
    stated = one["sections"]
    sections = stated["sections"] or [s for c in stated["channels"] for s in c["sections"]]
    assert sections
    assert not light(sections, one["bandwidth_hz"])
    assert not one["light_roots"]
    assert not one["loop_warnings"]


def test_every_shipped_design_is_stored_as_its_case_is_today() -> None:
    cases = shipped()
    assert set(cases) == set(STORED)
    for name, (theta, _, text) in cases.items():
        case = tomllib.loads(text)
        kept = {key: STORED[name][key] for key in ("theta", "controller", "inner")}
        assert kept == {"theta": theta, "controller": case["controller"], "inner": case["inner"]}
