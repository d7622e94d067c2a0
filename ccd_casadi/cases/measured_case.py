"""A case whose plant is a measured frequency response: a controller of fixed structure, no θ.

[plant]
model = "measured"
file = "stage.csv"            # or .mat: displacement over force, m/N, see `read_frequency_response`
unstable_poles = 0            # of the plant; default 0
poles_at_zero = 2             # default: by the slope of its first lines
least_damping = 0.0005        # of a resonance that lines may hide, at least

with [inner], [controller] structure = "sections", [weights] where weighted_level is given, and
[loop] rate_hz: then the response was measured as the controller sees it, hold and delay in it.
[units] names what its outputs and inputs are where these are not m and N.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ccd_casadi.cases.case import read_toml, table_of
from ccd_casadi.cases.checks import POSITIVE, Fail, count, require_good, short_repr, text
from ccd_casadi.cases.controller_kinds import (
    KindOptions,
    check_kind,
    check_rate,
    idle_keys,
    structure_of,
    weights_of,
)
from ccd_casadi.cases.plant_tables import MEASURED
from ccd_casadi.cases.tables import TABLES, BudgetTable, ObjectiveTable, RobustTable
from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.plants.measured import MeasuredResponse, read_frequency_response
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ, use_units

_TABLES = ("weights", "inner", "controller", "loop", "units")
_PLANT = {
    "model": text,
    "file": text,
    "unstable_poles": count(0),
    "poles_at_zero": count(0),
    "least_damping": POSITIVE,
}


@dataclass(frozen=True)
class MeasuredCase:
    """The checked case of a measured plant.

    Attributes
    ----------
    path : Path
    file : str
        Of the response.
    responses : tuple of MeasuredResponse
    structure : Structure
    bounds : Bounds
    period : float or None
        s; None: a continuous controller.
    starts : int
        Starts of the search.
    """

    path: Path
    file: str
    responses: tuple[MeasuredResponse, ...]
    structure: Structure
    bounds: Bounds
    period: float | None
    starts: int


def measured_case(path: Path) -> MeasuredCase | None:
    """Read the case of a measured plant.

    Parameters
    ----------
    path : Path

    Returns
    -------
    MeasuredCase, or None for any other case

    Raises
    ------
    CaseError
        On the first mistake.
    """
    data = read_toml(path)
    plant = data.get("plant")
    if not isinstance(plant, Mapping) or plant.get("model") != MEASURED:
        return None

    fail = Fail(path)
    for name, table in data.items():
        if name not in ("plant", *_TABLES):
            words = f'has no effect on plant.model = "{MEASURED}", which has no theta; drop it'
            raise fail(name, words)
        if not isinstance(table, Mapping):
            raise fail(name, f"is {short_repr(table)}; write a table [{name}]")
    response = _response(plant, path, fail)
    if "inner" not in data:
        raise fail("inner", "is missing; add a table [inner]")
    tables = {
        name: table_of(TABLES[name], name, data.get(name, {}), fail, idle_keys(data))
        for name in _TABLES
        if name != "weights" or name in data
    }
    _check(tables, fail)
    inner, controller, loop = (tables[name] for name in ("inner", "controller", "loop"))
    use_units(tables["units"].output, tables["units"].input)
    weights = None
    if controller.weighted_level is not None:
        weights = weights_of(controller, tables["weights"], inner)
    return MeasuredCase(
        path=path,
        file=str(plant["file"]),
        responses=(response,),
        structure=structure_of(controller),
        bounds=Bounds(
            S_max=inner.S_max,
            S_low=inner.S_low,
            omega_low=HZ * inner.omega_low_hz,
            shape=KindOptions.shape if inner.shape is None else inner.shape,
            shape_ends=ShapeEnd(inner.shape_ends),
            weighted_level=controller.weighted_level,
            weights=weights,
            compliance_max=inner.compliance_max,
        ),
        period=None if loop.rate_hz is None else 1.0 / loop.rate_hz,
        starts=controller.starts,
    )


def _response(plant: Mapping[str, Any], path: Path, fail: Fail) -> MeasuredResponse:
    require_good("plant", plant, _PLANT, fail)
    if "file" not in plant:
        raise fail("plant.file", f"is missing; add it, which {MEASURED} needs")
    try:
        found = read_frequency_response(path.parent / plant["file"])
    except UserError as error:
        raise fail("plant.file", str(error)) from error
    unstable, at_zero = int(plant.get("unstable_poles", 0)), plant.get("poles_at_zero")
    least = float(plant.get("least_damping", found.least_damping))
    return replace(found, unstable_poles=unstable, poles_at_zero=at_zero, least_damping=least)


def _check(tables: Mapping[str, Any], fail: Fail) -> None:
    inner, controller, loop = (tables[name] for name in ("inner", "controller", "loop"))
    if controller.structure != "sections":
        words = 'needs structure = "sections": a synthesis of full order has no model to start from'
        raise fail("controller.structure", words)
    if controller.channel:
        raise fail("controller.channel", "a measured response is of one channel; drop it")
    if controller.weighted_level is not None and "weights" not in tables:
        raise fail("weights", "is missing, and controller.weighted_level is of them; add a table")
    if inner.minimise != "bandwidth":
        raise fail("inner.minimise", "needs a model, a measured response is none; drop it")
    if loop.delay_us:
        words = "is in a response that was measured as the controller sees it; drop it"
        raise fail("loop.delay_us", words)
    check_rate(tables, fail)
    others = {"objective": ObjectiveTable(0.0, -1.0), "robust": RobustTable(),
              "budget": BudgetTable()}  # fmt: skip
    if "weights" in tables:
        check_kind({**tables, **others}, fail)
