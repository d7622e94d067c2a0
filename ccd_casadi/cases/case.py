"""The case file: TOML into frozen dataclasses, every mistake in one line that says the remedy.

`problem_of` makes of it the problem in SI that the lower layers take.
"""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

from ccd_casadi.cases.budget import checked_budget, error_budget
from ccd_casadi.cases.checks import closest, shown
from ccd_casadi.cases.controller_sections import ChannelSection
from ccd_casadi.cases.diagnosis import diagnose
from ccd_casadi.cases.findings import Severity
from ccd_casadi.cases.kinds import (
    check_kind,
    disturbance_of,
    read_options,
    require_channels,
    sections_problem,
    weights_of,
)
from ccd_casadi.cases.plant_tables import plant_table, theta_tables
from ccd_casadi.cases.sections import SECTIONS, Case, RobustSection
from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.robust_set import RobustSet
from ccd_casadi.inner_problem.sections_plant_set import with_options
from ccd_casadi.inner_problem.sweep import InnerProblem
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.plants.registry import DATA, SHIPPED
from ccd_casadi.support.errors import PlantError, UserError, described
from ccd_casadi.support.units import HZ
from surrogates.options import one_line

DEFAULT_CASE = "runs/two_mass.toml"  # what commands read where no case is named
EXAMPLE = "python -m ccd_casadi.solve my_case.toml (docs/tutorial.md writes one)"


class CaseError(UserError):
    """One line: file, key, what is wrong, what to do."""


# Which weight must lie below which: else it asks for nothing (W_S) or for the opposite (W_T).
_ORDERED_WEIGHTS = (
    ("A_S", "M_S", "W_S asks for more at low frequency"),
    ("A_u", "A_l", "W_T asks for a roll-off"),
)
# What is one number for all channels, and where those of single channels go.
_OF_THE_WHOLE = {
    ("inner", "S_max"),
    ("controller", "weighted_level"),
    *(("weights", item.name) for item in fields(SECTIONS["weights"])),
}
_PER_CHANNEL = (
    "give a number, the whole loop's: S_max, M_K and bandwidth_ratio of a channel go in a table "
    '[controller.channel.NAME] with controller.structure = "sections"'
)


def load_case(path: str | Path) -> Case:
    """Read and check a case file. Raises CaseError on the first mistake.

    >>> load_case("runs/two_mass.toml").theta[0].table
    {'lower': 55.0, 'upper': 70.0, 'start': 67.56, 'unit': 'kg'}
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
            raise fail(name, f"unknown section{closest(name, known)}")
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
    plant = plant_table(data["plant"], path, fail)
    files = sections["robust"].plants
    absolute = tuple(str((path.parent / file).resolve()) for file in files)
    for file, place in zip(files, absolute, strict=True):
        plant_table(dict(data["plant"]) | _options_in(file, place, fail), path, fail)
    sections["robust"] = replace(sections["robust"], plants=absolute)
    theta, fixed = theta_tables(data["theta"], plant.model, fail)
    return Case(path=path, plant=plant, theta=theta, fixed=fixed, **sections)


def section_of(
    kind: type, name: str, table: Mapping[str, Any], fail: Callable[[str, str], CaseError]
) -> Any:
    """A table as its dataclass, every key checked."""
    allowed = {item.name: item for item in fields(kind)}
    for key in table:
        if key not in allowed:
            raise fail(f"{name}.{key}", f"unknown key{closest(key, allowed)}")
    values = {}
    for key, item in allowed.items():
        if key not in table:
            if item.default is MISSING:
                raise fail(f"{name}.{key}", "is missing; add it")
            continue
        wrong = item.metadata["check"](table[key])
        if wrong is not None and isinstance(table[key], list) and (name, key) in _OF_THE_WHOLE:
            wrong = f"is {shown(table[key])}; {_PER_CHANNEL}"
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


def _options_in(file: str, place: str, fail: Callable[[str, str], CaseError]) -> dict[str, Any]:
    try:
        return read_options(Path(place))
    except ValueError as error:
        raise fail("robust.plants", f"{shown(file)}: {error}") from None


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
            raise fail(f"{shown(name)} is no parameter of the case{closest(name, names)}")
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
            case.plant.model,
            file,
            function,
            options,
            case.limits.plant_seconds,
            fixed=tuple((p.name, p.start, p.unit) for p in case.fixed),
        ).pinned(),
        names=tuple(p.name for p in case.theta),
        units=tuple(p.unit for p in case.theta),
        lower=tuple(p.lower for p in case.theta),
        upper=tuple(p.upper for p in case.theta),
        start=tuple(p.start for p in case.theta),
        listed=tuple((p.name, p.values) for p in case.theta if p.values),
        w1=case.objective.w1,
        w2=case.objective.w2,
        cost_unit=case.objective.cost_unit,
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
