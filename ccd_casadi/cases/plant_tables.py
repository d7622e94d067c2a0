"""The tables [plant] and [theta.NAME] of a case file, whose keys depend on the plant, checked."""

import inspect
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ccd_casadi.cases.checks import (
    FRACTION,
    POSITIVE,
    Check,
    closest,
    count,
    flag,
    names,
    number,
    shown,
    text,
    too_large,
)
from ccd_casadi.cases.parameters import parameters_of
from ccd_casadi.cases.tables import Parameter, PlantTable
from ccd_casadi.plants.registry import model_named, model_names

# What the models of the package take, as far as a function's signature does not say it.
_MODEL_OPTIONS: dict[tuple[str | None, str], Check] = {
    ("two_mass", "zeta"): FRACTION,
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


def plant_table(
    table: Mapping[str, Any], path: Path, fail: Callable[[str, str], Exception]
) -> PlantTable:
    """[plant], files in it as absolute paths."""
    model, function = table.get("model"), table.get("function")
    if (model is None) == (function is None):
        raise fail("plant", "give either model or function, and not both")
    if model == "measured":
        words = "is one frequency response and has no theta: it goes with the command inner alone"
        raise fail("plant.model", words)
    known = model_named(model) if isinstance(model, str) else None
    if model is not None and known is None:
        hint = closest(str(model), model_names())
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
    takes = None if known is None else list(inspect.signature(known.build).parameters)[1:]
    checks = {} if known is None else known.checks
    for key, value in options.items():
        if not key.isidentifier():
            raise fail(f"plant.{key}", "is not a keyword; use a Python identifier")
        if takes is not None and key not in takes:
            raise fail(f"plant.{key}", f"is not an option of {model}{closest(key, takes)}")
        wrong = _MODEL_OPTIONS.get((model, key), checks.get(key, _option))(value)
        if wrong is not None:
            raise fail(f"plant.{key}", wrong)
    data = "" if known is None else known.data
    if data:
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
    return PlantTable(model, function, options)


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


def theta_tables(
    table: Mapping[str, Any],
    model: str | None,
    of_case: tuple[str, ...],
    fail: Callable[[str, str], Exception],
) -> tuple[tuple[Parameter, ...], tuple[Parameter, ...]]:
    """[theta.NAME] of every parameter, searched ones and fixed ones.

    Those that a model of the package needs, those that [places] and [motor] name, and no other.
    """
    searched, fixed = parameters_of(table, fail)
    known = model_named(model)
    needed = None if known is None else known.theta
    for name in of_case:
        if name not in table:
            words = f"is missing; add a table [theta.{name}], which [places] or [motor] names"
            raise fail(f"theta.{name}", words)
    if needed is not None:
        needed = (*needed, *of_case)
        for name in table:
            if name not in needed:
                raise fail(f"theta.{name}", f"is not a parameter of {model}{closest(name, needed)}")
        for name in needed:
            if name not in table:
                words = f"is missing; add a table [theta.{name}], which {model} needs"
                raise fail(f"theta.{name}", words)
    return searched, fixed
