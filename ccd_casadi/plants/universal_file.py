"""Universal files: a frequency response function of dataset 58, ASCII or binary, by pyuff."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.plants.table_columns import TableColumn
from ccd_casadi.support.errors import UserError, described, require

SUFFIXES = (".uff", ".unv", ".uf", ".bunv")


@dataclass(frozen=True)
class DatasetCodes:
    """Codes of dataset 58 (SDRL, University of Cincinnati)."""

    response_function: int = 4  # function type of an FRF
    frequency: int = 18  # specific data type of an abscissa in Hz
    force: int = 13  # that of a force
    SI: int = 1  # code of dataset 164


# by the specific data type of the ordinate: what it is, and units of it over N by label
ORDINATES: Mapping[int, tuple[str, Mapping[str, str]]] = {
    8: ("displacement", {"": "m/N", "m": "m/N", "mm": "mm/N", "um": "um/N", "nm": "nm/N"}),
    11: ("velocity", {"": "m/s/N", "m/s": "m/s/N"}),
    12: ("acceleration", dict.fromkeys(("", "m/s^2", "m/s2", "m/s²", "m/s**2"), "m/s^2/N")),
}  # fmt: skip
FUNCTIONS = {1: "time responses", 2: "auto spectra", 3: "cross spectra", 6: "coherences",
             9: "power spectral densities"}  # fmt: skip


def columns_of_universal(
    path: Path, codes: DatasetCodes = DatasetCodes()
) -> tuple[list[TableColumn], list[str]]:
    """Read the only frequency response of a universal file: f_hz, G with its unit, what is to be
    reported.

    Raises UserError where pyuff is not installed, or the file holds no single response over a force
    that is understood.
    """
    pyuff = require("pyuff", "uff")
    if not path.exists():
        raise UserError(f"{path}: cannot be read: no such file")
    try:
        file = pyuff.UFF(str(path))
        kinds = [int(kind) for kind in file.get_set_types()]
        at = [i for i, kind in enumerate(kinds) if kind == 58]
        sets = [file.read_sets(i) for i in at]
        units = [file.read_sets(i) for i, kind in enumerate(kinds) if kind == 164]
    except Exception as error:  # a damaged file fails anywhere inside the reader
        raise UserError(f"{path}: is not a readable universal file: {described(error)}") from None
    found = [one for one in sets if int(one["func_type"]) == codes.response_function]
    if len(found) != 1:
        other = [FUNCTIONS.get(int(one["func_type"]), "other functions") for one in sets]
        other += [f"dataset {kind}" for kind in kinds if kind != 58]
        each = [_place(one) for one in found[:4]] or list(dict.fromkeys(other))[:6]
        words = f"holds {len(found)} frequency responses of dataset 58 ({', '.join(each)})"
        raise UserError(f"{path}: {words}; write one a file")
    one, notes = found[0], [_place(found[0])]
    foreign = next((item for item in units if int(item["units_code"]) != codes.SI), None)
    if foreign is not None:
        named = str(foreign.get("units_description", "")).strip() or foreign["units_code"]
        words = f"dataset 164 has the units {named}, and the response may be in these or in SI"
        raise UserError(f"{path}: {words}; write it in SI")
    if int(one["abscissa_spec_data_type"]) != codes.frequency:
        raise UserError(f"{path}: its abscissa is not a frequency; write a response over Hz")
    over, force = int(one["orddenom_spec_data_type"]), _label(one, "orddenom")
    kind, unit = int(one["ordinate_spec_data_type"]), _label(one, "ordinate")
    if over != codes.force or force not in ("", "n"):
        what = force or (f"data type {over}" if over else "what its header does not name")
        words = f"is over {what}, not over a force in N"
        raise UserError(f"{path}: {words}; write it over N")
    if kind not in ORDINATES:
        raise UserError(f"{path}: its data type {kind} is not a displacement, velocity or "
                        "acceleration; write one of them")  # fmt: skip
    name, known = ORDINATES[kind]
    if unit not in known:
        raise UserError(f"{path}: {unit!r} is not understood as a unit of {name}; it may be "
                        f"{', '.join(key for key in known if key)}")  # fmt: skip
    if not unit:
        notes.append(f"{name} in SI, as no unit is named")
    if len(sets) > 1:
        notes.append(f"{len(sets) - 1} other functions are left out")
    G, hz = np.asarray(one["data"], complex), np.asarray(one["x"], float)
    return [TableColumn("f_hz", hz), TableColumn(f"G ({known[unit]})", G)], notes


def _label(one: Mapping[str, Any], of: str) -> str:
    """The unit of an axis in small letters; empty where none is named."""
    text = str(one.get(f"{of}_axis_units_lab") or "").strip().casefold()
    return "" if text == "none" else text


def _place(one: Mapping[str, Any]) -> str:
    """Where a response was measured, as its file has it."""
    ends = [f"{one[f'{of}_node']}:{int(one[f'{of}_dir']):+d}" for of in ("rsp", "ref")]
    return f"node and direction {ends[0]} over {ends[1]}"
