"""Surrogates as JSON files: readable, exact to the bit, and no code inside.

    {"schema": "surrogates/2", "surrogates": [{"kind": ..., ...}], "extra": {...}}

Python writes the shortest decimal that reads back as the same double, so arrays as
nested lists lose nothing. The Cholesky factor is not stored but recomputed. Schema 1,
of processes without noise of their own samples, is read as well.
"""

import json
import os
import typing
from collections.abc import Sequence
from dataclasses import MISSING, asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surrogates.files import write_whole
from surrogates.gaussian_process import GaussianProcess

SCHEMA = "surrogates/2"
READABLE = (SCHEMA, "surrogates/1")
KIND = "gaussian_process"


class SurrogateFileError(ValueError):
    """The file is not a readable surrogate file of a schema this package knows."""


def save(
    surrogates: GaussianProcess | Sequence[GaussianProcess],
    path: str | os.PathLike[str],
    extra: dict[str, Any] | None = None,
) -> None:
    """Write surrogates to a JSON file, replacing it in one step or not at all.

    Parameters
    ----------
    surrogates : GaussianProcess or sequence
        What to write.
    path : path
        The file.
    extra : dict, optional
        Anything that JSON holds, stored alongside: origin of the samples, units, names.

    Raises
    ------
    TypeError, ValueError
        `extra` is not JSON; a number is not finite.
    """
    members = list(surrogates) if isinstance(surrogates, Sequence) else [surrogates]
    records = [{"kind": KIND, **asdict(member)} for member in members]
    document = {"schema": SCHEMA, "surrogates": records, "extra": extra or {}}
    write_whole(Path(path), json.dumps(document, default=np.ndarray.tolist, allow_nan=False))


def load(path: str | os.PathLike[str]) -> tuple[tuple[GaussianProcess, ...], dict[str, Any]]:
    """Read a file written by `save`.

    Parameters
    ----------
    path : path
        The file.

    Returns
    -------
    tuple of GaussianProcess, dict

    Raises
    ------
    SurrogateFileError
        The file is truncated, foreign, of another schema, or its arrays contradict each other.
    OSError
        The file cannot be read.
    """
    try:
        document = json.loads(Path(path).read_bytes(), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:  # covers JSON, UTF-8 and the refused constants
        raise SurrogateFileError(f"{path}: not a complete JSON file ({error})") from error
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema not in READABLE:
        raise SurrogateFileError(f"{path}: expected schema {SCHEMA!r}, found {schema!r:.60}")
    try:
        members = []
        for record in document["surrogates"]:
            body = dict(record)
            if (kind := body.pop("kind")) != KIND:
                raise ValueError(f"kind {kind!r:.60} is not {KIND}; fit it again")
            members.append(_decode(GaussianProcess, body))
        extra = document["extra"]
        if not isinstance(extra, dict):
            raise TypeError("extra is not an object")
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise SurrogateFileError(f"{path}: damaged record ({error!r:.300})") from error
    return tuple(members), extra


def _decode(cls: Any, value: Any) -> Any:
    if is_dataclass(cls):
        hints = typing.get_type_hints(cls)
        names = {f.name for f in fields(cls)}
        needed = {f.name for f in fields(cls) if f.default is f.default_factory is MISSING}
        if not needed <= set(value) <= names:
            raise ValueError(f"fields differ by {sorted(names ^ set(value))}")
        return typing.cast(Any, cls)(**{k: _decode(hints[k], value[k]) for k in sorted(value)})
    if typing.get_origin(cls) is np.ndarray:
        array = np.array(value, dtype=float)
        if not np.isfinite(array).all():  # null and 1e999 come in as nan and inf
            raise ValueError("an array holds what is not a finite number")
        return array
    if cls is float and (type(value) not in (int, float) or not np.isfinite(value)):
        raise ValueError(f"expected a finite number, found {value!r}")
    return cls(value)


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not a number")
