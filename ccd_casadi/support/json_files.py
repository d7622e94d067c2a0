"""Plain values as JSON files, dataclasses back from them, and .mat files read without trust."""

import json
import math
from base64 import b64decode, b64encode
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from itertools import repeat
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
import scipy
from scipy.sparse import csc_array

from ccd_casadi.support.errors import MissingPackage, UserError, describe, require
from surrogates.files import write_whole


def hdf5_variables(path: Path) -> dict[str, Any]:
    """Read the variables of a MATLAB 7.3 file as arrays: structs of shape (1, 1) with named fields,
    one text, cells of objects, and sparse matrices as such.

    Raises UserError where h5py is not installed, or the file cannot be read.
    """
    h5py = require("h5py", "hdf5")
    try:
        with h5py.File(path, "r") as file:
            return {name: _value(file, file[name]) for name in file if not name.startswith("#")}
    except Exception as error:  # a damaged file fails anywhere inside the reader
        words = " ".join(describe(error).split())[:120]
        raise UserError(f"{path}: is not a readable MATLAB 7.3 file: {words}") from None


def _value(file: Any, item: Any) -> Any:
    if hasattr(item, "keys"):  # a group: a struct, or a sparse matrix
        if "MATLAB_sparse" in item.attrs:
            return _sparse(item)
        fields = {name: _value(file, item[name]) for name in item}
        made = np.empty((1, 1), [(name, object) for name in fields])
        for name, value in fields.items():
            made[name][0, 0] = value
        return made
    kind = item.attrs.get("MATLAB_class", b"")
    kind = kind.decode() if isinstance(kind, bytes) else str(kind)
    own = item[()]
    if item.attrs.get("MATLAB_empty", 0):
        return np.zeros(tuple(int(n) for n in np.ravel(own)))
    if kind == "char":
        return np.array(["".join(map(chr, np.ravel(own)))])
    if own.dtype == object:  # references: a cell, or an array of structs
        found = np.empty(own.shape, object)
        for place in np.ndindex(own.shape):
            found[place] = _value(file, file[own[place]])
        return found.T
    if own.dtype.names == ("real", "imag"):
        own = own["real"] + 1j * own["imag"]
    return np.asarray(own).T  # MATLAB's columns are HDF5's rows


def _sparse(item: Any) -> csc_array:
    starts = item["jc"][()]
    shape = int(item.attrs["MATLAB_sparse"]), len(starts) - 1
    if "data" not in item:
        return csc_array(shape)
    return csc_array((item["data"][()], item["ir"][()], starts), shape=shape)


def mat_variables(path: Path) -> dict[str, Any]:
    """Read the variables of a .mat file by name.

    Parameters
    ----------
    path : Path

    Returns
    -------
    dict of str to array

    Raises
    ------
    UserError
        The file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return dict(scipy.io.loadmat(stream))
    except FileNotFoundError:
        raise UserError(f"{path}: there is no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None
    except NotImplementedError:  # how SciPy refuses the HDF5 files of MATLAB 7.3
        try:
            return hdf5_variables(path)
        except MissingPackage as error:
            raise UserError(f"{path}: is a MATLAB 7.3 file: {error}; or write it with save(…, "
                            "'-v7')") from None  # fmt: skip
    except Exception as error:  # a damaged file fails anywhere inside the reader
        words = " ".join(str(error).split())[:120]
        raise UserError(f"{path}: is not a readable .mat file: {words}") from None


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically; NaN and infinity become null.

    Parameters
    ----------
    path : Path
    value
        As `json_values` takes it.
    """
    write_whole(path, f"{json_text(value)}\n")


def json_text(value: Any) -> str:
    """Write a value as the text of a JSON file.

    Parameters
    ----------
    value
        As `json_values` takes it.

    Returns
    -------
    str
    """
    return json.dumps(json_values(value), indent=2, allow_nan=False)


