"""The case file: TOML into frozen dataclasses, every mistake in one line that says the remedy.

Units are those of the file (Hz where a name says so); `problem_of` makes the SI problem of it.
"""

import difflib
import inspect
import math
import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

from ccd_casadi.errors import UserError
from ccd_casadi.inner import InnerProblem
from ccd_casadi.modal import Suspension
from ccd_casadi.models import MODELS
from ccd_casadi.problem import CoDesignProblem, PlantSource, plant_of
from ccd_casadi.weights import Weights

HZ = 2.0 * math.pi


class CaseError(UserError):
    """One line: file, key, what is wrong, what to do."""


Check = Callable[[Any], str | None]


def _number(low: float, high: float, remedy: str, *, closed: bool = False) -> Check:
    """Inside (low, high), or [low, high) if `closed`; `remedy` says what to give."""

    def check(value: Any) -> str | None:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return f"is {_shown(value)}, not a number; {remedy}"
        if _too_large(value) or not math.isfinite(value):
            return f"is {_shown(value)}; {remedy}"
        inside = low < value < high or (closed and value == low)
        return None if inside else f"is {value:g}; {remedy}"

    return check


def _count(least: int) -> Check:
    def check(value: Any) -> str | None:
        good = isinstance(value, int) and not isinstance(value, bool) and value >= least
        if good and not _too_large(value):
            return None
        return f"is {_shown(value)}; give a whole number of at least {least}"

    return check


def _choice(*names: str) -> Check:
    def check(value: Any) -> str | None:
        if value in names:
            return None
        return f"is {_shown(value)}; choose one of {', '.join(names)}"

    return check


def _text(value: Any) -> str | None:
    return None if isinstance(value, str) else f"is {_shown(value)}; give a text in quotes"


def _range(value: Any) -> str | None:
    remedy = "give two positive numbers [low, high] with low < high"
    if not isinstance(value, list | tuple) or len(value) != 2:
        return f"is {_shown(value)}; {remedy}"
    for item in value:
        if _POSITIVE(item) is not None:
            return f"is {_shown(value)}; {remedy}"
    return None if value[0] < value[1] else f"is an empty range {_shown(value)}; {remedy}"


def _points(value: Any) -> str | None:
    good = isinstance(value, list | tuple) and len(value) == 2
    if good and all(_count(2)(item) is None for item in value):
        return None
    return f"is {_shown(value)}; give two whole numbers of at least 2"


def _steps(value: Any) -> str | None:
    if isinstance(value, list | tuple) and value and all(_FRACTION(v) is None for v in value):
        return None
    return f"is {_shown(value)}; give a list of numbers between 0 and 1"


def _too_large(value: Any) -> bool:
    """TOML's integers have 64 bits; Python's parser takes any, and neither float nor repr do."""
    return isinstance(value, int) and abs(value) >= 2**63


def _shown(value: Any) -> str:
    if _too_large(value):
        return "an integer of more than 64 bits"
    try:
        text = repr(list(value) if isinstance(value, tuple) else value)
    except (ValueError, RecursionError):  # a huge integer or a very deep array inside
        return "a value too long to show"
    return text if len(text) < 60 else text[:57] + "..."


_ANY = _number(-math.inf, math.inf, "give a finite number")
_POSITIVE = _number(0.0, math.inf, "give a number above 0")
_FRACTION = _number(0.0, 1.0, "give a number between 0 and 1")
_ABOVE_ONE = _number(1.0, math.inf, "give a number above 1")


def _key(check: Check, default: Any = MISSING) -> Any:
    if default is MISSING:
        return field(metadata={"check": check})
    return field(default=default, metadata={"check": check})


@dataclass(frozen=True)
class PlantSection:
    """[plant]: a model's name or function = "file.py:name"; all other keys are its options."""

    model: str | None
    function: str | None
    options: Mapping[str, Any]


@dataclass(frozen=True)
class Parameter:
    """[theta.NAME]: bounds, start (default: the middle) and unit of one hardware parameter."""

    name: str
    lower: float
    upper: float
    start: float
    unit: str


