"""Dataclasses as plain JSON values and back, exact in every bit of a number."""

from base64 import b64decode, b64encode
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from itertools import repeat
from math import isfinite
from types import UnionType
from typing import Any, Union, cast, get_args, get_origin, get_type_hints

import numpy as np


def plain(value: Any) -> Any:
    """What JSON holds of a value: of a dataclass its name and fields, of an array (of float64)
    shape and bytes, of an enumeration the name, of NaN and infinity their words.

    >>> plain((1.5, float("inf"), {"x": np.array([0.0])}))
    [1.5, 'inf', {'x': [[1], 'AAAAAAAAAAA=']}]
    """
    if isinstance(value, np.ndarray):
        return [list(value.shape), b64encode(value.astype("<f8").tobytes()).decode()]
    if isinstance(value, Enum):
        return value.name
    if is_dataclass(value):
        found = {item.name: plain(getattr(value, item.name)) for item in fields(value)}
        return {"": type(value).__name__, **found}
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return float(value) if isfinite(value) else repr(float(value))
    return value


def restored(kind: Any, data: Any) -> Any:
    """Its inverse for a type as it is annotated. Raises KeyError, TypeError or ValueError where
    `plain` cannot have written that.

    >>> restored(tuple[float, ...], [1.5, "inf"])
    (1.5, inf)
    """
    origin, args = get_origin(kind), get_args(kind)
    if origin is np.ndarray:
        return np.frombuffer(b64decode(data[1]), "<f8").astype(float).reshape(data[0])
    if origin in (Union, UnionType):
        named = {item.__name__: item for item in args}
        return None if data is None else restored(named[data[""]], data)
    if origin is tuple:
        endless = args[1:] == (...,)
        kinds = repeat(args[0], len(data)) if endless else args
        return tuple(restored(*item) for item in zip(kinds, data, strict=True))
    if origin is dict:
        return {str(key): restored(args[1], item) for key, item in dict(data).items()}
    if is_dataclass(kind):
        hints, build = get_type_hints(kind), cast(Any, kind)
        return build(**{f.name: restored(hints[f.name], data[f.name]) for f in fields(kind)})
    if issubclass(kind, Enum):
        return kind[data]
    if kind is float:
        return float(data)
    if type(data) is not kind:
        raise TypeError(f"{data!r} is not a {kind.__name__}")
    return data
