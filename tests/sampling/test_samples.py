"""The store of syntheses: keys, exact round trips, several writers and kills."""

import json
import math
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.helpers import few
from oracles.rows import REALS, identical, sample

from ccd_casadi.sampling.store import Sample, SampleStore
from ccd_casadi.sampling.units import problem_hash, sample_key

# -0.0 is left out: SQLite stores it as 0, and no key or figure tells the two apart.
numbers = st.floats().filter(lambda v: math.copysign(1.0, v) > 0.0 or v != 0.0)
finite = st.floats(allow_nan=False, allow_infinity=False)
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)


# ---- keys ----------------------------------------------------------------------------------------

plain = st.recursive(
    st.one_of(st.none(), st.booleans(), finite, texts),
    lambda inside: st.one_of(
        st.lists(inside, max_size=3), st.dictionaries(texts, inside, max_size=3)
    ),
    max_leaves=6,
)
mappings = st.dictionaries(texts, plain, max_size=4)


@few(max_examples=100)
@given(mappings)
def test_hash_is_blind_to_order_and_to_list_or_tuple(mapping: dict[str, Any]) -> None:
    turned = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in reversed(mapping.items())
    }
    assert problem_hash(turned) == problem_hash(mapping)


@few(max_examples=100)
@given(mappings, mappings)
def test_different_problems_have_different_hashes(a: dict[str, Any], b: dict[str, Any]) -> None:
    assert (problem_hash(a) == problem_hash(b)) == (exact(a) == exact(b))


def exact(value: Any) -> Any:
    """The value with what Python's == confuses kept apart: True and 1.0."""
    if isinstance(value, dict):
        return {key: exact(item) for key, item in value.items()}
    if isinstance(value, list):
        return [exact(item) for item in value]
    return type(value).__name__, value


@few(max_examples=100)
@given(st.lists(finite, min_size=3, max_size=5), st.integers(0, 4), st.booleans())
def test_key_reports_neighbouring_floats_apart(values: list[float], place: int, up: bool) -> None:
    place %= len(values)
    moved = list(values)
    moved[place] = math.nextafter(values[place], math.inf if up else -math.inf)
    if not math.isfinite(moved[place]):
        moved[place] = 0.0
    key = sample_key("p", values[2:], values[0], values[1])
    assert key == sample_key("p", tuple(values[2:]), values[0], values[1])
    assert key != sample_key("p", moved[2:], moved[0], moved[1])
    assert key != sample_key("q", values[2:], values[0], values[1])


def test_key_does_not_confuse_theta_with_frequencies() -> None:
    assert sample_key("p", [1.0, 2.0], 3.0, 4.0) != sample_key("p", [1.0], 2.0, 3.0)
    assert sample_key("p", [0.0], 1.0, 2.0) == sample_key("p", [-0.0], 1.0, 2.0)
    assert sample_key("p", [1], 2, 3) == sample_key("p", [1.0], 2.0, 3.0)


def test_integers_that_no_float_holds_are_kept_apart() -> None:
    assert problem_hash({"seed": 2**53 + 1}) != problem_hash({"seed": 2**53})
    assert problem_hash({"seed": -(2**53) - 1}) != problem_hash({"seed": -(2**53)})


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_key_of_what_is_not_finite(value: float) -> None:
    with pytest.raises(ValueError, match="give finite numbers"):
        problem_hash({"a": [1.0, {"b": value}]})


@pytest.mark.parametrize("value", [b"x", {1, 2}, object(), 1j])
def test_no_key_of_what_is_no_plain_value(value: object) -> None:
    with pytest.raises(TypeError, match="cannot be part of a key"):
        problem_hash({"a": value})


# ---- rows ----------------------------------------------------------------------------------------


@few(max_examples=40)
@given(
    st.fixed_dictionaries(
        dict.fromkeys(REALS, numbers)
        | {
            "omega_S": finite.filter(bool),
            "omega_T": finite.filter(bool),
            "theta": st.lists(finite, min_size=1, max_size=4).map(tuple),
            "outcome": texts,
            "reason": texts,
            "certified": st.booleans(),
            "gradients": st.none() | st.lists(st.floats(), max_size=6).map(tuple),
        }
    )
)
def test_a_row_comes_back_bit_for_bit(values: dict[str, Any]) -> None:
    row = Sample(key="k", **values)
    with tempfile.TemporaryDirectory() as folder:
        with SampleStore(Path(folder) / "s.sqlite") as store:
            store.put([row])
        with SampleStore(Path(folder) / "s.sqlite") as store:
            (again,) = store.select()
            assert identical(again, row)
            assert identical(store.get(["k"])["k"], row)


def test_the_round_trip_check_can_fail() -> None:
    assert identical(sample(gamma=math.nan), sample(gamma=math.nan))
    assert not identical(sample(gamma=1.0), sample(gamma=math.nextafter(1.0, 2.0)))
    assert not identical(sample(gradients=None), sample(gradients=()))


def test_known_rows_stay_and_only_gain_gradients(tmp_path: Path) -> None:
    with SampleStore(tmp_path / "s.sqlite") as store:
        store.put([sample(bandwidth=1.0, seconds=1.0)])
        store.put([sample(bandwidth=2.0, seconds=2.0)])
        store.put([sample(bandwidth=3.0, seconds=3.0, gradients=(4.0, 5.0))])
        store.put([sample(gradients=(6.0,)), sample("other")])
        found = store.get(["k", "other", "absent"])
    assert set(found) == {"k", "other"}
    assert (found["k"].bandwidth, found["k"].seconds) == (1.0, 1.0)
    assert found["k"].gradients == (4.0, 5.0)


