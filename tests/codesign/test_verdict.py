"""The verdict: states follow their figures; what is not optimal is never verified; kinks count."""

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.chain_plants import chain_problem
from oracles.helpers import HZ, problem

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.codesign import FORMULATIONS
from ccd_casadi.codesign import verdict as v
from ccd_casadi.codesign.final_judgement import judge_survival
from ccd_casadi.codesign.formulations import formulation_of
from ccd_casadi.codesign.kinked import PeakDescentOptions, descend
from ccd_casadi.codesign.optimality import LiftedKktOptions, TrueDesign
from ccd_casadi.codesign.outer_mixed import VerifiedDesign
from ccd_casadi.codesign.outer_problem import GlobalCheck, lifted_bounds
from ccd_casadi.codesign.reasons import Reason, within_words
from ccd_casadi.codesign.run import solve
from ccd_casadi.codesign.structured_entries import robust_dict
from ccd_casadi.codesign.survival import Survival, SurvivalOptions, loops_of
from ccd_casadi.drawing.content import Verdict
from ccd_casadi.drawing.paint import block_html
from ccd_casadi.fixed_structure.certificate import SetCertificate
from ccd_casadi.fixed_structure.worst_plant import Excess
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH, RobustSet
from ccd_casadi.inner_problem.objective import TrueQuantities
from ccd_casadi.inner_problem.problem import scaled_plant, true_design, true_inner
from ccd_casadi.inner_problem.structured_robustness import BoxCheckOptions
from ccd_casadi.optim.kkt import KktCertificate
from ccd_casadi.plants.modal import Perturbation, modal_plant
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import scale_plant
from ccd_casadi.reporting import concerns, decision
from ccd_casadi.reporting import run_verdict as shown
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.derivatives import local_peaks_with_gradients
from ccd_casadi.synthesis.statics import Statics
from ccd_casadi.synthesis.synthesis import synthesise

ROOT = Path(__file__).parents[2]
KKT_LEVEL = VerifiedDesign.kkt_level
BETTER = Reason.WEIGHTS_BETTER()
CORNER = (55.0, 55.0)
WEIGHTS = (1800.0 * HZ, 26.066 * HZ)  # of the verified design of case study 1
SOUND = Survival(
    stable_shift=(-0.2, 0.2),
    S_max_shift=(-0.05, 0.05),
    stable_damping=(0.1, 10.0),
    gain=(0.3, 3.0),
    phase_deg=45.0,
    delay=1e-3,
    modulus=0.6,
    unstable_poles_hz=(),
    statics=Statics(1e6, 1e-6, 0.5, 2e-6, 1.0),
)


def optimal_line(
    residual: float, gap: float = 0.0, global_check: GlobalCheck | None = None
) -> v.Check:
    kkt = KktCertificate(residual, 0.0, 0.0, {}, (), None, ())
    known = v.search_evidence(16, 2, global_check)
    return v.optimal(kkt, level=KKT_LEVEL, gap=gap, tolerance=1e-3, better=BETTER, searched=known)


@given(st.floats(0.0, 10.0))
def test_what_is_not_stationary_is_not_optimal(residual: float) -> None:
    line = optimal_line(residual)
    assert (line.state is v.State.FAILED) == (residual > KKT_LEVEL)
    assert ("not optimal" in line.words) == (line.state is v.State.FAILED)
    assert "gap not known" in "; ".join(line.clauses)


@pytest.mark.parametrize("residual", [0.3, 6e-2, math.nan])
def test_a_residual_that_bug_five_had_is_never_verified(residual: float) -> None:
    assert optimal_line(residual).state is v.State.FAILED


def test_a_better_inner_design_fails_the_line() -> None:
    assert optimal_line(1e-9, gap=0.01).state is v.State.FAILED
    assert optimal_line(1e-9, gap=1e-6).state is v.State.PASSED


def test_the_look_at_the_box_is_said() -> None:
    global_check = GlobalCheck(32, 20, 12, 3, 4, 0, -290.0, -350.0, np.zeros(4))
    clauses = optimal_line(1e-9, global_check=global_check).clauses
    assert any("-290" in words for words in clauses)
    assert "checked at 20 other theta of the box and 12 of the run" in clauses
    none = optimal_line(1e-9, global_check=replace(global_check, x=None))
    assert "none better at 20 other" in none.words


