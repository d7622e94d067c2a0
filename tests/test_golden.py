"""The cases of benchmarks/golden.py end as they did, and their samples are found again."""

import json

import numpy as np
import pytest
from benchmark_scripts import benchmark

golden = benchmark("golden")
TABLE = json.loads(golden.FILE.read_text())
FAST = 3.0  # seconds: what CI solves


def test_the_hash_of_a_problem_stays() -> None:
    """Where one moves, samples that people have stored are not found any more."""
    problems = golden.problems()
    for case, known in TABLE.items():
        identity = problems[golden.cases()[case][0]].identity()
        assert golden.problem_hash(identity) == known["identity"], case


@pytest.mark.parametrize(
    "case",
    [
        name if known["seconds"] <= FAST else pytest.param(name, marks=pytest.mark.slow)
        for name, known in TABLE.items()
        if "status" in known  # the others are not solved yet
    ],
)
def test_a_solve_ends_where_it_did(case: str) -> None:
    known, found = TABLE[case], golden.solved(case)
    assert found["status"] == known["status"]
    width = known["tolerance"]
    assert found["objective"] == pytest.approx(known["objective"], rel=width["objective"])
    ends = [list(item["theta"].values()) for item in (found, known)]
    assert (np.abs(np.subtract(*ends)) <= width["theta"]).all(), ends
