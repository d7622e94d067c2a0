"""Some hundred of the inputs that benchmarks/fuzz.py runs by the thousand, the quick ones."""

import random
from pathlib import Path

import pytest
from fuzz_cases import case_file, theta
from fuzz_judge import Bench, Ending, misbehaviour
from fuzz_plants import plant

QUICK = 120  # seeds; those whose command is neither inner nor a reading of a folder are left out
AT_A_TIME = 40


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