@dataclass(frozen=True)
class ObjectiveSection:
    """[objective] J = w1 f(θ) + w2 ω_b, ω_b in rad/s."""

    w1: float = _key(_number(0.0, math.inf, "give 0 or more: J is minimised", closed=True))
    w2: float = _key(_number(-math.inf, 0.0, "give a negative number: J must reward bandwidth"))


@dataclass(frozen=True)
class WeightsSection:
    """[weights] of the paper's Table 1; M_K in force over displacement."""

    M_S: float = _key(_POSITIVE)
    A_S: float = _key(_FRACTION)
    c_K: float = _key(_ABOVE_ONE)
    omega_K_hz: float = _key(_POSITIVE)
    M_K: float = _key(_POSITIVE)
    A_l: float = _key(_POSITIVE)
    A_u: float = _key(_FRACTION)


@dataclass(frozen=True)
class InnerSection:
    """[inner]: constraints on S, the box of the weights' frequencies, and how it is searched."""

    S_max: float = _key(
        _number(1.0, math.inf, "give more than 1: a peak of S below 1 contradicts Bode's integral")
    )
    S_low: float = _key(_FRACTION)
    omega_low_hz: float = _key(_POSITIVE)
    omega_S_hz: tuple[float, float] = _key(_range)
    omega_T_hz: tuple[float, float] = _key(_range)
    gamma_backoff: float = _key(_ABOVE_ONE, 1.02)
    sweep_points: tuple[int, int] = _key(_points, (20, 20))
    method: str = _key(_choice("search", "sweep"), "search")


@dataclass(frozen=True)
class SuspensionSection:
    """[suspension]: where rigid-body poles are put."""

    frequency_hz: float = _key(_POSITIVE, 0.1)
    damping_ratio: float = _key(_POSITIVE, 0.7)


@dataclass(frozen=True)
class SamplingSection:
    """[sampling]: the offline design over θ; points per axis for grid, in all for the others.

    `lifted_points` designs of (θ, ω_S, ω_T) are sampled for the lifted formulation; 0 chooses.
    """

    design: str = _key(_choice("grid", "sobol", "lhs"), "grid")
    points: int = _key(_count(2), 5)
    lifted_points: int = _key(_count(0), 0)


@dataclass(frozen=True)
class OuterSection:
    """[outer]: IPOPT starts, agreement of prediction and truth, and rounds of refinement."""

    starts: int = _key(_count(1), 16)
    direct_starts: int = _key(_count(1), 4)
    tolerance: float = _key(_FRACTION, 1e-3)
    max_refinements: int = _key(_count(0), 12)


@dataclass(frozen=True)
class BaselineSection:
    """[baseline]: the sequential design's first resonance, and the descents' steps and starts.

    `steps` are the first steps tried, as shares of the box; `starts` start points: the case's own
    and a Latin hypercube.
    """

    first_resonance_hz: float = _key(_POSITIVE, 250.0)
    steps: tuple[float, ...] = _key(_steps, (0.02, 0.05, 0.1))
    starts: int = _key(_count(1), 3)
    max_iterations: int = _key(_count(1), 100)


@dataclass(frozen=True)
class Case:
    """A checked case file."""

    path: Path
    plant: PlantSection
    theta: tuple[Parameter, ...]
    objective: ObjectiveSection
    weights: WeightsSection
    inner: InnerSection
    suspension: SuspensionSection
    sampling: SamplingSection
    outer: OuterSection
    baseline: BaselineSection


# Which weight must lie below which: else it asks for nothing (W_S) or for the opposite (W_T).
_ORDERED_WEIGHTS = (
    ("A_S", "M_S", "W_S asks for more at low frequency"),
    ("A_u", "A_l", "W_T asks for a roll-off"),
)
# What the models of the package take, as far as a function's signature does not say it.
_MODEL_THETA: dict[str, tuple[str, ...]] = {"two_mass": ("m1", "m2")}
_MODEL_OPTIONS: dict[tuple[str | None, str], Check] = {("two_mass", "zeta"): _FRACTION}

_SECTIONS: dict[str, type] = {
    "objective": ObjectiveSection,
    "weights": WeightsSection,
    "inner": InnerSection,
    "suspension": SuspensionSection,
    "sampling": SamplingSection,
    "outer": OuterSection,
    "baseline": BaselineSection,
}


