"""What pages say in words and shade in figures is what the numbers say."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccd_casadi import reporting
from ccd_casadi.analysis.move import Move
from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.tables import RobustTable
from ccd_casadi.codesign.outer_problem import FormulationRound
from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.codesign.verdict import OwnSet
from ccd_casadi.deployment.outcome import DeployedRun, against
from ccd_casadi.deployment.robust_set import MemberLoop
from ccd_casadi.fixed_structure.bounds import ShapeEnd
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.plants.modal import Perturbation
from ccd_casadi.reporting.concerns import LINES
from ccd_casadi.reporting.decision import advice, decide
from ccd_casadi.reporting.facts import (
    facts,
    margins_table,
    prediction_words,
    requirement_words,
    theta_table,
    theta_words,
)
from ccd_casadi.reporting.gain_figures import above
from ccd_casadi.reporting.insight_page import front_answer
from ccd_casadi.reporting.landscape import history_blocks
from ccd_casadi.reporting.moves import shown_until, way_words, ways_figure
from ccd_casadi.reporting.nyquist import drawable, nyquist_panel
from ccd_casadi.reporting.robustness_page import shown_peak
from ccd_casadi.reporting.run_verdict import head_of, run_head
from ccd_casadi.studies.compare_page import conclusions
from ccd_casadi.support.text import HZ


def test_the_bounds_drawn_of_sections_are_those_that_they_are_judged_by() -> None:
    problem = problem_of(load_case("runs/two_mass_built.toml"))
    hz = np.geomspace(0.1, 5000.0, 300)
    S, KS, T = kind_of(problem).gain_bounds(problem.weights, np.nan, 50.0).over(hz)
    assert isinstance(problem.controller, StructuredProblem)
    ended = replace(problem, controller=replace(problem.controller, shape_ends=ShapeEnd.CROSSING))
    short = kind_of(ended).gain_bounds(problem.weights, np.nan, 50.0).over(hz)[0]
    _, W_KS, W_T = np.abs(problem.weights.responses(HZ * hz))
    assert np.allclose(W_KS * KS, 8.426)
    assert np.allclose(W_T * T, 8.426)
    x, below = hz / 50.0, hz <= 50.0
    rising = np.where(below, x, 1.1 * x - 0.1 / x) / np.sqrt(2.0)
    assert (np.isfinite(S) == (rising <= problem.inner.S_max)).all()
    assert np.allclose(S[below], np.minimum(rising, 2.0**-0.5)[below])
    assert np.allclose(S[~below & np.isfinite(S)], rising[~below & np.isfinite(S)])
    assert np.allclose(short[below], np.minimum(1.1 * x, 1.0)[below] / np.sqrt(2.0))
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


def test_what_varies_is_shown_as_a_range_and_not_as_a_value() -> None:
    result = {"theta": {"h": 0.12}, "fixed": {"wall": 4.5e-3}, "varies": {"at": [-0.3, 0.3]},
              "units": {"h": "m", "wall": "m", "at": "m"}}  # fmt: skip
    assert theta_words(result) == "h = 120 mm, wall = 4.5 mm, every at from -300 to 300 mm"
    problem = problem_of(load_case("examples/gantry_stroke/case.toml"))
    assert theta_table(problem, result).rows[-1] == ("at", "mm", "–", -300.0, 300.0, "–", "varies")


def test_rounds_are_shown_in_the_units_of_the_page() -> None:
    problem = problem_of(load_case("runs/rib_stage.toml"))
    theta = problem.start
    item = FormulationRound(theta, HZ * 60.0, HZ * 55.0, -2.0, -1.9, 0.05, 0.1, 0.1)
    result = {"surrogate_bandwidth_hz": 60.0, "bandwidth_hz": 60.0 * (1.0 - 1e-9), "objective": -2}
    words, table = history_blocks([item], problem, result, theta, 1e-3, lifted=False)
    assert table.head[1] == "h (mm)"
    assert table.rows[0][1] == 1e3 * theta[0]
    assert (table.rows[0][-1], table.rows[1][-1]) == ("5 %", "under 0.0001 %")
    assert (
        "goes from 5 % to under 0.0001 %, in no round within the tolerance of 0.1 %" in words.text
    )


def test_what_is_named_in_a_nyquist_plot_stands_beside_it_and_not_in_a_legend_over_it() -> None:
    panel = nyquist_panel(np.geomspace(1.0, 10.0, 5), [np.full(5, 0.1 + 0j)], 1.9)
    assert not any(curve.label for curve in panel.curves)
    disk, circle = (mark for mark in panel.marks if mark.text in ("S_max 1.9", "|L| = 1"))
    assert abs(1.0 + complex(disk.x, disk.y)) == pytest.approx(1.0 / 1.9)
    assert abs(complex(circle.x, circle.y)) == pytest.approx(1.0)


def test_a_kept_set_with_an_unstable_controller_is_a_question_and_no_refusal() -> None:
    """What the case has is not what comes next; where small errors matter it is a wider set."""
    kept = result_of(survives="warned")
    kept["verdict"]["survives"] |= {
        "set": "kept", "stable_shift": [-0.05, 0.5], "least_shift": 0.02,
        "stable_damping": [0.1, 10.0], "unstable_controller_poles_hz": [74.3],
    }  # fmt: skip
    words = advice(kept)
    assert words.startswith("Build this only if you accept: the controller is unstable by itself")
    assert "74.3 Hz" in words
    kept["verdict"]["survives"]["stable_shift"] = [-0.01, 0.5]
    words = advice(kept)
    assert words.startswith("Do not build this: it does not survive small errors")
    assert words.endswith("a wider resonance_shift or damping in [robust].")


def test_a_search_that_its_budget_ended_is_named_in_the_decision() -> None:
    ended = result_of(optimal="unknown") | {"time_budget": {"minutes": 5.0, "ended": True}}
    assert "accept: the search was ended by its budget of 5 min" in advice(ended)  # an older run
    ended["time_budget"]["share"] = 0.6
    words = advice(ended)
    assert words.startswith(
        "Build this only if you accept: the search was ended by its budget of 5 min (60 % of it are"
    )
    assert "a larger --budget" in words
    within = ended | {"time_budget": {"minutes": 5.0, "ended": False}}
    assert "budget" not in advice(within)


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
    alone["verdict"]["survives"]["set"] = OwnSet.NONE
    assert advice(alone).startswith("Do not build this yet: it was judged on the model alone.")
    unknown = result_of(survives="unknown")  # what could not be checked has not passed
    assert advice(unknown).startswith("Do not build this yet: what it survives is not known.")
    unknown["verdict"]["survives"]["set"] = OwnSet.SEARCHED
    assert "the [robust] set is searched, not proven" in advice(unknown)
    head = run_head("", unknown, "", "")
    assert head.badge == "warn"
    assert "all checks passed" not in head.reason.lower()


@given(st.floats(1e-8, 1e-3), st.floats(0.0, 1e-3), st.booleans())
def test_a_move_does_not_settle_only_where_its_error_stays(
    window: float, rest: float, known: bool
) -> None:
    """What decays and was not watched for long enough has not settled within that time."""
    time = np.linspace(0.0, 0.5, 200)
    error = 2.0 * window + max(rest, 2.0 * window) * np.exp(-time)
    made = Move(time, time, error, time[:, None], False, 0.2, window,
                rest=rest if known else np.nan)  # fmt: skip
    words = way_words("feedback alone", [made])
    assert ("does not settle" in words) == (known and rest > window)
    assert ("has not settled within 500 ms" in words) == (not known or rest <= window)
    assert " left)" in words


@pytest.mark.parametrize(
    ("figures", "said"),
    [
        ({"modulus_margin": 0.4999, "phase_margin_deg": 29.9, "gain_margin": 1.999}, ""),
        ({"modulus_margin": 0.4}, "the modulus margin is 0.4"),
        ({"phase_margin_deg": 25.0, "gain_margin": None}, "the phase margin is 25 deg"),
        ({"step_overshoot": 0.62, "settling_ms": 14.0}, "a step overshoots by 62 %"),
        ({"step_overshoot": 0.62, "settling_ms": 14.0, "move": {}}, ""),
        ({"step_overshoot": 0.1, "settling_ms": None}, "a step does not settle"),
        (
            {"step_overshoot": 0.1, "settling_ms": 4e3, "bandwidth_hz": 50.0},
            "a step settles only after 4 s",
        ),
        ({"step_overshoot": 0.1, "settling_ms": 3e3, "bandwidth_hz": 50.0}, ""),
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
        assert f"accept: {said}" in both
        assert "; predicted warned" in both
        assert "Deploy it first" in both
        assert said not in advice(result_of(survives="failed") | figures)


def test_margins_of_the_model_are_beside_those_of_the_worst_plant() -> None:
    """Of the loop as it was solved; of the model alone there is nothing beside."""
    worst = {"phase_margin_deg": 40.0, "gain_margin": 2.0, "delay_margin_us": 300.0,
             "modulus_margin": 0.5}  # fmt: skip
    result = result_of() | worst
    own = {"phase_margin_deg": 45.0, "gain_margin": [0.25, 3.0], "modulus_margin": 0.6}
    result["verdict"]["survives"] |= {"phase_margin_deg": 1.0, "at_solve": own}  # by `robustness`
    result["verdict"]["deployable"]["delay_margin"] = 400e-6
    (table,) = margins_table(result, 5)
    found = {row[0].partition(",")[0]: row[1:] for row in table.rows}
    assert found["phase"] == ("45°", "40°")
    assert found["gain"] == ("3", "2")
    assert found["delay"] == ("400 µs", "300 µs")
    assert found["modulus"] == ("0.6", "0.5")
    own["gain_margin"] = [0.5, None]  # less gain may be what makes it unstable
    assert ("gain, × or ÷", "2", "2") in margins_table(result, 5)[0].rows
    assert margins_table(result, 1) == ()
    assert margins_table(result_of(), 5) == ()


def test_an_open_proof_hides_no_limit_that_the_loop_exceeds() -> None:
    """Nor a line that warned; and the decision of the page is the one of the terminal."""
    rings = "the closed loop rings at 159.8 Hz with damping 0.00103"
    poor = {"step_overshoot": 0.71, "settling_ms": 40.0, "gain_margin": 1.786,
            "phase_margin_deg": 28.2, "loop_warnings": [rings]}  # fmt: skip
    result = result_of(survives="warned", predicted="warned", deployable="unknown")
    result["verdict"]["survives"]["set"] = OwnSet.UNPROVEN
    bare, said = advice(result), advice(result | poor)
    for words in ("not proven on the whole [robust] set", "predicted warned", "Deploy it first",
                  "Next: a smaller [robust] set"):  # fmt: skip
        assert words in bare
        assert words in said
    concerns = ("overshoots by 71 %", "gain margin is 1.79", "phase margin is 28.2 deg", rings,
                "smaller S_max")  # fmt: skip
    for words in concerns:
        assert words in said
        assert words not in bare
    assert said.startswith("Build this only if you accept: the bounds are not proven")
    head = run_head("", result | poor, "", "")
    assert (head.decision, head.also) == (decide(result | poor).words, decide(result | poor).also)


@pytest.mark.parametrize(
    ("levels", "said", "remedy"),
    [
        ({"S_MAX": 0.999, "GS": 1.0021}, "compliance_max is proven only up to 0.21 % above",
         "state compliance_max 0.21 % tighter"),
        ({"T of tilt": 1.012001, "GS": 1.0021},
         "weighted_level of T of channel tilt, compliance_max are proven only up to 1.201 % above",
         "weighted_level of T of channel tilt, compliance_max 1.201 % tighter"),
        ({"CROSSING": 1.004}, "|S| at omega_b is proven only up to 0.4 % above", "accept these"),
        ({"GS": 1.2}, "the bounds are not proven", "fewer parameters"),
        ({"GS": None, "T": 1.01}, "the bounds are not proven", "fewer parameters"),
    ],
)  # fmt: skip
def test_a_proof_that_is_open_by_a_little_says_by_how_much(
    levels: dict, said: str, remedy: str
) -> None:
    result = result_of(survives="warned")
    result["verdict"]["survives"] |= {
        "set": OwnSet.UNPROVEN, "proof": "looser", "proven": levels, "plants": 207,
    }  # fmt: skip
    words = advice(result)
    assert said in words
    assert remedy in words.partition("Next: ")[2]
    assert ("tighter" in words) == (remedy.endswith("tighter"))
    result["verdict"]["survives"]["proof"] = "open"  # stability itself is open
    assert "tighter" not in advice(result)
    assert "fewer parameters" in advice(result)


def test_a_decision_says_what_a_line_warns_of() -> None:
    """Not what else is good of it."""
    result = result_of(certified="warned", predicted="warned")
    grid = [{"reason": "judged_on_plants", "plants": 5}, {"reason": "on_grid_alone"}]
    result["verdict"]["certified"] |= {"findings": grid, "on_grid_alone": ["compliance_max"]}
    missed = {"findings": [{"reason": "mispredicted"}], "error": 0.02, "tolerance": 0.001}
    result["verdict"]["predicted"] |= missed
    assert advice(result) == (
        "Build this only if you accept: compliance_max: judged on a grid of frequencies alone; "
        "prediction and truth differ by 2 %, more than 0.1 %. "
        "Next: retrain, or more points in [sampling]."
    )


@pytest.mark.parametrize(
    ("name", "found", "said"),
    [
        ("deployable", [Reason.PEAK_ABOVE(over=2.0, S_max=2.0, excess=0.05, plant=""),
                        Reason.BETWEEN(between_peak=2.0)],
         "hold and delay bring the peak of S 2.00 % above S_max = 2; a deployment may exceed it "
         "by 5 %"),
        ("deployable", [Reason.WEIGHTED_ABOVE(name="KS", level=1.1)],
         "|W_KS KS| of the code is 1.1 times weighted_level"),
        ("deployable", [Reason.JUDGED(words="S between its samples is not judged")],
         "S between its samples is not judged"),
        ("optimal", [Reason.NO_GRADIENT(controller_residual=0.1), Reason.GAP_UNKNOWN()],
         "no gradient over theta, since the search over the controller ended 1.0e-01 from its "
         "optimum: a limit of the program"),
        ("optimal", [Reason.BUDGET(minutes=1.0, not_searched={"start": 1}), Reason.LARGER_BUDGET(),
                     Reason.NOT_STATIONARY(kkt_residual=0.5, kkt_level=0.1)],
         "not optimal: KKT residual 0.5 over theta, above 0.1"),
        ("optimal", [Reason.OPTIMAL_AT_KINK(slopes=[[0.2, None]], least_slope=0.2)],
         "locally optimal to first order at a kink: J rises on the 1 known sides of 2"),
    ],
)  # fmt: skip
def test_every_line_that_warns_has_its_reason_in_the_decision(
    name: str, found: list[Finding], said: str
) -> None:
    result = result_of(**{name: "warned"})
    result["verdict"][name]["findings"] = [one.entry for one in found]
    assert advice(result).startswith(f"Build this only if you accept: {said}.")


def test_what_s_may_reach_between_two_lines_is_said_first() -> None:
    tuned = {"sensitivity_peak": 1.8, "sensitivity_peak_between_lines": 4.78}
    assert "4.78 between two lines" in advice(tuned)
    assert advice(tuned | {"status": "not_verified"}).startswith("Do not run this")
    assert head_of("", True, "verified", "", "", "", tuned).badge == "warn"
    assert not advice(tuned | {"sensitivity_peak_between_lines": 1.85})


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
    move = Move(time, rest, error, rest[:, None], False, 0.18, window=1e-6)
    assert shown_until(move) == pytest.approx(0.54)
    drawn = ways_figure({"one": [move]}, "")
    assert "57.7 µm left where the figure ends" in drawn.caption
    assert [row[0].curves[0].label for row in drawn.drawing.rows] == ["one", "one"]  # read out
    soon = replace(move, error=1e-6 * np.exp(-time))
    assert "after the figure's end" not in ways_figure({"one": [soon]}, "").caption


def test_insight_and_compare_begin_with_their_answer() -> None:
    problem = SimpleNamespace(cost_unit="kg", figure=BANDWIDTH)

    def point(cost: float, hz: float) -> SimpleNamespace:
        return SimpleNamespace(hardware_cost=cost, value=HZ * hz, verified=True)

    one = SimpleNamespace(points=(point(110.0, 72.0),))
    assert front_answer(problem, one).startswith("There is nothing to trade")
    two = SimpleNamespace(points=(point(100.0, 50.0), point(110.0, 70.0)))
    assert front_answer(problem, two) == (
        "Bandwidth costs hardware: from 100 kg with 50 Hz to 110 kg with 70 Hz, 2 Hz for every kg "
        "between them."
    )
    three = SimpleNamespace(points=(*two.points, point(120.0, 71.0)))
    assert front_answer(problem, three, 109.0).endswith(
        "at 2 Hz for every kg where it is lightest, 0.1 where it is heaviest, 0.1 at this design."
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
    weak = best | {"status": "verified"} | {"verdict": result_of(survives="warned")["verdict"]}
    said = conclusions(problem, {"lifted": weak, "sequential": other})["sentences"]
    assert said[0].startswith("Do not build this: it does not survive small errors of its model.")
    assert "-20.0 % and the bandwidth by +20.0 %" in said[0]


def test_a_deployment_says_bandwidth_and_peak_of_one_plant_together() -> None:
    """The model's pair, and that of the plant with the largest peak."""
    model = SimpleNamespace(bandwidth=48.2 * HZ, sensitivity_peak=1.64, stable=True)
    other = SimpleNamespace(bandwidth=48.4 * HZ, sensitivity_peak=1.72, stable=True)
    worst = MemberLoop(Perturbation(0.03), other)
    found = SimpleNamespace(
        sampled=model, worst=worst, members=(worst,), rate_hz=1e4, delay=1e-4, needed_hz=1e4,
        realisation=SimpleNamespace(system=SimpleNamespace(A=np.zeros((4, 4)))), stable=True,
        shortfalls=(), weighted_above=(), unverified="", judge=None, rounding=None, between=None,
        target=SimpleNamespace(excess=0.05),
    )  # fmt: skip
    run = SimpleNamespace(problem=SimpleNamespace(inner=SimpleNamespace(S_max=1.75)),
                          case=SimpleNamespace(robust=RobustTable()))  # fmt: skip
    words = f"{'; '.join(DeployedRun(run, found).check().clauses)};"
    assert "on the model bandwidth 48.2 Hz, peak of S 1.64;" in words
    assert "(resonances +3 %) bandwidth 48.4 Hz, peak of S 1.72" in words


