"""Linear systems as MATLAB's files hold them, and whether their matrices are of discrete time."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.table_columns import SI as UNITS_OF_SI
from ccd_casadi.plants.table_columns import (
    compliance_of,
    means_a_change,
    of_response,
    one_text,
    texts_of,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class TimeBaseOptions:
    """Numbers by which a discrete A is known from its eigenvalues."""

    outside: float = 1e-3  # what |λ| may exceed 1 by: rounding, and slow unstable poles
    near: float = 0.8  # |λ| from which an eigenvalue lies near the unit circle
    share: float = 0.5  # of all eigenvalues: more are near the circle with a positive real part
    least: int = 2  # states: one eigenvalue alone shows nothing


HINT = "the matrices appear discrete: all eigenvalues within the unit circle, most of them near 1"


def appears_discrete(A: Array, options: TimeBaseOptions = TimeBaseOptions()) -> bool:
    """Report whether A is likely one of discrete time.

    e^(pT) of a plant that is sampled fast enough lies near 1. The same numbers as poles in 1/s
    would be unstable nearly all, and all slower than 1 rad/s.

    Parameters
    ----------
    A : (n, n) array
    options : TimeBaseOptions

    Returns
    -------
    bool

    Examples
    --------
    >>> appears_discrete(np.array([[1.0, 0.001], [0.0, 0.99]]))
    True
    >>> appears_discrete(np.array([[0.0, 1.0], [-1.0, -0.1]]))
    False
    """
    if len(A) < options.least:
        return False
    roots = np.linalg.eigvals(A)
    size = np.abs(roots)
    usual = (size >= options.near) & (roots.real > 0.0)
    return bool(size.max() <= 1.0 + options.outside and usual.mean() > options.share)


PARTS = ("A", "B", "C", "D")
OF_NAMES = {"name", "notes", "userdata", "statename", "stateunit", "statepath", "inputname",
            "inputunit", "inputgroup", "outputname", "outputunit", "outputgroup", "samplinggrid",
            "scaled", "theta", "theta_names", "theta_units"}  # fmt: skip
SI = ("", "m", "rad", "N", "Nm", "V", "A")  # units of signals, without what joins factors
QUANTITIES = (("Nm", "newton metres"), ("N", "newtons"), ("rad", "radians"), ("deg", "radians"),
              ("°", "radians"), ("m", "metres"))  # fmt: skip
DELAYS = ("InputDelay", "OutputDelay", "IODelay")
SECONDS = {"nanoseconds": 1e-9, "microseconds": 1e-6, "milliseconds": 1e-3, "seconds": 1.0,
           "minutes": 60.0, "hours": 3600.0, "days": 86400.0}  # fmt: skip


@dataclass(frozen=True)
class MatlabSystem:
    """A state space in s, the delay in s before it, and what was understood."""

    system: StateSpace
    delay: float
    words: str


def systems_in(path: Path, content: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The fields of each struct with an A; a file that has A, B and C themselves is one, without a
    name. Raises UserError for a variable beside them that may be part of the plant."""
    structs = {
        name: value
        for name, value in content.items()
        if isinstance(value, np.ndarray) and {"A", "a"} & set(value.dtype.names or ())
    }
    others = {name: value for name, value in content.items()
              if name not in structs and not name.startswith("__")}  # fmt: skip
    units = {name: value for name, value in others.items() if _is_unit(name)}
    if bare(content):
        size = np.shape(others["A" if "A" in others else "a"])
        drawn = {
            name: value
            for name, value in others.items()
            if name.casefold() in FIELDS
            or name in units
            or means_a_change(name)
            or (_numbers(value) and np.shape(value) in (size, (1, 1)))
        }
        yield "", drawn
    else:
        for name, value in others.items():
            known = name.casefold() in OF_NAMES - {"inputunit", "outputunit"} or name in units
            changes = name.casefold() in FIELDS - {"a", "b", "c", "d"} or means_a_change(name)
            if changes and not known and not _nothing(value):
                raise UserError(
                    f"{path}: {name}: belongs to no system; make it a field of its struct"
                )
    for name, struct in structs.items():
        if struct.size != 1:
            raise UserError(f"{path}: {name}: is an array of structs; save one struct")
        fields = {key: struct.ravel()[0][key] for key in struct.dtype.names or ()}
        yield name, fields if any(map(_is_unit, fields)) else units | fields