def load_case(path: str | Path) -> Case:
    """Read and check a case file. Raises CaseError on the first mistake."""
    path = Path(path)

    def fail(words: str) -> CaseError:
        return CaseError(_one_line(f"{path}: {words}"))

    try:
        text = path.read_bytes().decode("utf-8-sig")  # some editors write a byte-order mark
    except FileNotFoundError:
        raise fail("there is no such file; name a case file (TOML)") from None
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise fail(f"line {line} is not UTF-8 text; save the file as UTF-8") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise fail(f"cannot be read: {reason}; name a readable file") from None
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise fail(f"is not valid TOML: {error}; mend that line") from None
    except RecursionError:
        raise fail("is not valid TOML: nested too deeply; flatten its arrays") from None
    except ValueError:
        raise fail("holds an integer of thousands of digits; write it as a float") from None
    return parse_case(data, path)


def parse_case(data: Mapping[str, Any], path: Path) -> Case:
    """Check the tables of a case file. Raises CaseError on the first mistake."""

    def fail(key: str, words: str) -> CaseError:
        return CaseError(_one_line(f"{path}: {key}: {words}"))

    known = ("plant", "theta", *_SECTIONS)
    for name, table in data.items():
        if name not in known:
            raise fail(name, f"unknown section{_closest(name, known)}")
        if not isinstance(table, Mapping):
            raise fail(name, f"is {_shown(table)}; write a table [{name}]")
    for name in ("plant", "theta"):
        if name not in data:
            raise fail(name, f"is missing; add a table [{name}]")
    sections = {}
    for name, kind in _SECTIONS.items():
        required = any(item.default is MISSING for item in fields(kind))
        if required and name not in data:
            raise fail(name, f"is missing; add a table [{name}]")
        sections[name] = _section(kind, name, data.get(name, {}), fail)
    for low, high, why in _ORDERED_WEIGHTS:
        below, above = getattr(sections["weights"], low), getattr(sections["weights"], high)
        if not below < above:
            words = f"is {above:g}, not above {low} = {below:g}; give {high} > {low}, so that {why}"
            raise fail(f"weights.{high}", words)
    plant = _plant(data["plant"], path, fail)
    theta = _theta(data["theta"], fail)
    needed = _MODEL_THETA.get(plant.model or "")
    if needed is not None:
        for name in data["theta"]:
            if name not in needed:
                hint = _closest(name, needed)
                raise fail(f"theta.{name}", f"is no parameter of {plant.model}{hint}")
        for name in needed:
            if name not in data["theta"]:
                words = f"is missing; add a table [theta.{name}], which {plant.model} needs"
                raise fail(f"theta.{name}", words)
    return Case(path=path, plant=plant, theta=theta, **sections)


def _section(
    kind: type, name: str, table: Mapping[str, Any], fail: Callable[[str, str], CaseError]
) -> Any:
    allowed = {item.name: item for item in fields(kind)}
    for key in table:
        if key not in allowed:
            raise fail(f"{name}.{key}", f"unknown key{_closest(key, allowed)}")
    values = {}
    for key, item in allowed.items():
        if key not in table:
            if item.default is MISSING:
                raise fail(f"{name}.{key}", "is missing; add it")
            continue
        wrong = item.metadata["check"](table[key])
        if wrong is not None:
            raise fail(f"{name}.{key}", wrong)
        value = table[key]
        if isinstance(value, list):
            whole = item.type == tuple[int, int]
            value = tuple(v if whole else float(v) for v in value)
        elif item.type is float:
            value = float(value)
        values[key] = value
    return kind(**values)


