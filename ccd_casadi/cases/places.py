"""[places] of a case: nodes read from their file, and its places as the plant takes them."""

import csv
from dataclasses import fields, replace
from pathlib import Path

from ccd_casadi.cases.checks import Fail, short_repr
from ccd_casadi.cases.tables import PlacesTable
from ccd_casadi.plants.places import Places


def checked_places(table: PlacesTable, folder: Path, fail: Fail) -> PlacesTable:
    """The table with its nodes as numbers, so that a run's own case needs no other file."""
    if table == PlacesTable():
        return table
    for name in ("nodes", "actuators"):
        if not getattr(table, name):
            raise fail(f"places.{name}", "is missing; add it")
    if table.axes and not table.sensors:
        raise fail("places.sensors", "is missing, and axes are of forces and sensors; add it")
    if (table.quiet or table.damped) and not table.axes:
        raise fail("places.axes", "is false, and quiet and damped modes are of axes; give true")
    if table.reference and (table.axes or not table.sensors):
        raise fail("places.reference", "needs sensors, and has no place beside axes; drop one")
    rows = table.nodes
    if isinstance(rows, str):
        try:
            text = (folder / rows).read_text(encoding="utf-8-sig")
            rows = tuple(tuple(map(float, row)) for row in list(csv.reader(text.splitlines()))[1:])
        except (OSError, ValueError, csv.Error) as error:
            words = f"{short_repr(table.nodes)}: {error}; name a CSV file of numbers after a header"
            raise fail("places.nodes", words) from None
    numbers = tuple(tuple(map(float, row)) for row in rows)
    if not numbers or len({len(row) for row in numbers}) != 1 or len(numbers[0]) not in (1, 2, 3):
        raise fail("places.nodes", "are not rows of as many coordinates, 1 to 3; correct them")
    return replace(table, nodes=numbers)


def check_directions(table: PlacesTable, several_plants: bool, fail: Fail) -> None:
    """Raise where directions that follow modes would differ from plant to plant of a set."""
    for name in ("quiet", "damped") if several_plants else ():
        if getattr(table, name):
            words = "gives each plant of robust.plants, and of a parameter that varies, directions "
            words += "of its own, which no controller can follow; drop it, or these plants"
            raise fail(f"places.{name}", words)


def places_of(table: PlacesTable) -> Places | None:
    """Its places as plain values; None where the case has none."""
    if table == PlacesTable():
        return None
    values = {item.name: getattr(table, item.name) for item in fields(Places)}
    for name in ("actuators", "sensors", "reference"):
        values[name] = tuple(map(tuple, values[name]))
    return Places(**values)
