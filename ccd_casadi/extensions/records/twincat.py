"""The text export of a TwinCAT scope: groups of channels, each behind its time in ms."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ccd_casadi.support.errors import UserError

RATE, NAME, FILE, UNIT = "SampleTime[ms]", "Name", "File", "Unit"


def is_scope(text: str) -> bool:
    """Whether a text is such an export.

    Parameters
    ----------
    text : str

    Returns
    -------
    bool
    """
    lines = text.splitlines()[:30]
    return len(lines) > 1 and lines[0].startswith(NAME) and lines[1].startswith(FILE + _mark(lines))


def scope_columns(path: Path, text: str) -> tuple[dict[str, np.ndarray], list[str]]:
    """Read the channels of the sampling time that most of them have.

    Parameters
    ----------
    path : Path
        For messages.
    text : str

    Returns
    -------
    dict of str to array (n,), list of str
        "t (ms)" and the channels with their units, as the scope has scaled them; what is to be
        reported.

    Raises
    ------
    UserError
        The separator occurs inside cells, or a line is not numbers.
    """
    try:
        return _columns(path, [line.rstrip("\r") for line in text.splitlines()])
    except UserError:
        raise
    except (StopIteration, ValueError, IndexError):
        words = "is cut off or changed: it needs names, sampling times, an empty line and numbers"
        raise UserError(f"{path}: as a TwinCAT scope it {words}; export it again") from None


def _columns(path: Path, lines: list[str]) -> tuple[dict[str, np.ndarray], list[str]]:
    mark = _mark(lines)
    top = max(i for i, line in enumerate(lines[:30]) if line.split(mark)[0].strip('"') == NAME)
    at = next((i for i, line in enumerate(lines[:30]) if line.startswith(RATE)), top)
    names, rates = (_trimmed(lines[i].split(mark)) for i in (top, at))
    head = RATE if at > top else NAME  # without the channels' properties all are of one time
    units = next((line.split(mark) for line in lines[at:] if line.startswith(UNIT + mark)), [])
    times = [i for i, cell in enumerate(rates) if cell == head]
    if [i for i, name in enumerate(names) if name == NAME] != times or len(names) != len(rates):
        words = "is its separator and also within a name or a decimal; export with tabs"
        raise UserError(f"{path}: line {at + 1}: {mark!r} {words}")
    of = {i: max(t for t in times if t < i) for i in range(len(rates)) if i not in times}
    steps = {i: float(rates[i].replace(",", ".")) if at > top else 0.0 for i in of}
    most = max(set(steps.values()), key=lambda step: (list(steps.values()).count(step), -step))
    kept = [i for i in of if steps[i] == most]
    first = next(i for i in range(at, len(lines)) if not lines[i].strip(mark + " ")) + 1
    body = [(i, lines[i].split(mark)) for i in range(first, len(lines))
            if lines[i].strip() not in ("", "EOF")]  # fmt: skip
    clock = _column(path, body, of[kept[0]], len(rates))
    if not len(clock):
        raise ValueError
    found = {"t (ms)": clock}
    for i in kept:
        if of[i] != of[kept[0]]:
            own = _column(path, body, of[i], len(rates))
            if len(own) != len(clock) or np.abs(own - clock).max() > 0.0:
                raise UserError(f"{path}: {names[i]!r} has other times than {names[kept[0]]!r}; "
                                "export one start for all")  # fmt: skip
        name = _named(names[i], units[i] if i < len(units) else "")
        if name in found:
            raise UserError(f"{path}: column {name!r} is there twice; keep one")
        found[name] = _column(path, body, i, len(rates))
    notes = ["a TwinCAT scope, as scaled there"]
    other = [names[i] for i in of if i not in kept]
    if other:
        notes.append(f"of another sampling time than {most:g} ms and left out: {', '.join(other)}")
    return found, notes


def _mark(lines: Sequence[str]) -> str:
    """What follows the first word of the file."""
    return lines[0].removeprefix(NAME)[:1] or "\t"


def _trimmed(row: list[str]) -> list[str]:
    while row and not row[-1].strip():
        row.pop()
    return row


def _named(name: str, unit: str) -> str:
    word = unit.strip().split(" ")[0]
    return name if word in ("", "(None)") else f"{name} ({word})"


def _column(path: Path, body: Sequence[tuple[int, list[str]]], i: int, count: int) -> np.ndarray:
    """A column down to where its group ends."""
    found = []
    for line, row in body:
        while len(row) > count and not row[-1].strip():
            row.pop()
        if len(row) > count:
            words = f"has {len(row)} cells and the header {count}: its separator is in a decimal"
            raise UserError(f"{path}: line {line + 1}: {words}; export with tabs")
        cell = row[i].strip() if i < len(row) else ""
        if not cell:
            break
        try:
            found.append(float(cell.replace(",", ".")))
        except ValueError:
            raise UserError(f"{path}: line {line + 1}: {cell[:40]!r} is not a number") from None
    return np.array(found)
