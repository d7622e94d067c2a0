"""Rows of a store to test with, and when two of them are the same to the bit."""

import dataclasses
import math
from typing import Any

from ccd_casadi.sampling.store import Sample

REALS = [field.name for field in dataclasses.fields(Sample) if field.type is float]


def sample(key: str = "k", **changes: Any) -> Sample:
    values: dict[str, Any] = dict.fromkeys(REALS, 1.5)
    values |= {"key": key, "theta": (60.0, 55.5), "outcome": "certified", "reason": ""}
    return Sample(**(values | {"certified": True} | changes))


def bits(value: object) -> object:
    """Equal for equal bits only, apart from the sign and payload of a NaN."""
    if isinstance(value, float):
        return "nan" if math.isnan(value) else value.hex()
    return tuple(map(bits, value)) if isinstance(value, tuple) else value


def identical(a: Sample, b: Sample) -> bool:
    pairs = zip(dataclasses.astuple(a), dataclasses.astuple(b), strict=True)
    return all(bits(x) == bits(y) and type(x) is type(y) for x, y in pairs)
