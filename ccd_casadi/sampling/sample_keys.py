"""Hashed keys of problems and samples: what determines a synthesis, exact in every float."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from numbers import Integral, Real

from ccd_casadi.inner_problem.problem import CoDesignProblem


def problem_hash(problem: Mapping[str, object]) -> str:
    """SHA-256 of a mapping, exact in every float; the order of its keys does not count.

    Parameters
    ----------
    problem : mapping
        Of plain values: text, numbers, lists and mappings.

    Returns
    -------
    str
        Hexadecimal.

    Raises
    ------
    ValueError
        A number is NaN or infinite.
    TypeError
        A value is not plain.

    Examples
    --------
    >>> problem_hash({"a": 1, "b": 0.1}) == problem_hash({"b": 0.1, "a": 1.0})
    True
    """
    text = json.dumps(_canonical(problem), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def hashes_of(problem: CoDesignProblem) -> tuple[str, str]:
    """Hashes of a problem.

    Parameters
    ----------
    problem : CoDesignProblem
        The problem.

    Returns
    -------
    designs, inner : str
        Of its single designs, and of its inner problems.
    """
    designs = problem_hash(problem.identity())
    return designs, problem_hash({"problem": designs, "inner": problem.inner_identity()})


def sample_key(
    problem: str, theta: Sequence[float], omega_S: float = 0.0, omega_T: float = 0.0
) -> str:
    """The key of one synthesis of a problem, or of what is known at a whole θ (both ω 0).

    Parameters
    ----------
    problem : str
        A hash.
    theta : sequence of float
        SI.
    omega_S, omega_T : float
        rad/s.

    Returns
    -------
    str
        Exact in every float.
    """
    return problem_hash({"problem": problem, "theta": list(theta), "omega": [omega_S, omega_T]})


def best_key(inner: str, theta: Sequence[float]) -> str:
    """The key of the best found at a θ from other controllers than the inner problem's own.

    Parameters
    ----------
    inner : str
        Hash of the inner problem.
    theta : sequence of float
        SI.

    Returns
    -------
    str
        Exact in every float.
    """
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
