"""Logs of LabVIEW (.tdms) by npTDMS: every channel of one length and one sampling time."""

from pathlib import Path

import numpy as np

from ccd_casadi.support.errors import UserError, described, require


def tdms_columns(path: Path) -> tuple[dict[str, np.ndarray], float | None, list[str]]:
    """Read the channels of numbers.

    Parameters
    ----------
    path : Path

    Returns
    -------
    dict of str to array (n,)
        By name, with the unit where the file has one; by group and name where two are alike.
    float or None
        Sampling rate in Hz where the channels are waveforms.
    list of str
        What is to be reported.

    Raises
    ------
    UserError
        The file cannot be read, or its channels begin or are sampled differently.
    """
    nptdms = require("nptdms", "tdms")
    try:
        with path.open("rb") as stream, nptdms.TdmsFile.open(stream) as file:
            every = [one for group in file.groups() for one in group.channels()]
            read = [(one, np.asarray(one[:])) for one in every]
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # a damaged file fails anywhere inside the reader
        raise UserError(f"{path}: is not a readable .tdms file: {described(error)}") from None
    kept = [(one, own) for one, own in read if own.dtype.kind in "biuf" and own.size]
    names = [one.name for one, _ in kept]
    columns, clocks = dict[str, np.ndarray](), set()
    for one, own in kept:
        name = one.name if names.count(one.name) == 1 else f"{one.group_name}/{one.name}"
        unit = str(one.properties.get("unit_string", "")).strip()
        columns[f"{name} ({unit})" if unit else name] = own.astype(float)
        step, start = (one.properties.get(f"wf_{key}") for key in ("increment", "start_offset"))
        clocks.add((step, start or 0.0) if step else None)
    if len(clocks) > 1:
        words = ", ".join(sorted(f"{own[0]:g} s from {own[1]:g} s" if own else "none"
                                 for own in clocks))  # fmt: skip
        raise UserError(f"{path}: its channels have different sampling times: {words}; "
                        "export channels of one")  # fmt: skip
    clock = next(iter(clocks), None)
    left = [one.name for one, own in read if own.dtype.kind not in "biuf"]
    notes = [f"not numbers and left out: {', '.join(left)}"] if left else []
    return columns, None if clock is None else 1.0 / float(clock[0]), notes