@given(st.floats(1e-2, 1e4), st.floats(1e-3, 0.5))
def test_the_ends_of_a_search_are_reported_apart(first: float, share: float) -> None:
    """Of a slow loop too, to four digits at least."""
    ends = [first, first * (1.0 - share)]
    words = Reason.MULTISTART(local_optima_hz=ends).words()
    shown = [float(value) for value in re.findall(r"[\d.]+", words)]
    assert shown == pytest.approx(ends, rel=5.1e-4)
    assert shown[0] != shown[1]
    three = Reason.MULTISTART(local_optima_hz=[0.24021, 0.23911, 0.23518])
    assert "ended at 0.2402, 0.2391, 0.2352 Hz" in three.words()


REACH = SurvivalOptions().reach


@given(low=st.floats(-REACH, 0.0), high=st.floats(0.0, REACH))
def test_a_narrow_range_of_resonances_is_warned(low: float, high: float) -> None:
    line = v.survives(replace(SOUND, stable_shift=(low, high)), S_max=2.0)
    narrow = low > -v.VerdictOptions().least_shift or high < v.VerdictOptions().least_shift
    assert line.state is (v.State.WARNED if narrow else v.State.PASSED)
    assert line.figures["stable_shift"] == [low, high]


@given(low=st.floats(-REACH, 0.0), high=st.floats(0.0, REACH), slack=st.floats(4e-6, 1e-2))
def test_a_range_that_is_shown_lies_in_the_range(low: float, high: float, slack: float) -> None:
    """An end is never rounded outwards, and a tolerance of S_max is stated."""
    found = replace(SOUND, stable_shift=(low, high), S_max_shift=(low, high))
    words = "; ".join(v.survives(found, S_max=2.0).clauses)
    shown = re.search(r"within S_max >?(\S+) to >?(\S+) %", words)
    assert shown is not None
    for end, true in zip(map(float, shown.groups()), (low, high), strict=True):
        assert abs(end) <= 100.0 * abs(true) * (1.0 + 1e-8)
        assert abs(end) >= 90.0 * abs(true) - 1e-3
    loose = v.survives(replace(found, S_max_slack=slack), S_max=2.0)
    assert f"within {1.0 + slack:.6g} S_max" in "; ".join(loose.clauses)
    assert loose.figures["S_max_shift_slack"] == slack


def test_an_unstable_controller_a_narrow_damping_and_a_high_closer_peak_are_warned() -> None:
    for item in (
        v.survives(replace(SOUND, unstable_poles_hz=(143.0,)), S_max=2.0),
        v.survives(replace(SOUND, stable_damping=(0.7, 10.0)), S_max=2.0),
        v.survives(SOUND, S_max=2.0, closer=[("20 modes", True, 2.3)]),
    ):
        assert item.state is v.State.WARNED
    calm = v.survives(SOUND, S_max=2.0, closer=[("20 modes", True, 2.1)])
    assert calm.state is v.State.PASSED


def test_its_own_set_or_an_unstable_closer_model_fails() -> None:
    assert v.survives(SOUND, S_max=2.0, own=v.OwnSet.BROKEN).state is v.State.FAILED
    assert v.survives(SOUND, S_max=2.0, own=v.OwnSet.KEPT).state is v.State.PASSED
    lost = v.survives(SOUND, S_max=2.0, closer=[("20 modes", False, math.inf)])
    assert lost.state is v.State.FAILED
    assert "20 modes" in lost.words


@given(st.floats(-1e-4, 1e-4))
def test_within_every_bound_is_said_of_what_is_shown_so(value: float) -> None:
    """Of the judge's words too, which allow more."""
    worst = Excess(0, np.zeros(1), value)
    shown = f"{100.0 + 100.0 * math.expm1(value):.6g}"
    wide = SetCertificate(True, 1.0, (), {}, "as the judge allows")
    own = within_words(math.expm1(value), BoxCheckOptions.looseness)
    for words in (own, robust_dict(wide, 9, worst)["words"]):
        assert ("within every bound" in words) == (float(shown) <= 100.0)
        assert ("exceeded by more than 0.02 %" in words) == (float(shown) > 100.0)