def bare(content: Mapping[str, Any]) -> bool:
    """Report whether the variables of a file are those of a system.

    Parameters
    ----------
    content : mapping
        Variables by name.

    Returns
    -------
    bool
    """
    return {"A", "B", "C"} <= content.keys() or {"a", "b", "c"} <= content.keys()


def _is_unit(name: str) -> bool:
    """Whether it is a unit that is no field of MATLAB's."""
    return name.casefold() not in FIELDS and of_response(name) is not None


FIELDS = {"a", "b", "c", "d", "e", "ts", "timeunit", "internaldelay",
          *(name.casefold() for name in DELAYS)} | OF_NAMES  # fmt: skip


def system_of(path: Path, name: str, given: Mapping[str, Any]) -> MatlabSystem:
    """The system of these fields. Raises UserError naming the one that is not understood."""
    place = f"{path}: {name}" if name else f"{path}"
    fields: dict[str, Any] = {}
    names: dict[str, str] = {}
    for key, value in given.items():
        if key.casefold() in fields:
            raise UserError(f"{place}: has {names[key.casefold()]} and {key}; keep one")
        fields[key.casefold()], names[key.casefold()] = value, key
    scale, many = 1.0, list[str]()
    for key in fields.keys() - FIELDS:
        if not _is_unit(key) or _nothing(fields[key]):
            continue
        where, texts = f"{name}.{names[key]}".lstrip("."), texts_of(fields[key])
        if not texts:
            raise UserError(f"{path}: {where}: is no text; give the unit, as um/N")
        text = one_text(path, where, texts)
        if not of_response(key):
            if text.casefold() not in {*UNITS_OF_SI, "s", "seconds"}:
                words = f"is {text!r} and is not understood; give the unit of the plant as unit"
                raise UserError(f"{path}: {where}: {words}")
            continue
        own = compliance_of(path, where, text)
        if many and own != scale:
            raise UserError(f"{path}: {where}: is {text!r} and another unit is stated; keep one")
        scale = own
        many.append(f"in {text}")
    if scale != 1.0:
        for key in ("inputunit", "outputunit"):
            if not _nothing(fields.get(key)):
                words = f"is there beside {many[-1].removeprefix('in ')}; keep one"
                raise UserError(f"{path}: {f'{name}.{names[key]}'.lstrip('.')}: {words}")
    for key in fields.keys() - FIELDS:
        if not _is_unit(key) and not _nothing(fields[key]):
            where = f"{name}.{names[key]}".lstrip(".")
            words = "may change the plant and is not understood; drop it, or apply it to A, B, C, D"
            raise UserError(f"{path}: {where}: {words}")
    missing = [part for part in PARTS[:3] if part.casefold() not in fields]
    if missing or (name and "d" not in fields):
        raise UserError(f"{place}: has no {(missing or ['D'])[0]}")
    reader = _Fields(path, name, fields)
    A, B, C = (reader.matrix(part) for part in PARTS[:3])
    D = reader.matrix("D") if "d" in fields else np.zeros((0, 0))
    D = np.zeros((len(C), B.shape[1])) if not D.size else D
    n, p, m = len(A), *D.shape
    if A.shape != (n, n) or B.shape != (n, m) or C.shape != (p, n):
        sizes = ", ".join(str(part.shape) for part in (A, B, C, D))
        raise UserError(f"{place}: the sizes of A, B, C, D do not fit: {sizes}")
    size = f"{n} state{'s' * (n != 1)}, {m} input{'s' * (m != 1)}, {p} output{'s' * (p != 1)}"
    many = [size, *many]
    if np.size(fields.get("e", ())):
        E = reader.matrix("E")
        # from this condition on the equations of E are algebraic
        if E.shape != (n, n) or not np.linalg.cond(E) < 1e12:
            raise reader.fail("E", "is not regular: the system has algebraic equations; reduce it")
        if (np.eye(n) != E).any():
            A, B = (np.asarray(np.linalg.solve(E, part), float) for part in (A, B))
            many.append("E is inverted")
    reader.require_si()
    unit, word = reader.time_unit()
    Ts = unit * reader.number("Ts")
    if word != "seconds":
        many.append(f"its times are {word}")
    if Ts < 0.0:
        raise reader.fail("Ts", "is not a sampling period in s, or 0")
    many.append(f"sampled at {1.0 / Ts:.6g} Hz" if Ts else "continuous")
    if not Ts and appears_discrete(A):
        if fields.get("ts") is None:
            raise reader.fail("Ts", f"is missing, and {HINT}; give Ts in s, or convert with d2c")
        many.append(f"but {HINT}")
    if reader.given("InternalDelay"):
        raise reader.fail("InternalDelay", "is in the plant; approximate it (pade), or give lines")
    delay = reader.delay((p, m), Ts or unit, bool(Ts))
    if delay:
        many.append(f"a delay of {delay:.6g} s")
    step = 1.0 if Ts else unit
    found = StateSpace(A / step, B / step, scale * C, scale * D, period=Ts)
    return MatlabSystem(found, delay, ", ".join(many))


