"""Logs of LabVIEW (.tdms) by npTDMS: every channel of one length and one sampling time."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ccd_casadi.support.errors import UserError, described, require


class _Kept(logging.Handler):
    """Keeps what is logged."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.words: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.words.append(record.getMessage())


@contextmanager
def _heard() -> Iterator[list[str]]:
    """The warnings of npTDMS, which reads on where a file is cut off, instead of its printing."""
    kept = _Kept()
    logs = [logging.getLogger(name) for name in (*logging.root.manager.loggerDict,)
            if name.partition(".")[0] == "nptdms"]  # fmt: skip
    before = [log.handlers for log in logs]
    for log in logs:
        log.handlers = [kept]
    try:
        yield kept.words
    finally:
        for log, own in zip(logs, before, strict=True):
            log.handlers = own


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
        with _heard() as found, path.open("rb") as stream, nptdms.TdmsFile.open(stream) as file:
            every = [one for group in file.groups() for one in group.channels()]
            read = [(one, np.asarray(one[:])) for one in every]
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # a damaged file fails anywhere inside the reader
        raise UserError(f"{path}: is not a readable .tdms file: {described(error)}") from None
    if found:
        raise UserError(f"{path}: is cut off or damaged: {found[0]}; export it again")
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