def _plant(
    table: Mapping[str, Any], path: Path, fail: Callable[[str, str], CaseError]
) -> PlantSection:
    model, function = table.get("model"), table.get("function")
    if (model is None) == (function is None):
        raise fail("plant", "give either model or function, and not both")
    if model is not None and (not isinstance(model, str) or model not in MODELS):
        hint = _closest(str(model), MODELS)
        raise fail("plant.model", f"is {_shown(model)}, not a known model{hint}; or use function")
    if function is not None:
        parts = function.rsplit(":", 1) if isinstance(function, str) else []
        if len(parts) != 2 or not parts[0].endswith(".py") or not parts[1].isidentifier():
            raise fail("plant.function", f'is {_shown(function)}; write "my_plant.py:model"')
        try:
            exists = (path.parent / parts[0]).is_file()
        except (OSError, ValueError):
            exists = False
        if not exists:
            words = f"there is no file {_shown(parts[0])}; give its path relative to the case file"
            raise fail("plant.function", words)
        # Absolute, so that the resolved case means the same from the run folder.
        function = f"{(path.parent / parts[0]).resolve()}:{parts[1]}"
    options = {key: value for key, value in table.items() if key not in ("model", "function")}
    takes = None if model is None else list(inspect.signature(MODELS[model]).parameters)[1:]
    for key, value in options.items():
        if not key.isidentifier():
            raise fail(f"plant.{key}", "is no keyword; use a Python identifier")
        if takes is not None and key not in takes:
            raise fail(f"plant.{key}", f"is no option of {model}{_closest(key, takes)}")
        wrong = _MODEL_OPTIONS.get((model, key), _option)(value)
        if wrong is not None:
            raise fail(f"plant.{key}", wrong)
    return PlantSection(model, function, options)


def _option(value: Any) -> str | None:
    if isinstance(value, float) and not math.isfinite(value):
        return f"is {value}; give a finite number"
    if _too_large(value):
        return f"is {_shown(value)}; write it as a float"
    if isinstance(value, list):
        for item in value:
            wrong = _option(item)
            if wrong is not None:
                return wrong
        return None
    if isinstance(value, str | bool | int | float):
        return None
    return f"is {_shown(value)}; give a number, text, true or false, or a list of them"


def _theta(
    table: Mapping[str, Any], fail: Callable[[str, str], CaseError]
) -> tuple[Parameter, ...]:
    if not table:
        raise fail("theta", "names no parameter; add a table [theta.NAME]")
    checks = {"lower": _ANY, "upper": _ANY, "start": _ANY, "unit": _text}
    found = []
    for name, entry in table.items():
        place = f"theta.{name}"
        if not name.isidentifier():
            raise fail(place, "is no identifier; use letters, digits and _")
        if not isinstance(entry, Mapping):
            raise fail(place, f"is {_shown(entry)}; write a table [theta.{name}]")
        for key in entry:
            if key not in checks:
                raise fail(f"{place}.{key}", f"unknown key{_closest(key, checks)}")
        for key in ("lower", "upper"):
            if key not in entry:
                raise fail(f"{place}.{key}", "is missing; add it")
        for key, value in entry.items():
            wrong = checks[key](value)
            if wrong is not None:
                raise fail(f"{place}.{key}", wrong)
        lower, upper = float(entry["lower"]), float(entry["upper"])
        if lower > upper:
            raise fail(f"{place}.lower", f"{lower:g} is above upper = {upper:g}; swap them")
        if lower == upper or not math.isfinite(upper - lower):
            raise fail(f"{place}.lower", f"{lower:g} to {upper:g} is no range; widen it")
        start = float(entry.get("start", 0.5 * lower + 0.5 * upper))
        if not lower <= start <= upper:
            words = f"{start:g} is outside {lower:g} to {upper:g}; give a start within the bounds"
            raise fail(f"{place}.start", words)
        found.append(Parameter(name, lower, upper, start, entry.get("unit", "")))
    return tuple(found)


def _closest(name: str, known: Any) -> str:
    near = difflib.get_close_matches(name, list(known), 1)
    return f"; did you mean {near[0]}?" if near else f"; known are {', '.join(known)}"


def _one_line(value: object) -> str:
    """On one line, with what a terminal would obey (a key may hold it) written as escapes."""
    words = " ".join(str(value).split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in words)


