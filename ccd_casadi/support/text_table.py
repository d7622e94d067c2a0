"""Tables of numbers as text: encoding, separator, decimal comma, cells; for any file of numbers."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ccd_casadi.support.errors import UserError

DIGITS = "0123456789+-."
READ = "CSV, .npz and .mat are read"


def text_of(path: Path) -> tuple[str, list[str]]:
    """Read the text of a file.

    Parameters
    ----------
    path : Path

    Returns
    -------
    str, list of str
        The text, and what of its encoding is to be reported.

    Raises
    ------
    UserError
        The file cannot be read, or is not text.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        try:
            return raw.decode("utf-16"), ["encoded as UTF-16"]
        except UnicodeDecodeError:
            raise UserError(f"{path}: is not a table of numbers; {READ}") from None
    if b"\0" in raw:
        raise UserError(f"{path}: is not a table of numbers but a binary file; {READ}")
    try:
        return raw.decode("utf-8-sig"), []
    except UnicodeDecodeError:
        return raw.decode("latin-1"), ["encoded as Latin-1"]


def separator(line: str) -> str | None:
    """Find what separates the cells of a line of numbers; None: spaces.

    Parameters
    ----------
    line : str

    Returns
    -------
    str or None

    Examples
    --------
    >>> separator("1,5;2,5"), separator("1.5 2.5")
    (';', None)
    """
    return next((mark for mark in "\t;|," if mark in line), None)


def cells(line: str, mark: str | None) -> list[str]:
    """Split a line at a separator; empty cells at its end are dropped.

    Parameters
    ----------
    line, mark : str, str or None

    Returns
    -------
    list of str
    """
    parts = [part.strip().strip('"').strip() for part in line.split(mark)]
    while len(parts) > 1 and not parts[-1]:
        parts.pop()
    return parts


def decimal_comma(
    path: Path, rows: Sequence[tuple[int, list[str]]], mark: str | None
) -> tuple[bool, list[str]]:
    """Find whether the decimals of a table are commas.

    Parameters
    ----------
    path : Path
    rows : sequence of (int, list of str)
        Number of each line, and its cells.
    mark : str or None
        Its separator.

    Returns
    -------
    bool, list of str
        The second: what of its form is to be reported.

    Raises
    ------
    UserError
        A comma may be a decimal or part thousands.
    """
    word = {"\t": "tabs", ";": "semicolons", "|": "bars", None: "spaces"}.get(mark, "")
    notes = [f"separated by {word}"] if word else []
    if mark == ",":
        return False, notes
    own = [(i, c) for i, row in rows for c in row if c and set(c.casefold()) <= set(DIGITS + ",e")]
    with_comma = [(i, c) for i, c in own if "," in c]
    if not with_comma:
        return False, notes
    both = next((i for i, c in with_comma if "." in c or c.count(",") > 1), None)
    if both is None and any("." in c for _, c in own):
        both = with_comma[0][0]
    thousands = all(re.fullmatch(r"[+-]?[1-9]\d{0,2},\d{3}", c) for _, c in with_comma)
    if both is not None or thousands:
        words = "a comma may be a decimal or part thousands; write decimals with a point"
        raise UserError(f"{path}: line {both or with_comma[0][0]}: {words}")
    return True, [*notes, "decimals by commas"]


def is_number(cell: str, comma: bool) -> bool:
    """Whether a cell is a number, with its decimals by commas or not.

    Parameters
    ----------
    cell, comma : str, bool

    Returns
    -------
    bool
    """
    try:
        _parse(cell, comma)
    except ValueError:
        return False
    return True


def _parse(cell: str, comma: bool) -> complex:
    cell = cell.replace(",", ".") if comma else cell
    return complex(re.sub(r"(?<=[\d.])[iI]$", "j", cell.replace(" ", "")))


def number_in(path: Path, line: int, cell: str, comma: bool) -> complex:
    """Read a finite number.

    Parameters
    ----------
    path, line : Path, int
        Where it is, for an error's words.
    cell, comma : str, bool

    Returns
    -------
    complex

    Raises
    ------
    UserError
        The cell is not one.
    """
    try:
        found = _parse(cell, comma)
    except ValueError:
        raise UserError(f"{path}: line {line}: {cell!r} is not a number") from None
    if not np.isfinite(found):
        raise UserError(f"{path}: line {line}: {cell!r} is not a finite number; drop the line")
    return found