def json_values(value: Any) -> Any:
    """Convert a value to plain JSON values.

    Parameters
    ----------
    value
        Dataclasses become objects, tuples and arrays lists, NumPy scalars numbers; what is not
        finite becomes None.

    Returns
    -------
    dict, list, str, number or None
    """
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): json_values(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_values(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def plain(value: Any, listed: bool = False) -> Any:
    """Convert a value to JSON such that `restore` gives it back.

    Of a dataclass its name and fields, of an array (of float64) shape and bytes, of an enumeration
    the name, of NaN and infinity their words.

    Parameters
    ----------
    value
    listed : bool
        Of an array the numbers, to seven digits, None for those that are not finite.

    Returns
    -------
    dict, list, str, number or None

    Examples
    --------
    >>> plain((1.5, float("inf"), {"x": np.array([0.0])}))
    [1.5, 'inf', {'x': [[1], 'AAAAAAAAAAA=']}]
    >>> plain(np.array([1.0, 2.0 / 3.0, np.nan]), listed=True)
    [1.0, 0.6666667, None]
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, np.ndarray) and listed:
        return [_round(item) for item in value.tolist()]
    if isinstance(value, np.ndarray):
        return [list(value.shape), b64encode(value.astype("<f8").tobytes()).decode()]
    if isinstance(value, Enum):
        return value.name
    if is_dataclass(value):
        found = {item.name: plain(getattr(value, item.name), listed) for item in fields(value)}
        return {"": type(value).__name__, **found}
    if isinstance(value, Mapping):
        return {key: plain(item, listed) for key, item in value.items()}
    if isinstance(value, tuple):
        return [plain(item, listed) for item in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else repr(float(value))
    return value


def _round(item: Any, *, digits: int = 7) -> Any:
    if isinstance(item, list):
        return [_round(each, digits=digits) for each in item]
    if isinstance(item, float):
        return float(f"{item:.{digits}g}") if math.isfinite(item) else None
    return item


def restore(kind: Any, data: Any) -> Any:
    """Convert what `plain` has made back, by the type as it is annotated.

    Parameters
    ----------
    kind : type
        A field that is missing in a dataclass has its default.
    data
        JSON values.

    Returns
    -------
    value of `kind`

    Raises
    ------
    KeyError, TypeError, ValueError
        `plain` cannot have written `data`.

    Examples
    --------
    >>> restore(tuple[float, ...], [1.5, "inf"])
    (1.5, inf)
    """
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any or origin is Literal:
        return data
    if np.ndarray in (kind, origin) and not (len(data) == 2 and isinstance(data[1], str)):
        return np.array(data, float if origin else None)
    if origin is np.ndarray:
        return np.frombuffer(b64decode(data[1]), "<f8").astype(float).reshape(data[0])
    if origin in (Union, UnionType):
        named = {cast(Any, item).__name__: item for item in args if is_dataclass(item)}
        if data is None and NoneType in args:
            return None
        alone = len(named) < 2  # then its name is not looked at: it may have had another
        one = next(item for item in args if item is not NoneType) if alone else named[data[""]]
        return restore(one, data)
    if origin is tuple:
        endless = args[1:] == (...,)
        kinds = repeat(args[0], len(data)) if endless else args
        return tuple(restore(*item) for item in zip(kinds, data, strict=True))
    if origin in (dict, Mapping):
        return {str(key): restore(args[1], item) for key, item in dict(data).items()}
    if is_dataclass(kind):
        hints, build = get_type_hints(kind), cast(Any, kind)
        there = [f for f in fields(kind) if f.name in data or f.default is MISSING]
        return build(**{f.name: restore(hints[f.name], data[f.name]) for f in there})
    if issubclass(kind, Enum):
        return kind[data]
    if kind is float:
        return float(data)
    if type(data) is not kind:
        raise TypeError(f"{data!r} is not a {kind.__name__}")
    return data
