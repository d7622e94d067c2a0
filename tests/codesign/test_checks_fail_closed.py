"""NaN, an exception, no answer and a contradiction at every check of the verdict: never passed.

Each check of a solved run is given a fault in turn. The line that rests on it may fail, warn or be
unknown, and a run with a failed line is not verified.
"""

import json
import math
from collections.abc import Callable
from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from oracles.helpers import HZ, problem

from ccd_casadi.codesign import inner_answer, outer_mixed, outer_structured
from ccd_casadi.codesign import verdict as v
from ccd_casadi.codesign.inner_answer import InnerOptions, mixed_answer
from ccd_casadi.codesign.outer_problem import FormulationResult, RunTerms
from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.result import result_dict
from ccd_casadi.codesign.run import outer_of
from ccd_casadi.codesign.survival import Survival
from ccd_casadi.codesign.verified import Verified
from ccd_casadi.fixed_structure import certificate
from ccd_casadi.fixed_structure.bounds import LoopPeaks
from ccd_casadi.fixed_structure.box_proof import Proof, ProofOutcome
from ccd_casadi.fixed_structure.judgement import Judgement
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.synthesis import second_engine
from ccd_casadi.synthesis.second_engine import EngineComparison
from ccd_casadi.synthesis.synthesis import Outcome

NAN = math.nan
UNPROVEN = [v.State.FAILED, v.State.WARNED, v.State.UNKNOWN]
X = np.array([55.0, 55.0, *np.log(2.0 * np.pi * np.array([1800.0, 26.05]))])


@pytest.fixture(scope="module")
def sound() -> Verified:
    """Case study 1 near its optimum, polished and judged, with nothing amiss."""
    with Workers(1) as workers, SampleStore(":memory:") as store:
        outer = outer_of(Sampler(problem(), store, workers))
        return outer.verify(outer.polish(X), 1)


def verdict_of(verified: Verified) -> tuple[dict[str, str], str]:
    """States of the lines by name, and the status, of what reads back as strict JSON."""
    terms = RunTerms("direct", 1e-3, 0)
    found = result_dict(terms, FormulationResult(verified.point), verified, {})
    found = json.loads(json.dumps(found, allow_nan=False))
    states = {name: line["state"] for name, line in found["verdict"].items()}
    assert (found["status"] == "verified") == ("failed" not in states.values())
    return states, found["status"]


def test_without_a_fault_the_lines_pass(sound: Verified) -> None:
    states, status = verdict_of(sound)
    assert states["certified"] == states["optimal"] == "passed"
    assert status == "verified"


def with_figures(item: Any, **changes: object) -> Any:
    figures = replace(item.design.figures, **changes)
    return replace(item, design=replace(item.design, figures=figures))


FAULTS: list[tuple[str, Callable[[Any], Any]]] = [
    ("certified", lambda d: replace(d, second=EngineComparison(1, denied="another norm"))),
    ("certified", lambda d: replace(d, second=EngineComparison(1, unknown="no answer"))),
    ("certified", lambda d: replace(d, second=EngineComparison(0))),
    ("certified", lambda d: replace(d, feasible=False)),
    ("certified", lambda d: with_figures(d, outcome=Outcome.LEVEL_TEST_FAILED)),
    ("optimal", lambda d: replace(d, inner_gap=NAN)),
    ("optimal", lambda d: replace(d, inner_gap=0.01)),
    ("optimal", lambda d: replace(d, kkt=replace(d.kkt, stationarity=NAN))),
    ("optimal", lambda d: replace(d, kkt=replace(d.kkt, primal=NAN))),
    ("optimal", lambda d: replace(d, kkt=replace(d.kkt, primal=1e-3))),
    ("survives", lambda d: replace(d, survival=None)),
    ("deployable", lambda d: replace(d, survival=None)),
    (
        "survives",
        lambda d: replace(d, survival=replace(d.survival, contradiction=Reason.MODEL_UNSTABLE())),
    ),
]


@pytest.mark.parametrize("number", range(len(FAULTS)))
def test_a_fault_of_a_check_is_not_passed(sound: Verified, number: int) -> None:
    line, fault = FAULTS[number]
    assert verdict_of(fault(sound))[0][line] in UNPROVEN


def test_a_figure_that_is_nan_is_within_no_range(sound: Verified) -> None:
    """Each range of what the loop survives, and the peak on a closer model."""
    good = replace(sound.survival, stable_shift=(-0.2, 0.2), S_max_shift=(-0.1, 0.1),
                   stable_damping=(0.1, 10.0), unstable_poles_hz=())  # fmt: skip
    assert v.survives(good, S_max=2.0, own=v.OwnSet.KEPT).state is v.State.PASSED
    for name in ("stable_shift", "stable_damping"):
        for ends in ((NAN, NAN), (getattr(good, name)[0], NAN), (NAN, getattr(good, name)[1])):
            assert v.survives(replace(good, **{name: ends}), S_max=2.0).state in UNPROVEN
    assert v.survives(good, S_max=2.0, closer=[("finer", True, NAN)]).state in UNPROVEN


@pytest.mark.parametrize("own", [v.OwnSet.BROKEN, v.OwnSet.UNPROVEN, v.OwnSet.NONE])
def test_a_set_that_is_not_known_to_be_kept_is_not_passed(sound: Verified, own: v.OwnSet) -> None:
    for survival in (sound.survival, None):
        assert v.survives(survival, S_max=2.0, own=own).state in UNPROVEN