def test_what_a_nyquist_plot_leaves_out_has_no_half_of_a_point() -> None:
    found = drawable(np.array([1.0 + 2.0j, 1e4 - 3.0j, -0.5j, np.inf]))
    np.testing.assert_array_equal(np.isnan(found.real), np.isnan(found.imag))
    np.testing.assert_array_equal(np.isnan(found.real), [False, True, False, True])


def test_arrows_of_a_nyquist_plot_point_to_higher_frequencies() -> None:
    """Each frequency stands where L has it, its arrow along L."""

    def L(hz: np.ndarray | float) -> np.ndarray:
        s = 1j * HZ * np.asarray(hz)
        return np.asarray(9.0 / (s * (s + 1.0) * (s * s / 9.0 + 0.02 * s + 1.0)) / 3.0)

    hz = np.geomspace(0.01, 10.0, 20000)
    panel = nyquist_panel(hz, [L(hz)], 2.0)
    marks = [mark for mark in panel.marks if mark.text.endswith(" Hz")]
    heads = [curve for curve in panel.curves if len(curve.x) == 3]
    assert len(marks) == len(heads) > 3
    for mark, head in zip(marks, heads, strict=True):
        at, place = float(mark.text.removesuffix(" Hz")), complex(mark.x, mark.y)
        assert abs(L(at) - place) < 0.05  # three digits of the frequency
        assert complex(head.x[1], head.y[1]) == place
        ends = head.x[::2] + 1j * head.y[::2]
        way = L(at * 1.001) - L(at / 1.001)
        assert ((place - ends) * np.conj(way)).real.min() > 0.9 * abs(way) * abs(place - ends).max()


