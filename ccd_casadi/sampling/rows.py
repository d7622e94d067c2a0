"""One true synthesis as a row of the store, and back; what nobody can have written is an error.

Its key is a hash of what determines it, exact in every float.
"""

import hashlib
import json
import math
import sqlite3
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Integral, Real
from typing import Any

from ccd_casadi.inner_problem.problem import CoDesignProblem

DAMAGED = "a row is damaged"


@dataclass(frozen=True)
class Sample:
    """One synthesis, certified or not; SI, frequencies in rad/s, NaN where there is no figure.

    `gradients` are the flattened total derivatives (4, n_θ + 2) of (ω_b, ln‖S‖∞,
    ln σ_max(S(jω_low)), γ_opt) to (θ, ln ω_S, ln ω_T), where they were computed. With `compliance`
    (‖GS‖∞, m/N) its logarithm stands before γ_opt.
    """

    key: str
    theta: tuple[float, ...]
    omega_S: float
    omega_T: float
    outcome: str
    reason: str
    gamma_opt: float = math.nan
    gamma_lower_bound: float = math.nan
    gamma: float = math.nan
    bandwidth: float = math.nan
    sensitivity_peak: float = math.nan
    sensitivity_peak_frequency: float = math.nan
    sensitivity_low: float = math.nan
    max_real_pole: float = math.nan
    norm: float = math.nan
    norm_bound: float = math.nan
    certified: bool = False
    seconds: float = 0.0
    gradients: tuple[float, ...] | None = None
    compliance: float = math.nan


COLUMNS = tuple(field.name for field in fields(Sample))
_REALS = frozenset(f.name for f in fields(Sample) if f.type is float)
_TEXTS = frozenset(f.name for f in fields(Sample) if f.type is str)


def to_row(sample: Sample) -> tuple[object, ...]:
    """The values of COLUMNS as SQLite takes them: NaN as null, tuples as JSON."""
    row: list[object] = []
    for name in COLUMNS:
        value = getattr(sample, name)
        if name == "theta" or (name == "gradients" and value is not None):
            value = json.dumps([None if math.isnan(item) else item for item in value])
        elif name == "certified":
            value = int(value)
        elif isinstance(value, float) and math.isnan(value):
            value = None
        row.append(value)
    return tuple(row)


def from_row(row: Sequence[Any]) -> Sample:
    """Its inverse. Raises sqlite3.DatabaseError for a row that `to_row` cannot have made."""
    values: dict[str, Any] = dict(zip(COLUMNS, row, strict=True))
    values |= {name: math.nan for name in _REALS if values[name] is None}
    values["theta"] = numbers_of(decoded(values["theta"]))
    values["certified"] = bool(values["certified"])
    if values["gradients"] is not None:
        values["gradients"] = numbers_of(decoded(values["gradients"]))
    if not all(isinstance(values[name], str) for name in _TEXTS):
        raise sqlite3.DatabaseError(DAMAGED)
    numbers_of([values[name] for name in _REALS])
    return Sample(**values)


def numbers_of(items: Any) -> tuple[float, ...]:
    """A list of numbers (null: NaN) as it was stored. Raises sqlite3.DatabaseError for others."""
    if not isinstance(items, list) or not all(
        item is None or type(item) in (int, float) for item in items
    ):
        raise sqlite3.DatabaseError(DAMAGED)
    return tuple(math.nan if item is None else float(item) for item in items)


def decoded(text: Any) -> Any:
    """A value from its JSON. Raises sqlite3.DatabaseError for what is none."""
    try:
        return json.loads(text)
    except (ValueError, TypeError, RecursionError) as error:
        raise sqlite3.DatabaseError(DAMAGED) from error


def problem_hash(problem: Mapping[str, object]) -> str:
    """SHA-256 of a mapping of plain values; exact in every float, blind to the mapping's order.

    Raises ValueError for NaN and infinity, TypeError for what is no plain value.

    >>> problem_hash({"a": 1, "b": 0.1}) == problem_hash({"b": 0.1, "a": 1.0})
    True
    """
    text = json.dumps(_canonical(problem), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def hashes_of(problem: CoDesignProblem) -> tuple[str, str]:
    """Those of a problem's single designs, and of its inner problems."""
    designs = problem_hash(problem.identity())
    return designs, problem_hash({"problem": designs, "inner": problem.inner_identity()})


def sample_key(
    problem: str, theta: Sequence[float], omega_S: float = 0.0, omega_T: float = 0.0
) -> str:
    """The key of one synthesis of a problem, or of what is known at a whole θ (both ω 0), exact in
    every float."""
    return problem_hash({"problem": problem, "theta": list(theta), "omega": [omega_S, omega_T]})


def best_key(inner: str, theta: Sequence[float]) -> str:
    """That of the best found at a θ from other controllers than the inner problem's own."""
    return sample_key(problem_hash({"best": inner}), theta)


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