def test_rows_are_ordered_and_thousands_of_keys_can_be_required(tmp_path: Path) -> None:
    rows = [
        sample(f"k{i}", theta=(float(-i % 7), float(i)), omega_S=float(i % 3)) for i in range(1203)
    ]
    with SampleStore(tmp_path / "s.sqlite") as store:
        store.put(rows)
        assert store.count() == 1203
        assert set(store.get([row.key for row in rows])) == {row.key for row in rows}
        order = [(s.theta, s.omega_S, s.omega_T, s.key) for s in store.select()]
    assert order == sorted(order)


def test_a_unit_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    result = ("r", "p", (1.0, 2.0), {"bandwidth": 3.0, "none": None})

    def failing() -> Iterator[Sample]:
        yield sample("a")
        raise RuntimeError("in the middle")

    with SampleStore(path) as store:
        with pytest.raises(RuntimeError, match="in the middle"):
            store.put_unit(failing(), result)
        assert (store.count(), store.get_result("r")) == (0, None)
        with pytest.raises(TypeError):
            store.put_unit([sample("a")], (*result[:3], {"not": object()}))
        assert store.count() == 0
        store.put_unit([sample("a"), sample("b")], result, "p")
        store.put_unit([sample("a")], ("r", "p", (1.0, 2.0), {"bandwidth": 4.0}), "p")
    with SampleStore(path) as store:
        assert store.count() == 2
        assert store.get_result("r") == {"bandwidth": 3.0, "none": None}


def test_the_file_explains_itself_without_our_code(tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    with SampleStore(path) as store:
        store.put_problem("p", {"model": "two_mass", "w": [1.0]})
        store.put_problem("p", {"model": "another"})
        store.put([sample(bandwidth=7.0)], "p")
    database = sqlite3.connect(path)
    query = "select json, theta, bandwidth from samples join problems on problem = hash"
    ((problem, theta, bandwidth),) = database.execute(query).fetchall()
    database.close()
    assert json.loads(problem) == {"model": "two_mass", "w": [1.0]}
    assert (json.loads(theta), bandwidth) == ([60.0, 55.5], 7.0)


# ---- several processes ---------------------------------------------------------------------------

WRITER = """
import dataclasses, random, sys, time
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.sampling.store import Sample
path, name, pause = sys.argv[1], sys.argv[2], float(sys.argv[3])
NAMES = [field.name for field in dataclasses.fields(Sample) if field.type is float]
def row(unit, i):
    reals = dict.fromkeys(NAMES, float(unit))
    return Sample(**(reals | {"key": f"{unit}-{i}", "theta": (float(unit), float(i)),
                  "outcome": "certified", "reason": name, "certified": True}))
print('imported', flush=True)
sys.stdin.readline()
with SampleStore(path) as store:
    units = list(range(60))
    random.Random(name).shuffle(units)
    for unit in units:
        store.put_unit([row(unit, i) for i in range(5)], (str(unit), "p", (float(unit),), {"n": 5}))
        print(unit, flush=True)
        time.sleep(pause)
"""


def writer(path: Path, name: str, pause: float = 0.0) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path), name, str(pause)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def test_processes_that_write_the_same_rows_at_once(tmp_path: Path) -> None:
    path = tmp_path / "s.sqlite"
    running = [writer(path, name) for name in "abc"]
    for process in running:  # then all of them create the file at the same moment
        assert process.stdout is not None
        assert process.stdout.readline() == "imported\n"
    for process in running:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    for process in running:
        _, errors = process.communicate(timeout=60)
        assert (process.returncode, errors) == (0, "")
    with SampleStore(path) as store:
        rows = store.select()
        expected = {f"{unit}-{i}" for unit in range(60) for i in range(5)}
        assert sorted(row.key for row in rows) == sorted(expected)
        assert all(store.get_result(str(unit)) == {"n": 5} for unit in range(60))
    assert len({row.reason for row in rows}) > 1, "only one process wrote: nothing overlapped"
    by_unit = {(row.theta[0], row.reason) for row in rows}
    assert len(by_unit) == 60, "a unit holds rows of two writers: it was not one transaction"


def test_stores_created_at_the_same_moment_in_threads(tmp_path: Path) -> None:
    """Switching a new file to the write-ahead log does not wait for a lock by itself."""
    from concurrent.futures import ThreadPoolExecutor
    from threading import Barrier

    for attempt in range(20):
        path, barrier = tmp_path / f"{attempt}.sqlite", Barrier(4)

        def create(number: int, path: Path = path, barrier: Barrier = barrier) -> None:
            barrier.wait()
            with SampleStore(path) as store:
                store.put([sample(str(number))])

        with ThreadPoolExecutor(4) as pool:
            list(pool.map(create, range(4)))
        with SampleStore(path) as store:
            assert store.count() == 4


def test_a_kill_leaves_whole_units_only(tmp_path: Path) -> None:
    path, rng = tmp_path / "s.sqlite", random.Random(3)
    reported: set[int] = set()
    for attempt in range(3):
        process = writer(path, str(attempt), 0.001)
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "imported\n"
        process.stdin.write("\n")
        process.stdin.flush()
        reported.add(int(process.stdout.readline()))
        time.sleep(rng.uniform(0.0, 0.06))
        process.send_signal(signal.SIGKILL)
        rest, _ = process.communicate()
        reported.update(map(int, rest.split()))
        assert process.returncode == -signal.SIGKILL
        with SampleStore(path) as store:
            units = [row.theta[0] for row in store.select()]
            assert all(store.get_result(str(unit)) for unit in reported), "what was told is kept"
            found = [unit for unit in range(60) if store.get_result(str(unit))]
        assert {unit: units.count(unit) for unit in set(units)} == dict.fromkeys(found, 5)
    assert len(reported) >= 3
