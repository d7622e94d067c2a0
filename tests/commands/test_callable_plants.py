"""A plant that is a Python callable: the same plant as its file, in this process and in others."""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import ccd_casadi as ccd
from ccd_casadi.cases.case import case_to_toml
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.support.user_code import GivenFunction
from ccd_casadi.support.worker_process import one_blas_thread

WEIGHTS = {"M_S": 2.0, "A_S": 1e-4, "c_K": 1e4, "omega_K_hz": 100.0, "M_K": 2e7, "A_l": 1.0,
           "A_u": 1e-2}  # fmt: skip
INNER = {"S_max": 1.75, "S_low": 0.03, "omega_low_hz": 1.0, "omega_S_hz": [10.0, 1800.0],
         "omega_T_hz": [25.0, 1000.0]}  # fmt: skip


def stage(theta: Mapping[str, Any], k: float = 4e7) -> dict[str, Any]:
    m1, m2 = float(theta["m1"]), float(theta["m2"])
    return {
        "mass": np.diag([m1, m2]), "stiffness": k * np.array([[1.0, -1.0], [-1.0, 1.0]]),
        "damping_ratio": 0.01, "input": np.array([[1.0], [0.0]]),
        "output": np.array([[1.0, 0.0]]), "hardware_cost": m1 + m2,
    }  # fmt: skip


def case_of(function: Callable[..., Any] | str, path: Path = Path("case")) -> Any:
    tables = {
        "plant": {"function": function, "k": 3.6e7},
        "theta": {m: {"lower": 55.0, "upper": 70.0, "unit": "kg"} for m in ("m1", "m2")},
        "objective": {"w1": 0.0995, "w2": -0.9950},
        "weights": WEIGHTS, "inner": INNER,
    }  # fmt: skip
    return ccd.parse_case(tables, path)


def natural(problem: Any) -> np.ndarray:
    return np.asarray(ccd.scaled_plant(problem, (60.0, 60.0)).natural)


def _in_worker(problem: Any) -> np.ndarray:
    return natural(problem)


def test_a_callable_is_the_plant_of_its_file() -> None:
    here = natural(ccd.problem_of(case_of(stage)))
    file = natural(ccd.problem_of(case_of(f"{__file__}:stage", Path(__file__))))
    assert here == pytest.approx(file, rel=1e-12)


def test_workers_find_a_function_of_a_module() -> None:
    problem = ccd.problem_of(case_of(stage))
    with Workers(2) as pool:
        found = list(pool.map_unordered(_in_worker, [problem] * 2))
    assert np.array_equal(found, [natural(problem)] * 2)


@pytest.mark.parametrize("make", [lambda: lambda theta, k: stage(theta, k), lambda: partial(stage)])
def test_what_no_worker_finds_is_refused_by_name(make: Callable[[], Any]) -> None:
    given = make()
    problem = ccd.problem_of(case_of(given))
    assert natural(problem) == pytest.approx(natural(ccd.problem_of(case_of(stage))))
    name = getattr(given, "__qualname__", "partial")
    with pytest.raises(ccd.UserError, match=f"{name.split('.')[-1]} cannot be found"):
        ccd.solve(problem, workers=2)


def test_samples_of_a_callable_are_of_one_problem() -> None:
    """Nobody sees what it depends on: not even the same function twice shares a store."""
    first, again = (ccd.problem_of(case_of(stage)).identity() for _ in range(2))
    assert first["plant"] != again["plant"]


def test_its_faults_are_reported_with_line_and_name() -> None:
    def boom(theta: Mapping[str, Any], k: float) -> None:
        raise ValueError("no such beam")

    with pytest.raises(ccd.UserError, match=r"no such beam in line \d+ of test_callable_plants.py"):
        ccd.problem_of(case_of(boom))
    with pytest.raises(ccd.UserError, match="is a Python callable"):
        case_to_toml(case_of(stage))
    assert GivenFunction(stage).__getstate__() == {"call": stage}


def test_the_library_computes_with_one_blas_thread() -> None:
    """And leaves the process as it was, also where calls are within each other."""

    def threads() -> dict[str, int]:
        blas = [one for one in threadpool_info() if one["user_api"] == "blas"]
        return {one["filepath"]: one["num_threads"] for one in blas}

    seen = []

    def spied(theta: Mapping[str, Any], k: float) -> dict[str, Any]:
        with one_blas_thread:
            pass
        seen.append(threads())
        return stage(theta, k)

    ccd.problem_of(case_of(stage))  # every BLAS that it needs is loaded before the limit
    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        ccd.problem_of(case_of(spied))
        after = threads()
    assert seen
    assert {count for each in seen for count in each.values()} == {1}
    assert 2 in before.values()  # not every BLAS takes more than one
    assert before.items() <= after.items()  # another test may have another library loaded


def test_a_library_that_comes_with_a_module_is_limited_too() -> None:
    """In a process of its own, where SciPy with its own BLAS is imported after the first limit."""
    words = (
        "import numpy, sys\n"
        "from threadpoolctl import threadpool_info\n"
        "from ccd_casadi.support.worker_process import one_blas_thread\n"
        "with one_blas_thread: pass\n"
        "known = len(threadpool_info())\n"
        "import scipy.linalg\n"
        "with one_blas_thread:\n"
        "    print(known, *(found['num_threads'] for found in threadpool_info()))\n"
    )
    env = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", words], env=env, capture_output=True, text=True, check=True
    )
    known, *threads = map(int, done.stdout.split())
    assert known < len(threads)
    assert set(threads) == {1}