def test_a_differentiator_is_said_to_be_one() -> None:
    soft = replace(SOUND, statics=replace(SOUND.statics, share=1e-3, compliance=4e-5))
    words = "; ".join(v.survives(soft, S_max=2.0).clauses)
    assert "differentiator" in words
    assert "40 µm" in words
    assert "differentiator" not in "; ".join(v.survives(SOUND, S_max=2.0).clauses)


def predicted(
    error: float, value: float = math.nan, left_out: tuple[float, float] | None = None
) -> v.Check:
    """Of a bandwidth, by a surrogate."""
    quality: Any = SimpleNamespace(at_point=left_out, extrapolates=())
    return v.judge_prediction(error, 1e-3, value, BANDWIDTH, quality)


def test_a_prediction_at_its_own_sample_counts_without_it() -> None:
    """D6: 6e-12 at a training sample that the others miss by 2 % is no support."""
    hollow = predicted(6e-12, HZ * 1.56 / 0.022, (1.56, 3.5))
    assert hollow.state is v.State.WARNED
    assert "1.6 Hz" in hollow.words
    assert "3.5 times the error it expects" in hollow.words
    far = predicted(2e-3)
    assert far.state is v.State.FAILED
    assert predicted(1e-5).state is v.State.PASSED


def test_deployable_is_not_known_before_deploy() -> None:
    line = v.deployable(SOUND)
    assert line.state is v.State.UNKNOWN
    assert "run deploy" in line.words
    assert line.figures["unstable_below_rate_hz"] == pytest.approx(1.5 / SOUND.delay)


def corner_design() -> tuple[Survival, float]:
    made = synthesise(
        scaled_plant(problem(), CORNER),
        problem().weights.at(*WEIGHTS),
        omega_low=problem().inner.omega_low,
    )
    loops = loops_of(problem(), CORNER, made.controller)
    found = judge_survival(problem(), loops, made.figures)[0]
    assert found is not None
    return found, made.figures.bandwidth


def test_the_range_found_is_where_stability_is_lost() -> None:
    """Case study 1: stable at the end of the range, not beyond it; measured apart."""
    made = synthesise(
        scaled_plant(problem(), CORNER),
        problem().weights.at(*WEIGHTS),
        omega_low=problem().inner.omega_low,
    )
    found, _ = corner_design()

    def stable(shift: float) -> bool:
        system = mechanics(problem_plant(), CORNER)
        modal = modal_plant(system, problem().suspension, Perturbation(shift=shift))
        plant = scale_plant(modal, problem().weights.M_K)
        loop = measure(plant, made.controller, made.weights, omega_low=2.0 * np.pi)
        return loop.certificate.stable

    low, high = found.stable_shift
    assert stable(0.999 * low)
    assert stable(0.999 * high)
    assert not stable(1.01 * low)
    assert not stable(1.01 * high)
    line = v.survives(found, S_max=1.75)
    assert line.state is v.State.WARNED, "lost at -0.8 % of resonance"
    assert found.unstable_poles_hz


def problem_plant():  # type: ignore[no-untyped-def]
    from ccd_casadi.inner_problem.problem import plant_of

    return plant_of(problem())


def test_static_figures_are_those_of_the_loop_at_rest() -> None:
    found, _ = corner_design()
    made = synthesise(
        scaled_plant(problem(), CORNER),
        problem().weights.at(*WEIGHTS),
        omega_low=problem().inner.omega_low,
    )
    K = made.controller
    K0 = (K.D - K.C @ np.linalg.solve(K.A, K.B)).item()
    assert found.statics.stiffness == pytest.approx(abs(K0), rel=1e-6)
    # the suspension's spring adds little to a stage of 110 kg at 0.1 Hz
    assert found.statics.compliance == pytest.approx(1.0 / K0, rel=0.02)