def test_a_table_of_facts_says_what_it_lacks_and_keeps_a_strangers_names() -> None:
    """A run of before may know less: its page leaves the chapter out for a KeyError."""
    assert facts("margins", {}) == []
    with pytest.raises(KeyError, match="crossover_hz"):
        facts("margins", {"phase_margin_deg": 41.0, "gain_margin": None, "delay_margin_us": 6.0,
                          "modulus_margin": 0.5})  # fmt: skip
    ideal = {"S_max": 1.7, "S_low": 0.03, "omega_low": HZ, "compliance_max": None}
    problem = SimpleNamespace(
        figure=BANDWIDTH, w1=1.0, w2=-1.0, inner=SimpleNamespace(**ideal), robust=None
    )
    rows = facts("problem", problem, "of | fixed <b>structure</b>", "")
    assert ("Controller", "of | fixed <b>structure</b>", "") in rows
    assert all(len(row) == 3 for row in rows)


def test_every_part_of_the_words_is_said_somewhere() -> None:
    package = Path(reporting.__file__).parents[1]
    code = "".join(path.read_text() for path in package.rglob("*.py"))
    for name in ("facts", "report", "insight", "robustness", "deployment"):
        words = (package / "templates" / f"{name}.txt").read_text()
        for macro in re.findall(r"{% macro (\w+)\(", words):
            inside = len(re.findall(rf"\b{macro}\(", words)) > 1
            said = rf'"{name}\.{macro}"|\b(facts|_words)\([^)]*"{macro}"'
            assert inside or re.search(said, code), f"{name}.{macro}"


def test_what_was_not_predicted_is_not_shown_as_predicted() -> None:
    """A search on true values, as one that its budget ended, has no prediction to report."""
    result = result_of()
    assert prediction_words(result, "72 Hz").startswith("predicted 72 Hz")
    assert prediction_words(result_of(predicted="unknown"), "72 Hz") == ""
    assert prediction_words(result | {"formulation": "direct"}, "72 Hz") == ""


def test_a_limit_of_the_motor_is_shown_as_its_share() -> None:
    one = {"name": "peak force", "required": 0.0, "achieved": -0.3}
    assert requirement_words(one) == ("at most 100 % of the motor's", "70 %")