def parse_theta(case: Case, text: str) -> tuple[float, ...]:
    """θ from `m1=60,m2=60`, in the case's order. Raises CaseError naming what is wrong."""

    def fail(words: str) -> CaseError:
        return CaseError(_one_line(f"{case.path}: --theta: {words}"))

    names = [parameter.name for parameter in case.theta]
    found: dict[str, float] = {}
    for part in text.split(","):
        name, equals, value = (item.strip() for item in part.partition("="))
        if not equals:
            raise fail(
                f"{_shown(part)} is not of the form name=value; give {'=..,'.join(names)}=.."
            )
        if name not in names:
            raise fail(f"{_shown(name)} is no parameter of the case{_closest(name, names)}")
        if name in found:
            raise fail(f"{name} is given twice; give it once")
        try:
            found[name] = float(value)
        except ValueError:
            raise fail(f"{name} = {_shown(value)} is not a number; give one") from None
    for parameter in case.theta:
        if parameter.name not in found:
            raise fail(f"{parameter.name} is missing; give all of {', '.join(names)}")
        number = found[parameter.name]
        if not parameter.lower <= number <= parameter.upper:
            bounds = f"{parameter.lower:g} to {parameter.upper:g}"
            raise fail(f"{parameter.name} = {number:g} is outside its bounds; give {bounds}")
    return tuple(found[name] for name in names)


def problem_of(case: Case) -> CoDesignProblem:
    """The case in SI, as the lower layers take it.

    The plant is traced once here. Raises CaseError where it cannot be.
    """
    inner, w = case.inner, case.weights
    file = function = None
    if case.plant.function is not None:
        name, function = case.plant.function.rsplit(":", 1)
        file = str((case.path.parent / name).resolve())
    options = tuple(sorted((key, _frozen(value)) for key, value in case.plant.options.items()))
    problem = CoDesignProblem(
        source=PlantSource(case.plant.model, file, function, options),
        names=tuple(p.name for p in case.theta),
        units=tuple(p.unit for p in case.theta),
        lower=tuple(p.lower for p in case.theta),
        upper=tuple(p.upper for p in case.theta),
        start=tuple(p.start for p in case.theta),
        w1=case.objective.w1,
        w2=case.objective.w2,
        weights=Weights(
            M_S=w.M_S,
            A_S=w.A_S,
            omega_S=HZ * inner.omega_S_hz[0],
            c_K=w.c_K,
            omega_K=HZ * w.omega_K_hz,
            M_K=w.M_K,
            A_l=w.A_l,
            A_u=w.A_u,
            omega_T=HZ * inner.omega_T_hz[0],
        ),
        inner=InnerProblem(
            S_max=inner.S_max,
            S_low=inner.S_low,
            omega_low=HZ * inner.omega_low_hz,
            omega_S=(HZ * inner.omega_S_hz[0], HZ * inner.omega_S_hz[1]),
            omega_T=(HZ * inner.omega_T_hz[0], HZ * inner.omega_T_hz[1]),
            gamma_backoff=inner.gamma_backoff,
            sweep_points=inner.sweep_points,
        ),
        suspension=Suspension(case.suspension.frequency_hz, case.suspension.damping_ratio),
        method=inner.method,
    )
    try:
        plant_of(problem)
    except UserError as error:
        raise CaseError(_one_line(f"{case.path}: plant: {error}")) from error
    except Exception as error:
        if function is None:
            raise
        words = f"{function} raised {type(error).__name__}: {error}; mend it"
        raise CaseError(_one_line(f"{case.path}: plant.function: {words}")) from error
    return problem


def _frozen(value: Any) -> Any:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def case_to_toml(case: Case) -> str:
    """The resolved case, defaults included, as TOML."""
    plant = {"model": case.plant.model} if case.plant.model else {"function": case.plant.function}
    lines = ["[plant]", *_pairs(plant | dict(case.plant.options))]
    for parameter in case.theta:
        entry = {key: value for key, value in vars(parameter).items() if key != "name"}
        lines += ["", f"[theta.{_toml_key(parameter.name)}]", *_pairs(entry)]
    for name in _SECTIONS:
        lines += ["", f"[{name}]", *_pairs(vars(getattr(case, name)))]
    return "\n".join(lines) + "\n"


def _pairs(table: Mapping[str, Any]) -> list[str]:
    return [f"{_toml_key(key)} = {_toml(value)}" for key, value in table.items()]


def _toml_key(key: str) -> str:
    return key if re.fullmatch("[A-Za-z0-9_-]+", key) else _toml(key)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        escaped = "".join(_escape(letter) for letter in value)
        return f'"{escaped}"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value)


def _escape(letter: str) -> str:
    if letter in '"\\':
        return "\\" + letter
    return letter if letter.isprintable() else f"\\U{ord(letter):08X}"
