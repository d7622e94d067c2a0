"""The case file: TOML into frozen dataclasses, every mistake in one line that says the remedy.

`problem_of` makes of it the problem in SI that the lower layers take.
"""

import difflib
import inspect
import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

from ccd_casadi.cases.budget import checked_budget, error_budget
from ccd_casadi.cases.checks import (
    ANY,
    FRACTION,
    POSITIVE,
    Check,
    choice,
    count,
    flag,
    names,
    number,
    rows,
    shown,
    text,
    too_large,
)
from ccd_casadi.cases.diagnosis import Severity, diagnose
from ccd_casadi.cases.kinds import (
    check_kind,
    disturbance_of,
    read_options,
    require_channels,
    sections_problem,
    weights_of,
)
from ccd_casadi.cases.sections import (
    SECTIONS,
    Case,
    ChannelSection,
    Parameter,
    PlantSection,
    RobustSection,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, PlantSource, RobustSet, plant_of
from ccd_casadi.inner_problem.sections_bandwidth import with_options
from ccd_casadi.inner_problem.sweep import InnerProblem
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.plants.registry import BUILDERS, DATA, MODELS, SHIPPED
from ccd_casadi.plants.rib_stage import NAMES
from ccd_casadi.plants.rib_stage.model import OUTPUTS
from ccd_casadi.plants.rib_stage.plant import MESHES
from ccd_casadi.support.errors import PlantError, UserError, described, one_line
from ccd_casadi.support.units import HZ

DEFAULT_CASE = "runs/two_mass.toml"  # what commands read where no case is named
EXAMPLE = "python -m ccd_casadi.solve my_case.toml (docs/tutorial.md writes one)"


class CaseError(UserError):
    """One line: file, key, what is wrong, what to do."""


# Which weight must lie below which: else it asks for nothing (W_S) or for the opposite (W_T).
_ORDERED_WEIGHTS = (
    ("A_S", "M_S", "W_S asks for more at low frequency"),
    ("A_u", "A_l", "W_T asks for a roll-off"),
)
# What the models of the package take, as far as a function's signature does not say it.
_MODEL_THETA: dict[str, tuple[str, ...]] = {"two_mass": ("m1", "m2"), "rib_stage": NAMES}
_MODEL_OPTIONS: dict[tuple[str | None, str], Check] = {
    ("two_mass", "zeta"): FRACTION,
    ("rib_stage", "zeta"): FRACTION,
    ("rib_stage", "outputs"): choice(*OUTPUTS),
    ("rib_stage", "mesh"): choice(*MESHES),
    ("rib_stage", "side"): POSITIVE,
    ("rib_stage", "young"): POSITIVE,
    ("rib_stage", "poisson"): number(0.0, 0.5, "give a number between 0 and 0.5"),
    ("rib_stage", "density"): POSITIVE,
    ("rib_stage", "least_bay"): POSITIVE,
    ("rib_stage", "actuators"): rows(2),
    ("rib_stage", "sensors"): rows(2),
    ("rib_stage", "point_masses"): rows(3),
    ("modal_table", "table"): text,
    ("modal_table", "rigid_below_hz"): POSITIVE,
    ("sampled_matrices", "folder"): text,
    ("sampled_matrices", "modes"): count(1),
    ("sampled_matrices", "static_correction"): flag,
    ("sampled_matrices", "rigid_below_hz"): POSITIVE,
    ("cad_stage", "morph"): text,
    ("cad_stage", "forces"): names,
    ("cad_stage", "sensors"): names,
    ("cad_stage", "rigid"): names,
    ("cad_stage", "held"): names,
    ("cad_stage", "modes"): count(1),
    ("cad_stage", "zeta"): FRACTION,
    ("cad_stage", "young"): POSITIVE,
    ("cad_stage", "poisson"): number(0.0, 0.5, "give a number between 0 and 0.5"),
    ("cad_stage", "density"): POSITIVE,
}
_KNOWN_MODELS: dict[str, Callable[..., Any]] = {**MODELS, **BUILDERS}


def load_case(path: str | Path) -> Case:
    """Read and check a case file. Raises CaseError on the first mistake.

    >>> load_case("runs/two_mass.toml").theta[0]
    Parameter(name='m1', lower=55.0, upper=70.0, start=67.56, unit='kg')
    """
    path = Path(path)
    return parse_case(read_toml(path), path)


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a case file, unchecked. Raises CaseError where it is no TOML."""

    def fail(words: str) -> CaseError:
        return CaseError(one_line(f"{path}: {words}"))

    try:
        text = path.read_bytes().decode("utf-8-sig")  # some editors write a byte-order mark
    except FileNotFoundError:
        words = "there is no such file; name a case file (TOML)"
        if str(path) == DEFAULT_CASE:
            words = (
                f"there is no such file: it is the default in a clone of the project, and none was "
                f"named; name a case file of your own: {EXAMPLE}"
            )
        raise fail(words) from None
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise fail(f"line {line} is not UTF-8 text; save the file as UTF-8") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise fail(f"cannot be read: {reason}; name a readable file") from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise fail(f"is not valid TOML: {error}; mend that line") from None
    except RecursionError:
        raise fail("is not valid TOML: nested too deeply; flatten its arrays") from None
    except ValueError:
        raise fail("holds an integer of thousands of digits; write it as a float") from None


def parse_case(data: Mapping[str, Any], path: Path = Path("case")) -> Case:
    """The tables of a case file, as TOML reads them, checked; files in them are relative to `path`.

    Raises CaseError on the first mistake.

    >>> parse_case({"plant": {"model": "two_mas"}, "theta": {}})
    Traceback (most recent call last):
    ccd_casadi.cases.case.CaseError: case: objective: is missing; add a table [objective]
    """

    def fail(key: str, words: str) -> CaseError:
        return CaseError(one_line(f"{path}: {key}: {words}"))

    known = ("plant", "theta", *SECTIONS)
    for name, table in data.items():
        if name not in known:
            raise fail(name, f"unknown section{_closest(name, known)}")
        if not isinstance(table, Mapping):
            raise fail(name, f"is {shown(table)}; write a table [{name}]")
    for name in ("plant", "theta"):
        if name not in data:
            raise fail(name, f"is missing; add a table [{name}]")
    sections = {}
    for name, kind in SECTIONS.items():
        required = any(item.default is MISSING for item in fields(kind))
        if required and name not in data:
            raise fail(name, f"is missing; add a table [{name}]")
        sections[name] = section_of(kind, name, data.get(name, {}), fail)
    controller = sections["controller"]
    if controller.channel:
        own = data["controller"]["channel"]
        channel = tuple(
            (key, section_of(ChannelSection, f"controller.channel.{key}", own[key], fail))
            for key in own
        )
        sections["controller"] = replace(controller, channel=channel)
    for low, high, why in _ORDERED_WEIGHTS:
        below, above = getattr(sections["weights"], low), getattr(sections["weights"], high)
        if not below < above:
            words = f"is {above:g}, not above {low} = {below:g}; give {high} > {low}, so that {why}"
            raise fail(f"weights.{high}", words)
    check_kind(sections, fail)
    sections["budget"] = checked_budget(sections["budget"], path.parent, fail)
    plant = _plant(data["plant"], path, fail)
    files = sections["robust"].plants
    absolute = tuple(str((path.parent / file).resolve()) for file in files)
    for file, place in zip(files, absolute, strict=True):
        _plant(dict(data["plant"]) | _options_in(file, place, fail), path, fail)
    sections["robust"] = replace(sections["robust"], plants=absolute)
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


def section_of(
    kind: type, name: str, table: Mapping[str, Any], fail: Callable[[str, str], CaseError]
) -> Any:
    """A table as its dataclass, every key checked."""
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
            kept = item.type in (tuple[int, int], tuple[str, ...], tuple[Mapping[str, Any], ...])
            value = tuple(v if kept else float(v) for v in value)
        elif item.type in (float, float | None):
            value = float(value)
        values[key] = value
    return kind(**values)


def _plant(
    table: Mapping[str, Any], path: Path, fail: Callable[[str, str], CaseError]
) -> PlantSection:
    model, function = table.get("model"), table.get("function")
    if (model is None) == (function is None):
        raise fail("plant", "give either model or function, and not both")
    if model == "measured":
        words = "is one frequency response and has no theta: it goes with the command inner alone"
        raise fail("plant.model", words)
    if model is not None and (not isinstance(model, str) or model not in _KNOWN_MODELS):
        hint = _closest(str(model), _KNOWN_MODELS)
        raise fail("plant.model", f"is {shown(model)}, not a known model{hint}; or use function")
    if function is not None:
        parts = function.rsplit(":", 1) if isinstance(function, str) else []
        if len(parts) != 2 or not parts[0].endswith(".py") or not parts[1].isidentifier():
            raise fail("plant.function", f'is {shown(function)}; write "my_plant.py:model"')
        try:
            exists = (path.parent / parts[0]).is_file()
        except (OSError, ValueError):
            exists = False
        if not exists:
            words = f"there is no file {shown(parts[0])}; give its path relative to the case file"
            raise fail("plant.function", words)
        # Absolute, so that the resolved case means the same from the run folder.
        function = f"{(path.parent / parts[0]).resolve()}:{parts[1]}"
    options = {key: value for key, value in table.items() if key not in ("model", "function")}
    takes = None if model is None else list(inspect.signature(_KNOWN_MODELS[model]).parameters)[1:]
    for key, value in options.items():
        if not key.isidentifier():
            raise fail(f"plant.{key}", "is no keyword; use a Python identifier")
        if takes is not None and key not in takes:
            raise fail(f"plant.{key}", f"is no option of {model}{_closest(key, takes)}")
        wrong = _MODEL_OPTIONS.get((model, key), _option)(value)
        if wrong is not None:
            raise fail(f"plant.{key}", wrong)
    data = DATA.get(model or "")
    if data is not None:
        if data not in options:
            raise fail(f"plant.{data}", f"is missing; add it, which {model} needs")
        try:
            place = (path.parent / options[data]).resolve()
            exists = place.exists()
        except (OSError, ValueError):
            exists = False
        if not exists:
            words = f"there is no {shown(options[data])}; give its path relative to the case file"
            raise fail(f"plant.{data}", words)
        options[data] = str(place)  # absolute, as a function's file
    return PlantSection(model, function, options)


def _options_in(file: str, place: str, fail: Callable[[str, str], CaseError]) -> dict[str, Any]:
    try:
        return read_options(Path(place))
    except ValueError as error:
        raise fail("robust.plants", f"{shown(file)}: {error}") from None


def _option(value: Any) -> str | None:
    if isinstance(value, float) and not math.isfinite(value):
        return f"is {value}; give a finite number"
    if too_large(value):
        return f"is {shown(value)}; write it as a float"
    if isinstance(value, list):
        for item in value:
            wrong = _option(item)
            if wrong is not None:
                return wrong
        return None
    if isinstance(value, str | bool | int | float):
        return None
    return f"is {shown(value)}; give a number, text, true or false, or a list of them"


def _theta(
    table: Mapping[str, Any], fail: Callable[[str, str], CaseError]
) -> tuple[Parameter, ...]:
    if not table:
        raise fail("theta", "names no parameter; add a table [theta.NAME]")
    checks = {"lower": ANY, "upper": ANY, "start": ANY, "unit": text}
    found = []
    for name, entry in table.items():
        place = f"theta.{name}"
        if not name.isidentifier():
            raise fail(place, "is no identifier; use letters, digits and _")
        if not isinstance(entry, Mapping):
            raise fail(place, f"is {shown(entry)}; write a table [theta.{name}]")
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


def parse_theta(case: Case, text: str) -> tuple[float, ...]:
    """θ from `m1=60,m2=60`, in the case's order. Raises CaseError naming what is wrong."""

    def fail(words: str) -> CaseError:
        return CaseError(one_line(f"{case.path}: --theta: {words}"))

    names = [parameter.name for parameter in case.theta]
    found: dict[str, float] = {}
    for part in text.split(","):
        name, equals, value = (item.strip() for item in part.partition("="))
        if not equals:
            raise fail(f"{shown(part)} is not of the form name=value; give {'=..,'.join(names)}=..")
        if name not in names:
            raise fail(f"{shown(name)} is no parameter of the case{_closest(name, names)}")
        if name in found:
            raise fail(f"{name} is given twice; give it once")
        try:
            found[name] = float(value)
        except ValueError:
            raise fail(f"{name} = {shown(value)} is not a number; give one") from None
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

    The plant is made once here, and one of the user's own is looked at over its box. Raises
    CaseError where it is none.

    >>> problem = problem_of(load_case("runs/two_mass.toml"))
    >>> problem.names, problem.w2, round(problem.inner.omega_low, 3)
    (('m1', 'm2'), -0.995, 6.283)
    """
    inner, w = case.inner, case.weights
    file = function = None
    if case.plant.function is not None:
        name, function = case.plant.function.rsplit(":", 1)
        file = str((case.path.parent / name).resolve())
    options = tuple(sorted((key, _frozen(value)) for key, value in case.plant.options.items()))
    problem = CoDesignProblem(
        source=PlantSource(
            case.plant.model, file, function, options, case.limits.plant_seconds
        ).pinned(),
        names=tuple(p.name for p in case.theta),
        units=tuple(p.unit for p in case.theta),
        lower=tuple(p.lower for p in case.theta),
        upper=tuple(p.upper for p in case.theta),
        start=tuple(p.start for p in case.theta),
        w1=case.objective.w1,
        w2=case.objective.w2,
        weights=weights_of(w, inner, disturbance_of(case.controller, w)),
        inner=InnerProblem(
            S_max=inner.S_max,
            S_low=inner.S_low,
            omega_low=HZ * inner.omega_low_hz,
            omega_S=(HZ * inner.omega_S_hz[0], HZ * inner.omega_S_hz[1]),
            omega_T=(HZ * inner.omega_T_hz[0], HZ * inner.omega_T_hz[1]),
            gamma_backoff=inner.gamma_backoff,
            sweep_points=inner.sweep_points,
            # sections bound it themselves, on every plant of theirs
            compliance_max=None
            if case.controller.structure == "sections"
            else inner.compliance_max,
        ),
        suspension=Suspension(case.suspension.frequency_hz, case.suspension.damping_ratio),
        method=inner.method,
        robust=None if case.controller.structure == "sections" else _robust(case.robust),
        sections=sections_problem(
            case.controller, case.loop, case.robust, inner, _option_sets(case)
        ),
        budget=error_budget(case.budget),
    )
    try:
        plants = [plant_of(problem)]
        if problem.sections is not None:
            sets = problem.sections.uncertainty.options
            plants += [plant_of(with_options(problem, item)) for item in sets]
            require_channels(plants, problem.sections)
        if case.plant.model not in SHIPPED:
            for finding in diagnose(problem, case.suspension.rigid_modes)[1]:
                if finding.severity is Severity.ERROR:
                    raise PlantError(finding.words)
    except UserError as error:
        raise CaseError(one_line(f"{case.path}: plant: {error}")) from error
    except Exception as error:
        if function is None:
            raise
        words = f"{function} raised {described(error)}; mend it"
        raise CaseError(one_line(f"{case.path}: plant.function: {words}")) from error
    return problem


def _option_sets(case: Case) -> tuple[tuple[tuple[str, object], ...], ...]:
    """The plant options of every file that [robust] names, data files by their absolute path."""
    found = []
    for file in case.robust.plants:

        def fail(key: str, words: str) -> CaseError:
            return CaseError(one_line(f"{case.path}: {key}: {words}"))

        options = _options_in(file, file, fail)
        data = DATA.get(case.plant.model or "")
        if data in options:
            options[data] = str((case.path.parent / options[data]).resolve())
        found.append(tuple(sorted((key, _frozen(value)) for key, value in options.items())))
    return tuple(found)


def _robust(section: RobustSection) -> RobustSet | None:
    """The set of plants that [robust] names; None where it names no other than the model."""
    shift = section.resonance_shift
    if shift == 0.0 and not section.damping:
        return None
    ends = {"auto": None if shift else 0.0, "low": -shift, "nominal": 0.0, "high": shift}
    design = ends[section.design_at]
    return RobustSet(shift, section.shifts if shift else 1, section.damping, design)


def _frozen(value: Any) -> Any:
    return tuple(map(_frozen, value)) if isinstance(value, list) else value