@pytest.mark.parametrize("robust", [None, RobustSet(0.001, 3, (), 0.001)])
def test_the_largest_local_peak_is_the_norm_and_has_its_gradient(robust: RobustSet | None) -> None:
    case = problem(robust=robust)
    theta, point = (60.0, 62.0), (300.0 * HZ, 60.0 * HZ)
    design = true_design(case, theta, *point)
    peaks = local_peaks_with_gradients(
        scaled_plant(case, theta), case.weights.at(*point), design, gamma_backoff=1.02, least=1.0
    )
    assert design.figures.certified
    assert peaks[0].ln_gain == pytest.approx(design.values[1], abs=1e-9)
    whole = np.hstack([design.to_theta[1], design.to_break_frequencies[1]])
    # a peak is placed to the root of rounding, and a sharp one moves its slope with its place
    assert peaks[0].gradient == pytest.approx(whole, rel=1e-3, abs=1e-6)
    step = 1e-4
    second = peaks[1]
    ends = []
    for sign in (1.0, -1.0):
        there = (60.0 + sign * step, 62.0)
        moved = local_peaks_with_gradients(
            scaled_plant(case, there), case.weights.at(*point), true_design(case, there, *point),
            gamma_backoff=1.02, least=0.9,
        )  # fmt: skip
        same = [p for p in moved if p.member == second.member]
        ends.append(min(same, key=lambda p: abs(p.omega - second.omega)).ln_gain)
    assert (ends[0] - ends[1]) / (2.0 * step) == pytest.approx(second.gradient[0], rel=1e-3)


@pytest.mark.parametrize("theta", [(60.0, 66.0), (68.0, 57.0)])
def test_a_descent_from_an_inner_optimum_ends_stationary(theta: tuple[float, float]) -> None:
    case = problem()
    inner = true_inner(case, theta)
    assert inner.optimum is not None
    figures = inner.optimum.figures
    start = np.array([*theta, np.log(figures.omega_S), np.log(figures.omega_T)])
    quantities = TrueQuantities(case)
    end = descend(quantities, start)
    lower, upper = lifted_bounds(case)
    assert (end >= lower).all()
    assert (end <= upper).all()
    found = TrueDesign(quantities, end)
    assert found.acceptable
    assert found.kkt.stationarity <= LiftedKktOptions().smooth
    J = found.objective
    assert TrueDesign(quantities, start).objective > J
    assert len(quantities.designs) < 40
    # another that knows this end stops near it, and goes on past one that is worse than it is
    again, past = TrueQuantities(case), TrueQuantities(case)
    near = descend(again, start, ended=[(end, J)])
    assert np.abs((near - end) / (upper - lower)).max() <= PeakDescentOptions().basin
    assert len(again.designs) < len(quantities.designs)
    through = descend(past, start, ended=[(end, J + 1e9)])
    np.testing.assert_array_equal(through, end)


@pytest.mark.slow
def test_descents_along_a_shelf_reach_its_end() -> None:
    """Where the bandwidth would jump is an edge like another: no start stops on the way along it.

    A margin of 10 (share of the box)² to the edge left ends 0.2 to 1.7 % apart after 30 steps.
    """
    case = chain_problem(2)
    lower, upper = lifted_bounds(case)
    quantities = TrueQuantities(case)
    ends = []
    for share in ((0.37, 0.66, 0.15, 0.89, 1.0, 1.0), (0.2, 0.6, 0.5, 0.5, 1.0, 1.0)):
        end = descend(quantities, lower + (upper - lower) * np.array(share))
        found = TrueDesign(quantities, end)
        assert found.acceptable
        assert any(name.startswith("-3 dB") for name in found.kkt.active)
        assert found.kkt.stationarity <= KKT_LEVEL
        ends.append(found.objective)
    assert ends[0] == pytest.approx(ends[1], rel=1e-5)


