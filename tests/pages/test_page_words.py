"""What pages say in words and shade in figures is what the numbers say."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ccd_casadi.analysis.move import Move
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.deployment.words import against
from ccd_casadi.fixed_structure import ShapeEnd
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.sections_problem import SectionsProblem
from ccd_casadi.reporting.facts import conclusion
from ccd_casadi.reporting.insight import front_answer
from ccd_casadi.reporting.loops import above
from ccd_casadi.reporting.moves import shown_until, ways_figure
from ccd_casadi.reporting.robustness_figures import shown_peak
from ccd_casadi.reporting.verdict import LINES, advice, run_head
from ccd_casadi.studies.conclusions import conclusions
from ccd_casadi.support.units import HZ


def test_the_bounds_drawn_of_sections_are_those_that_they_are_judged_by() -> None:
    problem = problem_of(load_case("runs/two_mass_built.toml"))
    hz = np.geomspace(0.1, 5000.0, 300)
    S, KS, T = kind_of(problem).bounded(problem.weights, np.nan, 50.0).over(hz)
    assert isinstance(problem.controller, SectionsProblem)
    ended = replace(problem, controller=replace(problem.controller, shape_ends=ShapeEnd.CROSSING))
    short = kind_of(ended).bounded(problem.weights, np.nan, 50.0).over(hz)[0]
    _, W_KS, W_T = np.abs(problem.weights.responses(HZ * hz))
    assert np.allclose(W_KS * KS, 8.426)
    assert np.allclose(W_T * T, 8.426)
    rising, below = 1.1 * hz / 50.0 / np.sqrt(2.0), hz <= 50.0
    assert (np.isfinite(S) == (rising <= problem.inner.S_max)).all()
    assert np.allclose(S[below], np.minimum(rising, 2.0**-0.5)[below])
    assert np.allclose(S[~below & np.isfinite(S)], rising[~below & np.isfinite(S)])
    assert np.array_equal(short[below], S[below])
    assert np.isnan(short[~below]).all()
    (area,) = above(hz, KS, 1e12)
    assert len(area.x) == len(area.y) == len(hz) + 2
    assert above(hz, np.full_like(hz, np.nan), 1.0) == ()


def result_of(**states: str) -> dict:
    verdict = {n: {"state": states.get(n, "passed"), "words": n} for n in LINES}
    return {
        "verdict": verdict, "status": "verified", "formulation": "nested", "theta": {"m": 1.0},
        "bandwidth_hz": 72.0, "hardware_cost": 1.0, "objective": -1.0, "syntheses": 3,
        "seconds": 1.0, "verification_error": 6.3e-12,
        "certificate": {"passed": True, "norm_bound": 2.0},
    }  # fmt: skip


def test_a_prediction_of_a_sample_by_itself_is_no_figure() -> None:
    result = result_of()
    assert "predicted to 6.3e-12 of the truth" in conclusion(result)
    result["verdict"]["predicted"] |= {"left_out": 0.022}
    assert "6.3e-12" not in conclusion(result)
    assert "misses it by 2.2 %" in conclusion(result)


@pytest.mark.parametrize(
    ("states", "said"),
    [
        ({}, "Build this."),
        ({"deployable": "unknown"}, "Build this after deploy"),
        ({"survives": "warned"}, "Do not build this: it does not survive"),
        ({"predicted": "warned"}, "Build this only if you accept: predicted warned."),
        ({"survives": "warned", "deployable": "failed"}, "Do not build this: deployable failed."),
    ],
)
def test_a_page_says_first_whether_to_build_it(states: dict, said: str) -> None:
    assert advice(result_of(**states)).startswith(said)
    assert advice({"status": "verified"}) == ""
    alone = result_of(survives="warned")  # nothing was found against it
    alone["verdict"]["survives"]["words"] = "[robust] names no plant but the model; stable for"
    assert advice(alone).startswith("Do not build this yet: it was judged on the model alone.")


@pytest.mark.parametrize(
    ("figures", "said"),
    [
        ({"modulus_margin": 0.4999, "phase_margin_deg": 29.9, "gain_margin": 1.999}, ""),
        ({"modulus_margin": 0.4}, "the modulus margin is 0.4"),
        ({"phase_margin_deg": 25.0, "gain_margin": None}, "the phase margin is 25 deg"),
        ({"step_overshoot": 0.62, "settling_ms": 14.0}, "a step overshoots by 62 %"),
        ({"step_overshoot": 0.62, "settling_ms": 14.0, "move": {}}, ""),
        ({"step_overshoot": 0.1, "settling_ms": None}, "a step does not settle"),
        ({"loop_warnings": ["the closed loop rings"]}, "the closed loop rings"),
    ],
)
def test_a_loop_within_its_bounds_is_looked_at_as_an_engineer_would(
    figures: dict, said: str
) -> None:
    good = advice(result_of() | figures)
    assert good.startswith(f"Build this only if you accept: {said}" if said else "Build this.")
    assert run_head("", result_of() | figures, "", "").badge == ("warn" if said else "good")
    alone = advice(figures | {"status": "verified"})  # of `tune`, which has no lines
    assert alone.startswith(f"Look at the loop before you run it: {said}" if said else "")
    assert bool(alone) == bool(said)
    if said:
        both = advice(result_of(predicted="warned", deployable="unknown") | figures)
        assert f"predicted warned; {said}" in both
        assert "Deploy it first" in both
        assert said not in advice(result_of(survives="failed") | figures)


def test_a_peak_is_above_or_below_what_it_is_held_against() -> None:
    assert against(1.804, 1.75) == "3.09 % above S_max"
    assert against(1.6189, 1.75) == "7.49 % below S_max"
    assert against(1.75, 1.75) == "S_max"


def test_an_axis_and_a_figure_that_end_early_say_so() -> None:
    run = SimpleNamespace(problem=SimpleNamespace(inner=SimpleNamespace(S_max=1.75)))
    judged = [SimpleNamespace(stable=True, peak=p) for p in (1.8, 40.0)]
    found = SimpleNamespace(tolerances=SimpleNamespace(judged=judged))
    assert shown_peak(run, found) == 3.0 * 1.75
    time = np.linspace(0.0, 8.0, 801)
    rest, error = np.zeros(801), 1e-4 * np.exp(-time)
    move = Move(time, rest, rest, error, rest[:, None], False, 0.18, window=1e-6)
    assert shown_until(move) == pytest.approx(0.54)
    assert "of 57.7 µm after the figure's end" in ways_figure({"one": move}, "").caption
    soon = replace(move, error=1e-6 * np.exp(-time))
    assert "after the figure's end" not in ways_figure({"one": soon}, "").caption


def test_insight_and_compare_begin_with_their_answer() -> None:
    problem = SimpleNamespace(cost_unit="kg")

    def point(cost: float, hz: float, efficient: bool = True) -> SimpleNamespace:
        return SimpleNamespace(
            hardware_cost=cost, bandwidth=HZ * hz, efficient=efficient, verified=True
        )

    one = SimpleNamespace(points=(point(110.0, 72.0), point(120.0, 60.0, efficient=False)))
    assert front_answer(problem, one).startswith("There is nothing to trade")
    two = SimpleNamespace(points=(point(100.0, 50.0), point(110.0, 70.0)))
    assert front_answer(problem, two) == (
        "Bandwidth costs hardware: from 100 kg with 50 Hz to 110 kg with 70 Hz, on average 2 Hz "
        "for every kg."
    )
    best = {
        "syntheses_to_optimum": 5,
        "syntheses": 5,
        "objective": -2.0,
        "hardware_cost": 80.0,
        "bandwidth_hz": 60.0,
    }
    other = {
        "syntheses_to_optimum": 5,
        "syntheses": 5,
        "objective": -1.0,
        "hardware_cost": 100.0,
        "bandwidth_hz": 50.0,
    }
    said = conclusions(problem, {"lifted": best, "sequential": other})["sentences"]
    assert said[0].endswith("changes the hardware cost by -20.0 % and the bandwidth by +20.0 %.")
    assert conclusions(problem, {"lifted": best})["sentences"][0].startswith("The best J")
