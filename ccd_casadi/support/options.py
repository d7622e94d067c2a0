"""What the commands of all packages share: exit codes, validators, one line for a wrong option."""

import argparse
import math
import os
from collections.abc import Callable
from enum import IntEnum
from typing import Any, NoReturn

from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ

DEFAULT_CASE = "runs/two_mass.toml"  # what commands read where no case is named
Option = Callable[[argparse.ArgumentParser], object]  # adds one


class ExitCode(IntEnum):
    """The exit code of a command.

    Attributes
    ----------
    words : str
        Its description.
    """

    words: str

    DONE = 0, "done and verified"
    BAD_INPUT = 2, "bad input"
    INFEASIBLE = 3, "no feasible design"
    NOT_VERIFIED = 4, "finished, not verified"
    INTERRUPTED = 130, "interrupted; what is sampled is kept"

    def __new__(cls, code: int, words: str) -> "ExitCode":
        found = int.__new__(cls, code)
        found._value_, found.words = code, words
        return found

    @classmethod
    def of(cls, status: str) -> "ExitCode":
        """Return the exit code of a command whose design has this status.

        >>> ExitCode.of("verified"), ExitCode.of("infeasible"), ExitCode.of("not_verified")
        (<ExitCode.DONE: 0>, <ExitCode.INFEASIBLE: 3>, <ExitCode.NOT_VERIFIED: 4>)
        """
        return cls.DONE if status == "verified" else cls[status.upper()]


def one_line(value: object, *, longest: int = 1000) -> str:
    """Write any text on one line; control characters are escaped.

    Parameters
    ----------
    value : object
    longest : int
        Characters; the middle of a longer text is left out.

    Returns
    -------
    str
    """
    words = " ".join(str(value).split())
    if len(words) > longest:
        words = f"{words[: longest - 200]} ... {words[-150:]}"
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in words)


def usable_cores() -> int:
    """Count the cores that this process may use.

    Returns
    -------
    int
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, as every other bad input, without the usage."""

    def error(self, message: str) -> NoReturn:
        """Leave with BAD_INPUT and the message."""
        self.exit(ExitCode.BAD_INPUT, f"{one_line(message)}; see {self.prog} --help\n")


def integer(least: int, most: int = 999_999_999) -> Callable[[str], int]:
    """Make the type of an option that is a whole number.

    Parameters
    ----------
    least, most : int

    Returns
    -------
    callable
        str -> int; raises argparse.ArgumentTypeError.

    Examples
    --------
    >>> integer(1)("12")
    12
    """

    def convert(text: str) -> int:
        # Nine digits are enough for anyone, and within what every random generator takes.
        if not (text.isdecimal() and len(text) < 10 and least <= int(text) <= most):
            words = f"{text[:20]!r} is not a whole number from {least} to {most}; give one"
            raise argparse.ArgumentTypeError(words)
        return int(text)

    return convert


def real(
    least: float = 0.0, most: float = math.inf, *, strict: bool = False
) -> Callable[[str], float]:
    """Make the type of an option that is a finite number.

    Parameters
    ----------
    least, most : float
    strict : bool
        Exclude the bounds.

    Returns
    -------
    callable
        str -> float; raises argparse.ArgumentTypeError.

    Examples
    --------
    >>> real(0.0, strict=True)("2.5")
    2.5
    """
    words = f"number above {least:g}" if strict else f"number from {least:g}"
    if most < math.inf:
        words += f" and below {most:g}" if strict else f" to {most:g}"

    def convert(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        inside = least < value < most if strict else least <= value <= most
        if not (inside and math.isfinite(value)):
            raise argparse.ArgumentTypeError(f"{text[:20]!r} is not a {words}; give one")
        return value

    return convert


positive = real(strict=True)


def option(*names: str, **how: Any) -> Option:
    """Make an option of a command.

    Parameters
    ----------
    *names : str
    **how
        As in `argparse.ArgumentParser.add_argument`.

    Returns
    -------
    Option
    """
    return lambda arguments: arguments.add_argument(*names, **how)


def take_value(
    name: str, metavar: str, kind: Callable[[str], Any], words: str, default: Any
) -> Option:
    """Make an option with a value; its help ends with the default.

    Parameters
    ----------
    name, metavar : str
    kind : callable
        str -> value.
    words : str
        Help.
    default : number

    Returns
    -------
    Option
    """
    words += f" (default: {default:g})"
    return option(name, metavar=metavar, type=kind, default=default, help=words)


def break_frequency_options(words: str) -> list[Option]:
    """Make --omega-s-hz and --omega-t-hz, which `break_frequencies` reads.

    Parameters
    ----------
    words : str
        Help of both.

    Returns
    -------
    list of Option
    """
    how: dict[str, Any] = {"type": positive, "metavar": "X", "help": words}
    return [option(f"--omega-{name.lower()}-hz", dest=f"omega_{name}_hz", **how) for name in "ST"]


def break_frequencies(options: argparse.Namespace) -> tuple[float, float] | None:
    """Read the break frequencies of the weights from parsed options.

    Parameters
    ----------
    options : argparse.Namespace

    Returns
    -------
    (ω_S, ω_T) in rad/s, or None where neither is given

    Raises
    ------
    UserError
        One of them is missing.
    """
    given = options.omega_S_hz, options.omega_T_hz
    if None not in given:
        return HZ * given[0], HZ * given[1]
    if given != (None, None):
        raise UserError(f"{options.case}: give both --omega-s-hz and --omega-t-hz, or neither")
    return None