@pytest.mark.slow
def test_a_shelf_that_bends_sharply_is_followed_to_its_end() -> None:
    """The slope of this edge changes by a fifth within 1e-5 of the box.

    A margin that never grew past its first value left ends 3e-5 of J apart.
    """
    case = chain_problem(43)
    lower, upper = lifted_bounds(case)
    quantities = TrueQuantities(case)
    ends = []
    for share in ((0.517, 0.22, 0.96, 0.015, 1.0, 1.0), (0.54, 0.24, 0.9, 0.04, 1.0, 0.9)):
        start = lower + (upper - lower) * np.array(share)
        end = descend(quantities, start, steps=80, settled=1e-13)  # as a polish does
        found = TrueDesign(quantities, end)
        assert found.acceptable
        ends.append(found.objective)
    assert ends[0] == pytest.approx(ends[1], rel=1e-6)


@pytest.mark.slow
def test_all_formulations_end_at_the_same_optimum_of_the_modal_table() -> None:
    """D5: lifted and direct stopped 17 % short of nested, all of them verified."""
    case = load_case(ROOT / "examples" / "modal_table" / "case.toml")
    table = problem_of(case)
    found = {name: solve(table, formulation_of(case, name)).result for name in FORMULATIONS}
    values = [result["objective"] for result in found.values()]
    assert max(values) - min(values) <= case.outer.tolerance * abs(min(values))
    for result in found.values():
        assert result["box_look"]["points"] >= case.outer.box_points


CLAUSES = st.lists(st.integers(0, 40).map(lambda count: " ".join(["word"] * count)), max_size=9)


@given(CLAUSES)
def test_a_line_has_25_words_and_loses_none(clauses: list[str]) -> None:
    """What does not fit is below, in its order; a first clause that is too long is there whole."""
    words, details = v.split(clauses)
    assert len(words.split()) <= 25
    given = [clause for clause in clauses if clause]
    cut = words.endswith(" ...")
    assert cut == bool(given and len(given[0].split()) > 25)
    shown = [*([] if cut or not words else words.split("; ")), *details]
    assert shown == given


def test_the_sentences_of_decisions_are_short() -> None:
    """What is filled into a template is a reason or two of at most twelve words."""
    for sentence in (*decision.SENTENCES.values(), *decision.NEXT.values()):
        assert len(sentence.split()) <= 13, sentence


def result_of(**states: str) -> dict:
    lines: dict[str, dict[str, Any]] = {
        name: {"state": "passed", "words": f"{name} words", "details": [f"{name} rests on it"]}
        for name in concerns.LINES
    }
    for name, state in states.items():
        lines[name]["state"] = state
    return {"verdict": lines, "checks": {"certificate": True}, "status": "verified"}


def test_every_place_shows_the_same_lines() -> None:
    result = result_of(survives="warned", deployable="unknown")
    terminal = "\n".join([*shown.terminal_lines(result), *shown.detail_lines(result)])
    page = block_html(Verdict(concerns.lines_of(result)))
    for name in concerns.LINES:
        assert f"{name} words" in terminal
        assert f"{name} words" in page
        assert f"{name} rests on it" in terminal
        assert f"{name} rests on it" in page
    assert concerns.worst_state(result) is v.State.WARNED
    assert shown.head_words(result) == "with warnings: survives"
    assert "all checks passed" not in shown.head_words(result)
    assert "survives" in shown.head_words(result)
    assert "all checks passed" in shown.head_words(result_of())
    for name in ("optimal", "predicted", "deployable"):  # what could not run has not passed
        words = shown.head_words(result_of(**{name: "unknown"}))
        assert "passed" not in words
        assert f"unknown: {name}" in words


@pytest.mark.parametrize("damage", [{}, {"verdict": 3}, {"verdict": {"optimal": {"state": "?"}}}])
def test_a_run_without_a_verdict_shows_none(damage: dict) -> None:
    assert concerns.lines_of(damage) == ()
    assert block_html(Verdict(concerns.lines_of(damage))) == ""


def test_the_words_of_a_set_name_its_evidence_beside_the_levels_that_a_proof_left() -> None:
    """`proven` of an entry is a table of levels; the sentence says `searched`, not that table."""
    for own, evidence in (("searched", "searched, not proven"), ("kept", "proven")):
        known = {"set": own, "proven": {}, "worst_excess": -0.1, "looseness": 1e-4}
        assert Reason.SET_WITHIN().words(known).endswith(f"set: {evidence}")
