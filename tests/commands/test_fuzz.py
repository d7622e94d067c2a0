"""Some sixty of the inputs that benchmarks/fuzz.py runs by the thousand, the quick ones."""

import json
import random
from pathlib import Path

import pytest
from oracles.fuzz_bench import Bench
from oracles.fuzz_cases import case_file, theta
from oracles.fuzz_judge import Ending, misbehaviour
from oracles.fuzz_plants import plant
from oracles.fuzz_refute import refuted

QUICK = 60  # seeds; those whose command is neither inner nor a reading of a folder are left out
AT_A_TIME = 30


@pytest.fixture(scope="module")
def bench(two_mass_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("fuzz"), two_mass_run)


@pytest.mark.parametrize("first", range(0, QUICK, AT_A_TIME))
def test_no_input_breaks_a_command(bench: Bench, tmp_path: Path, first: int) -> None:
    wrong, done = [], 0
    for number in range(first, first + AT_A_TIME):
        verdict = bench.judged(f"ci-{number}", only=("inner", "read"))
        done += "code" in verdict
        if verdict.get("wrong"):
            wrong.append(verdict)
    assert wrong == []
    assert done >= AT_A_TIME // 2


@pytest.mark.parametrize("seed", ["0-1934", "0-7613"])
def test_what_double_precision_cannot_judge_is_judged_in_sixty_digits(
    bench: Bench, seed: str
) -> None:
    """A mass that is singular to ten digits; a stiffness of 1e-22 N/m. The tool's own engines may
    differ there: then nothing is claimed, and the command does not end as verified."""
    verdict = bench.judged(seed)
    assert verdict["wrong"] == []
    assert verdict["judged"] or verdict["code"] != 0


def test_a_false_claim_is_refuted(two_mass_run: Path) -> None:
    answer = json.loads((two_mass_run / "result.json").read_text())
    case = two_mass_run / "case.toml"
    assert refuted(case, two_mass_run, answer, True) == []
    certificate = answer["certificate"]
    for lie in (
        {"certificate": certificate | {"norm_bound": 0.97 * certificate["norm_bound"]}},
        {"sensitivity_peak": 0.99 * answer["sensitivity_peak"]},
        {"sensitivity_peak": 1.01 * 1.75},
        {"sensitivity_low": 0.99 * answer["sensitivity_low"]},
        {"bandwidth_hz": 1.001 * answer["bandwidth_hz"]},
        {"omega_S_hz": 1.05 * answer["omega_S_hz"]},
        {"theta": dict.fromkeys(answer["theta"], 54.0)},
    ):
        found = refuted(case, two_mass_run, answer | lie, True)
        assert found != [], lie
        assert all(line.startswith("refuted: ") for line in found)


def test_the_judge_sees_what_it_looks_for(tmp_path: Path, two_mass_run: Path) -> None:
    for maker in (case_file, theta, plant):
        given = maker(random.Random(1), tmp_path, two_mass_run)
        good = Ending(2, "", "one line\n")
        assert misbehaviour(given, good) == []
        for bad in (
            Ending(None, "", "", "Traceback (most recent call last):\nValueError: x"),
            Ending(1, "", "a line\n"),
            Ending(2, "", "two\nlines\n"),
            Ending(2, "", "an escape \x1b[2J\n"),
            Ending(2, "words", "a line\n"),
            Ending(130, "", "interrupted\n"),
            Ending(4, '{"status": "not_verified"}', "x.py:1: RuntimeWarning: overflow\n"),
        ):
            assert misbehaviour(given, bad) != []
