"""Rows of a CSV file that a person or a finite-element program wrote, and the numbers in them."""

import csv
import math
from pathlib import Path

from ccd_casadi.support.errors import PlantError

Rows = dict[str, dict[str, str]]  # cells by column, by the row's place: `FILE: line N`


def read_rows(path: Path) -> Rows:
    """The rows under a header; lines that start with # are remarks.

    Raises PlantError where it cannot be read, holds no rows, or a row has not the header's columns.
    """
    try:
        lines = enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1)
        kept = [(i, line) for i, line in lines if line.strip() and not line.startswith("#")]
        parsed = list(csv.reader((line for _, line in kept), skipinitialspace=True))
    except (OSError, UnicodeDecodeError) as error:
        raise PlantError(f"{path}: cannot be read: {error}; name a CSV file in UTF-8") from None
    except csv.Error as error:
        raise PlantError(f"{path}: is not a CSV: {error}; separate cells by commas") from None
    if len(parsed) < 2:
        raise PlantError(f"{path}: holds no rows; give a header and rows below it")
    header, *rows = ([cell.strip() for cell in cells] for cells in parsed)
    if len(set(header)) < len(header) or not all(header):
        raise PlantError(f"{path}: line {kept[0][0]}: a column's name is empty or twice there")
    found = {}
    for (number, _), cells in zip(kept[1:], rows, strict=False):
        place = f"{path}: line {number}"
        if len(cells) != len(header):
            words = f"has {len(cells)} columns, the header {len(header)}"
            raise PlantError(f"{place}: {words}; correct it")
        found[place] = dict(zip(header, cells, strict=True))
    return found


def number_in(place: str, key: str, text: str) -> float:
    """A cell as a finite number. Raises PlantError."""
    try:
        value = float(text)
    except ValueError:
        raise PlantError(f"{place}: {key}: {text[:40]!r} is not a number; give one") from None
    if not math.isfinite(value):
        raise PlantError(f"{place}: {key}: {text[:40]!r} is not finite; give a number")
    return value
