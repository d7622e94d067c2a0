"""What a decision names besides the five lines: a move that does not settle, what must be known."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few

from ccd_casadi.codesign.verdict import OwnSet
from ccd_casadi.reporting.concerns import (
    Concern,
    ConcernKind,
    ConcernOptions,
    resonance_condition,
    risks,
)
from ccd_casadi.reporting.decision import (
    NEXT,
    SENTENCES,
    Build,
    Decision,
    DecisionOptions,
    advice,
    decide,
)

LINES = ("certified", "optimal", "predicted", "survives", "deployable")


def result_of(**states: str) -> dict:
    lines = {name: {"state": states.get(name, "passed"), "words": name} for name in LINES}
    return {"status": "verified", "verdict": lines}


def moved(state: str, unlimited: bool = True) -> dict:
    """The figures of a move within 50 N."""
    return {
        "state": state, "force_limit": 50.0, "settled": 0.2 if state == "passed" else None,
        "time": 0.72, "left": 3e-6 if state == "failed" else None, "settles_unlimited": unlimited,
    }  # fmt: skip


@pytest.mark.parametrize(
    "states",
    [{}, {"predicted": "warned"}, {"survives": "warned"}, {"deployable": "warned"},
     {"optimal": "failed"}, {"survives": "unknown"}],
)  # fmt: skip
def test_a_move_that_does_not_settle_within_its_limit_is_in_every_decision(states: dict) -> None:
    result = result_of(**states)
    before = advice(result)
    result["verdict"]["deployable"]["move"] = moved("passed")
    assert advice(result) == before
    for state, said in (("failed", "the move has not settled"), ("unknown", "is not known")):
        result["verdict"]["deployable"]["move"] = moved(state)
        words = advice(result)
        assert words.startswith("Do not build this")
        assert said in words
        assert "50 N" in words
        assert "Next: " in words
        if before.startswith("Do not"):  # whose reason stays the first
            assert words.startswith(before.partition(".")[0])


@pytest.mark.parametrize("state", ["failed", "warned", "unknown"])
@pytest.mark.parametrize("own", [None, *OwnSet])
def test_a_set_is_advised_only_where_the_case_names_none(state: str, own: OwnSet | None) -> None:
    result = result_of(survives=state)
    result["verdict"]["survives"]["set"] = own
    none = own in (None, OwnSet.NONE)
    assert none or NEXT["survives"] not in advice(result)
    assert not (none and state == "failed") or NEXT["survives"] in advice(result)
    result["verdict"]["survives"] = {"state": state, "words": "", "share": 0.999}
    assert NEXT["survives"] not in advice(result)


@given(
    states=st.fixed_dictionaries(
        {name: st.sampled_from(["passed", "warned", "failed", "unknown"]) for name in LINES}
    ),
    own=st.sampled_from([None, *OwnSet]),
    ended=st.booleans(),
    move=st.sampled_from(["none", "passed", "failed", "unknown"]),
    verified=st.booleans(),
)
def test_no_decision_builds_what_breaks_a_bound_or_is_not_known(
    states: dict, own: OwnSet | None, ended: bool, move: str, verified: bool
) -> None:
    result = result_of(**states)
    result["status"] = "verified" if verified else "not_verified"
    result["verdict"]["survives"]["set"] = own
    if move != "none":
        result["verdict"]["deployable"]["move"] = moved(move)
    result["time_budget"] = {"ended": ended, "minutes": 5.0}
    found = decide(result)
    reasons = {one.reason for one in found.concerns}
    assert found.builds != found.refuses
    failed = {name for name, state in states.items() if state == "failed"}
    missed = failed <= {"optimal", "predicted"}  # with every bound kept
    if not missed or not (verified or failed) or move in ("failed", "unknown"):
        assert found.refuses
    if found.build in (Build.YES, Build.AFTER_DEPLOY):
        assert not reasons
        assert not ended
        judged = {name: state for name, state in states.items() if name != "deployable"}
        # without a surrogate nothing was predicted
        assert judged.pop("predicted") in ("passed", "unknown")
        assert set(judged.values()) == {"passed"}
    else:
        assert found.concerns
    if found.builds:
        assert (ConcernKind.BUDGET in reasons) == ended
    for one in found.concerns:
        assert one.words in advice(result)
    assert advice(result).startswith(found.words)


@given(
    reasons=st.lists(st.integers(1, 60), max_size=6),
    steps=st.lists(st.integers(1, 40), max_size=4),
    remarks=st.lists(st.integers(1, 40), max_size=4),
    condition=st.booleans(),
)
def test_an_engineer_reads_the_strongest_reasons_and_nothing_is_lost(
    reasons: list[int], steps: list[int], remarks: list[int], condition: bool
) -> None:
    """A word has the number of its sentence, so that each is found once, and in its order."""

    def texts(letter: str, lengths: list[int]) -> tuple[str, ...]:
        return tuple(" ".join([f"{letter}{i}"] * n) for i, n in enumerate(lengths))

    named = texts("r", reasons)
    build = Build.IF_ACCEPTED if named else Build.YES
    concerns = tuple(Concern(ConcernKind.LOOP, words) for words in named)
    parts = texts("s", steps), texts("m", remarks)
    found = Decision(build, concerns, parts[0], condition="c0" * condition, remarks=parts[1])
    whole = " ".join([found.words, *found.also])
    for words in (*named, *parts[0], *parts[1]):
        assert whole.count(words.split()[0]) == len(words.split())
        assert words in whole
    assert ("c0" in found.words) == condition
    options = DecisionOptions()
    first = re.findall(r"r\d+(?=[ ;.])", found.words)
    assert len(set(first)) <= options.most_reasons
    assert not named or named[0] in found.words
    beyond = " ".join([SENTENCES[build], *named[:1], "Next:", *parts[0][:1], "c0"])  # always in it
    assert len(found.words.split()) <= options.most_words + len(beyond.split())
    shown = [words in found.words for words in (*named, *parts[0])]
    for part in (shown[: len(named)], shown[len(named) :]):
        assert part == sorted(part, reverse=True)


def test_a_larger_limit_is_no_remedy_where_the_move_does_not_settle_without_one() -> None:
    result = result_of()
    for unlimited in (True, False):
        result["verdict"]["deployable"]["move"] = moved("failed", unlimited)
        assert ("larger --saturation" in advice(result)) == unlimited


def test_a_rate_is_next_only_where_a_rate_is_enough() -> None:
    result = result_of(deployable="failed")
    for needed, said in ((8000.0, "a higher rate"), (None, "Next: less delay.")):
        result["verdict"]["deployable"]["needed_hz"] = needed
        assert said in advice(result)


SHIFTS = st.floats(0.0, 0.3)


@few(max_examples=100)
@given(low=SHIFTS, high=SHIFTS, held=st.sampled_from([0.0, 0.01, 0.03]))
def test_resonances_that_must_be_known_are_a_condition_unless_the_set_holds_their_error(
    low: float, high: float, held: float
) -> None:
    result = result_of()
    result["verdict"]["survives"] |= {
        "set": OwnSet.KEPT, "robust_set": True, "S_max_shift": [-low, high],
        "set_shift": [-held, held],
    }  # fmt: skip
    words, known = advice(result), ConcernOptions().identified
    assert words.startswith("Build this.")  # what scripts compare with
    assert ("Condition: " in words) == (held == 0.0 and min(low, high) < known)
    for sentence in words.split(". "):
        assert len(sentence.split()) <= 25
    if "Condition: " in words:
        for text in re.findall(r"[-+]?[\d.]+(?= (?:%|to))", words):
            assert abs(float(text)) <= 100.0 * max(low, high) + 1e-9  # never more than is kept
        assert any("identify them that well" in risk for risk in risks(result))


def test_an_older_run_names_no_condition_and_other_decisions_name_it_too() -> None:
    shift = {"S_max_shift": [-0.012, 0.3]}
    result = result_of()
    result["verdict"]["survives"] |= shift
    assert advice(result) == "Build this."
    said = "Condition: no resonance is more than 1.2 % below its model; else |S| exceeds S_max."
    for states in ({}, {"predicted": "warned"}, {"deployable": "unknown"}):
        result = result_of(**states)
        result["verdict"]["survives"] |= {**shift, "set_shift": [0.0, 0.0]}
        assert resonance_condition(result) == said
        assert advice(result).endswith(f" {said}")
    failed = result_of(certified="failed")
    failed["verdict"]["survives"] |= {**shift, "set_shift": [0.0, 0.0]}
    assert "Condition" not in advice(failed)


@pytest.mark.parametrize("name", ["optimal", "predicted"])
def test_a_design_that_keeps_every_bound_is_not_refused_for_what_it_misses(name: str) -> None:
    """A safe loop beside the optimum may be built; one that misses a bound as well may not."""
    result = result_of(**{name: "failed"}) | {"status": "not_verified"}
    check = "optimality" if name == "optimal" else "prediction"
    result["checks"] = {check: False, "certificate": True, "robust": True}
    found = decide(result)
    assert found.build is Build.IF_ACCEPTED
    assert NEXT[name] in found.steps
    for lost in ("certificate", "robust", "judge"):
        result["checks"] = {check: False, lost: False}
        assert decide(result).build is Build.NO
    for other in ("certified", "survives", "deployable"):
        both = result_of(**{name: "failed", other: "failed"}) | {"status": "not_verified"}
        assert decide(both).build is Build.NO
    assert decide(result_of() | {"status": "not_verified"}).build is Build.NO


def test_a_decision_names_bounds_of_theta_and_what_another_plant_or_rounding_exceeds() -> None:
    """A requirement that is proven, or of the one plant that there is, lies at its limit."""
    result = result_of() | {
        "theta": {"m1": 55.0, "m2": 60.0}, "units": {"m1": "kg", "m2": "kg"},
        "active": ["m1 lower", "S_max", "omega_S upper"],
        "requirements": [requirement("S_max", 1.75, "proven"), requirement("T", 1.0, "judged")],
    }  # fmt: skip
    assert advice(result) == (
        "Build this. m1 is at its lower bound 55 kg: a wider range may be better."
    )
    result |= {"active": [], "requirements": [requirement("S_max", 1.75, "searched")]}
    assert "Nothing is left of S_max on the plants that were checked" in advice(result)
    assert decide(result).build is Build.YES
    little = {"set": OwnSet.UNPROVEN, "proof": "looser", "proven": {"S_MAX": 1.002}, "plants": 9}
    result["verdict"]["survives"] |= {"state": "warned"} | little
    assert "proven only up to 0.2 %" in advice(result)
    assert "Nothing is left" not in advice(result)
    result["verdict"] = result_of()["verdict"]
    result["requirements"] = [requirement("S_max", 1.75, "searched", margin=0.02)]
    assert advice(result) == "Build this."
    result["requirements"] = [requirement("too heavy", 0.0, "judged")]
    assert "“too heavy” binds: round theta so that it still holds" in advice(result)
    assert "too heavy" not in advice(result | {"verdict": result_of(survives="failed")["verdict"]})


def requirement(name: str, required: float, evidence: str, margin: float = 1e-9) -> dict:
    return {"name": name, "required": required, "evidence": evidence, "margin": margin}


@pytest.mark.parametrize(
    ("latest", "said"), [(0.283, "after 283 ms on the worst of the 5 plants"), (0.1051, ""),
                         (None, "on the worst of the 5 plants that it is designed on not")],
)  # fmt: skip
def test_a_decision_names_the_move_on_the_worst_plant_beside_the_models(
    latest: float | None, said: str
) -> None:
    move = {"settled": 0.105, "settled_latest": latest, "plants": 5}
    words = advice(result_of() | {"move": move})
    assert ("settles after 105 ms on the model" in words) == bool(said)
    assert said in words
    assert advice(result_of() | {"move": move | {"plants": 1}}) == "Build this."


@pytest.mark.parametrize("plants", [1, 5])
@pytest.mark.parametrize(("latest", "late"), [(0.29, False), (0.31, True), (None, True)])
def test_a_move_that_settles_when_the_next_has_begun_is_an_objection(
    latest: float | None, late: bool, plants: int
) -> None:
    move = {"settled": 0.1, "settled_latest": latest, "plants": plants, "duration": 0.1,
            "dwell": 0.2}  # fmt: skip
    decided = decide(result_of() | {"move": move})
    assert (decided.build is Build.IF_ACCEPTED) == late
    assert ("the next one begins after 300 ms" in decided.words) == late
    assert ("on the worst of 5 plants" in decided.words) == (late and plants > 1)
    assert not decide(result_of() | {"move": move | {"dwell": 0.0}}).concerns


def test_a_motor_that_sets_the_acceleration_leaves_feedback_its_share() -> None:
    """The limits that it is given are lower by what feedback needs beyond them."""
    move = {
        "settled": 0.1, "settled_latest": 0.1, "plants": 5, "duration": 0.1, "dwell": 0.2,
        "needed_power": 105.0, "needed_heat_share": 1.05, "needed_heat_plant": "load 2 kg",
        "needed_current": 11.0, "needed_share": 1.1, "needed_force_plant": "load 3 kg",
    }  # fmt: skip
    words = advice(result_of() | {"move": move | {"limits": ["heat", "peak force"]}})
    assert "rms_power = 95.2 in [motor]" in words
    assert "peak_current = 9.09 in [motor]" in words
    assert "load 2 kg" in words
    assert "load 3 kg" in words
    given = advice(result_of() | {"move": move | {"limits": ["acceleration"]}})
    assert "in [motor]" not in given
    assert "less acceleration in [move]" in given
