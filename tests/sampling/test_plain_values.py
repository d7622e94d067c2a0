"""Dataclasses as JSON and back."""

import json
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path

import numpy as np
import pytest

from ccd_casadi.sampling.store import SampleStore, SampleStoreError
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.json_files import plain, restore


class Colour(Enum):
    RED = "a long word"


@dataclass(frozen=True)
class One:
    x: float


@dataclass(frozen=True)
class Other:
    x: float


@dataclass(frozen=True)
class Whole:
    array: Array
    empty: Array
    colour: Colour
    either: One | Other
    maybe: One | None
    pairs: tuple[tuple[str, float], ...]
    fixed: tuple[int, bool]
    named: dict[str, float]


def whole() -> Whole:
    array = np.asfortranarray([[0.1, np.nan], [np.inf, -0.0], [1e-310, 1 / 3]])
    pairs = (("a", float("nan")), ("b", np.float64(0.1)))
    return Whole(array, np.zeros((0, 3)), Colour.RED, Other(-np.inf), None, pairs, (2**60, True),
                 {"c": 0.1})  # fmt: skip


def test_every_bit_comes_back() -> None:
    given = whole()
    text = json.dumps(plain(given), allow_nan=False)
    found = restore(Whole, json.loads(text))
    for item in fields(Whole):
        here, there = getattr(given, item.name), getattr(found, item.name)
        assert repr(there) == repr(here).replace("np.float64(0.1)", "0.1"), item.name
    assert found.array.tobytes() == given.array.tobytes()
    assert found.array.flags.carray  # contiguous and writeable, as the kernels want it


def test_a_class_that_had_another_name_comes_back() -> None:
    """Only where a field may be of several classes does the stored name tell which."""
    data = {**plain(whole()), "maybe": {"": "OneOfBefore", "x": 2.0}}
    assert restore(Whole, data).maybe == One(2.0)


def test_what_is_damaged_is_reported(tmp_path: Path) -> None:
    wrong = [
        {**plain(whole()), name: value}
        for name, value in [
            ("array", [[2, 2], "AAAA"]), ("colour", "BLUE"), ("either", {"": "None"}),
            ("pairs", [["a"]]), ("fixed", [1.5, True]), ("named", [1.0]), ("array", None),
        ]
    ]  # fmt: skip
    for number, data in enumerate([*wrong, {}]):
        with SampleStore(tmp_path / "samples.sqlite") as store:
            store.put_unit([], (str(number), "owner", [0.0], data))
            with pytest.raises(SampleStoreError, match="a row is damaged"):
                store.recall(str(number), "owner", [0.0], Whole, whole)


def test_what_is_kept_is_made_once(tmp_path: Path) -> None:
    made = []

    def make() -> One:
        made.append(1)
        return One(0.1)

    for _ in range(2):
        with SampleStore(tmp_path / "samples.sqlite") as store:
            assert store.recall("key", "owner", [0.0], One, make) == One(0.1)
    assert len(made) == 1