@pytest.mark.parametrize("error", [NAN, math.inf, 0.1])
@pytest.mark.parametrize("learnt", [True, False])
def test_a_prediction_that_was_not_met_is_not_passed(error: float, learnt: bool) -> None:
    quality: Any = SimpleNamespace(at_point=None, extrapolates=())
    assert v.judge_prediction(error, 1e-3, 300.0, BANDWIDTH, quality, learnt).state in UNPROVEN
    assert v.judge_prediction(0.0, 1e-3, 300.0, BANDWIDTH, None).state is v.State.UNKNOWN
    left_out: Any = SimpleNamespace(at_point=(NAN, NAN), extrapolates=())
    assert v.judge_prediction(0.0, 1e-3, 300.0, BANDWIDTH, left_out).state in UNPROVEN


@pytest.mark.parametrize("delay", [NAN, math.inf])
def test_a_delay_that_is_not_known_is_not_deployable(sound: Verified, delay: float) -> None:
    assert v.deployable(replace(sound.survival, delay=delay)).state in UNPROVEN


NAMES = [field.name for field in fields(LoopPeaks) if field.name != "S_peak_frequency"]


@pytest.mark.parametrize("name", [*NAMES, "confirmed", "stable"])
def test_a_figure_of_the_judge_that_is_nan_fails_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of one plant of three, whichever: the set's certificate does not pass."""
    weights = problem().weights
    bounds = certificate.Bounds(S_max=2.0, S_low=0.1, omega_low=6.0, shape=1.1, weighted_level=9.0,
                                weights=weights, compliance_max=1e-6)  # fmt: skip
    sound = certificate.PlantFigures(
        True, -1.0, bandwidth=300.0, confirmed=True, S_peak=1.5, S_low=0.01, KS=1.0, T=1.0, GS=1e-7,
        weighted_KS=1.0, weighted_T=1.0,
    )  # fmt: skip
    counted = bounds.shares(sound).values()
    assert len(counted) == 5
    lost = replace(sound, **{name: NAN if name in NAMES else False})
    matter = name not in ("KS", "T")  # which no bound is of, but for their weighted ones
    plant = StateSpace(*np.ones((4, 1, 1)))
    for place in range(3):
        each = [lost if i == place else sound for i in range(3)]
        monkeypatch.setattr(certificate, "judge_plants", lambda *_, each=each: each)
        found = certificate.certify([plant] * 3, plant, bounds)
        assert found.passed is not matter


def test_slicot_that_fails_is_no_confirmation(monkeypatch: pytest.MonkeyPatch) -> None:
    """An exception, NaN and another norm, in the whole run."""

    def fails(*_: object, **__: object) -> None:
        raise second_engine.slycot.exceptions.SlycotArithmeticError("no", 3)

    own = second_engine.slycot.ab13dd
    for answer, states in (
        (fails, {"warned"}),
        (lambda *_, **__: (NAN, 0.0), {"warned"}),
        (lambda *a, **k: (1.01 * own(*a, **k)[0], 0.0), {"failed"}),
    ):
        monkeypatch.setattr(second_engine.slycot, "ab13dd", answer)
        with Workers(1) as workers, SampleStore(":memory:") as store:
            outer = outer_of(Sampler(problem(), store, workers))
            assert verdict_of(outer.verify(outer.polish(X), 1))[0]["certified"] in states


def test_a_challenge_that_finds_nothing_is_no_gap_of_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    with Workers(1) as workers, SampleStore(":memory:") as store:
        sampler = Sampler(problem(), store, workers)
        nothing = replace(sampler.values(X[:2])[0], bandwidth=NAN)
        monkeypatch.setattr(Sampler, "values", lambda *_: [nothing])
        end = outer_mixed.MixedOuter(sampler).polish(X)
    assert math.isnan(end.gap)
    lost: Any = SimpleNamespace(feasible=False)
    assert math.isnan(outer_structured._gap(problem(), lost, lost))


def test_bounds_that_are_not_proven_are_not_called_proven() -> None:
    proof = Proof(ProofOutcome.LOOSER, 1e-3, ("a",), {"S_MAX": 91.15, "GS": 1539.8}, 1000)
    assert proof.unclosed
    assert proof.words.startswith("not every bound is proven")
    assert "1539.8" in proof.words
    left = "KS is judged, not proven"
    proven = replace(proof, outcome=ProofOutcome.PROVEN, levels={"S_MAX": 1.0005}, left=left)
    assert "judged, not proven" in proven.words


def test_every_range_of_a_survival_is_tried_here() -> None:
    """A new one has to be given a fault too."""
    assert {field.name for field in fields(Survival)} == {
        "stable_shift", "S_max_shift", "stable_damping", "gain", "phase_deg", "delay", "modulus",
        "unstable_poles_hz", "statics", "contradiction", "S_max_slack",
    }  # fmt: skip


@pytest.mark.parametrize("passed", [False, None])
def test_a_missed_bound_hides_no_unstable_loop(
    passed: bool | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At given frequencies a bound may be missed; stable the loop has to be."""
    case = problem(inner=replace(problem().inner, S_max=1.05))
    how = InnerOptions(0, Workers(1), point=(800.0 * HZ, 40.0 * HZ))
    answer = mixed_answer(case, (60.0, 60.0), how)
    assert answer.status == "verified"
    assert not answer.figures["feasible"]
    assert "misses bounds of the case: peak of S" in answer.figures["reason"]
    unstable = Judgement(1, {}, passed, "unstable on plant 1 of 1")
    monkeypatch.setattr(inner_answer, "judge_on_model", lambda *_: unstable)
    assert mixed_answer(case, (60.0, 60.0), how).status == "not_verified"
