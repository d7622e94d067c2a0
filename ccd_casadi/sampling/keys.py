"""Keys of samples: a hash of what determines them, exact in every float."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from numbers import Integral, Real


def problem_hash(problem: Mapping[str, object]) -> str:
    """SHA-256 of a mapping of plain values; exact in every float, blind to the mapping's order.

    Raises ValueError for NaN and infinity, TypeError for what is no plain value.

    >>> problem_hash({"a": 1, "b": 0.1}) == problem_hash({"b": 0.1, "a": 1.0})
    True
    """
    text = json.dumps(_canonical(problem), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def sample_key(problem: str, theta: Sequence[float], omega_S: float, omega_T: float) -> str:
    """The key of one synthesis of a problem, exact in every float."""
    return problem_hash({"problem": problem, "theta": list(theta), "omega": [omega_S, omega_T]})


def _canonical(value: object) -> object:
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise TypeError("a name that is not text cannot be part of a key")
        return {key: _canonical(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return f"'{value}"  # the mark keeps a text apart from the number that it spells
    if isinstance(value, Integral) and abs(int(value)) > 2**53:
        return str(int(value))  # no float is exact
    if isinstance(value, Integral | Real):
        number = float(value) + 0.0  # -0.0 becomes 0.0
        if not math.isfinite(number):
            raise ValueError(f"{number} cannot be part of a key; give finite numbers")
        return number.hex()
    raise TypeError(f"{type(value).__name__} cannot be part of a key")