@dataclass(frozen=True)
class _Fields:
    """The fields of a struct by their names in lower case."""

    path: Path
    name: str
    fields: Mapping[str, Any]

    def fail(self, key: str, words: str) -> UserError:
        return UserError(f"{self.path}: {f'{self.name}.{key}'.lstrip('.')}: {words}")

    def given(self, key: str) -> bool:
        return not _nothing(self.fields.get(key.casefold()))

    def matrix(self, key: str) -> Array:
        value = self.fields[key.casefold()]
        found = np.asarray(value.toarray() if scipy.sparse.issparse(value) else value)
        if found.ndim != 2 or found.dtype.kind not in "fiu" or not np.isfinite(found).all():
            raise self.fail(key, "is not a finite real matrix")
        return np.ascontiguousarray(found, dtype=float)

    def number(self, key: str) -> float:
        if not self.given(key):
            return 0.0
        found = self.matrix(key)
        if found.size != 1:
            raise self.fail(key, "is not one number")
        return float(found[0, 0])

    def require_si(self) -> None:
        """Raise where the unit of an input or output is another than that of SI."""
        other = {"Input": "newtons or newton metres", "Output": "metres or radians"}
        for side, usual in other.items():
            key = f"{side}Unit"
            for unit in strings(self.fields.get(key.casefold())) if self.given(key) else ():
                joined = "".join(unit.split()).translate(dict.fromkeys(map(ord, "*.·⋅")))
                if joined not in SI:
                    ends = (words for end, words in QUANTITIES if joined.endswith(end))
                    words = f"give the {side.lower()}s in {next(ends, usual)}"
                    raise self.fail(key, f"is {unit.strip()}: {words}, and scale the matrices")

    def time_unit(self) -> tuple[float, str]:
        """Seconds in its unit of time, and that."""
        words = strings(self.fields.get("timeunit"))
        word = words[0] if words and words[0] else "seconds"
        if word not in SECONDS:
            raise self.fail("TimeUnit", f"{word!r} is not one of {', '.join(SECONDS)}")
        return SECONDS[word], word

    def delay(self, shape: tuple[int, int], unit: float, sampled: bool) -> float:
        """The one delay of every channel, in s."""
        total, of = np.zeros(shape), []
        for key, own in zip(DELAYS, ((1, shape[1]), (shape[0], 1), shape), strict=True):
            if not self.given(key):
                continue
            value = self.matrix(key)
            if value.size not in (1, own[0] * own[1]) or (value < 0.0).any():
                raise self.fail(key, f"is not one delay, 0 or more, for each of {own}")
            if sampled and (value != np.round(value)).any():
                raise self.fail(key, "of a sampled system counts samples; give whole ones")
            total = total + (value if value.size == 1 or value.shape == own else value.reshape(own))
            of.append(key)
        if of and np.ptp(total) > 1e-9 * total.max():
            raise self.fail(of[-1], "differs between channels; give each path the same, or lines")
        return unit * float(total.flat[0]) if of else 0.0


def strings(value: Any) -> tuple[str, ...]:
    """The texts of a cell array, or of one text."""
    if value is None or scipy.sparse.issparse(value):
        return ()
    parts = map(np.ravel, np.asarray(value).ravel())
    return tuple(str(part[0]) if part.size else "" for part in parts)


def _numbers(value: Any) -> bool:
    return scipy.sparse.issparse(value) or getattr(value, "dtype", np.dtype("U1")).kind in "fiucb"


def _nothing(value: Any) -> bool:
    """Whether a field is absent, empty or zero."""
    if value is None:
        return True
    if scipy.sparse.issparse(value):
        return bool(value.nnz == 0)
    found = np.asarray(value)
    if found.dtype.names:
        return all(_nothing(found.ravel()[i][key])
                   for i in range(found.size) for key in found.dtype.names)  # fmt: skip
    if found.dtype.kind == "O":
        return all(map(_nothing, found.ravel()))
    return not found.size or (not (found != 0).any() if found.dtype.kind in "fiucb"
                              else not any(map(str, found.ravel())))  # fmt: skip
