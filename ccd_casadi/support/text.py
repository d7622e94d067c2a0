"""Units and numbers in words, texts that ship beside the sources, and versions."""

import importlib.metadata
import math
import platform
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment, Template


HZ = 2.0 * math.pi  # rad/s in one hertz
LARGE = (("G", 1e-9), ("M", 1e-6), ("k", 1e-3))


_spoken = {"m": "m", "N": "N"}


def use_units(output: str, input_: str) -> None:
    """Set the units of `spoken`, until the next problem is used.

    Parameters
    ----------
    output, input_ : str
        Of the plant's outputs and inputs, such as "m" and "N".
    """
    _spoken.update({"m": output, "N": input_})


def spoken(words: str) -> str:
    """Replace metres and newtons in a text by the units of the plant's outputs and inputs.

    Parameters
    ----------
    words : str

    Returns
    -------
    str

    Examples
    --------
    >>> spoken("1 N moves it 3 mm, 3 mm/N"), use_units("rad", "N m")
    ('1 N moves it 3 mm, 3 mm/N', None)
    >>> spoken("1 N moves it 3 mm, 3 mm/N; N/m"), use_units("m", "N")
    ('1 N m moves it 3 mrad, 3 mrad/(N m); N m/rad', None)
    >>> use_units("rad", "N m"), spoken("force (N)"), use_units("m", "N")
    (None, 'force (N m)', None)
    """
    output, force = _spoken["m"], _spoken["N"]
    words = re.sub(r"(?<!\w)([nµum]?)m(?!\w)", rf"\g<1>{output}", words)
    if force == "N":
        return words
    if force == "N m":
        words = re.sub(r"\bkg\b", "kg m²", words)
    words = re.sub(r"/N\b", f"/({force})" if " " in force else f"/{force}", words)
    return re.sub(r"(?<!\w)(?<!/\()([kMG]?)N\b", rf"\g<1>{force}", words)


def is_force(unit: str) -> bool:
    """Report whether the unit of an input is that of a force or a torque, which moves a mass.

    Parameters
    ----------
    unit : str

    Returns
    -------
    bool

    Examples
    --------
    >>> is_force("N"), is_force("N m"), is_force("V")
    (True, True, False)
    """
    return unit in ("N", "N m")


def of_newtons(unit: str) -> str:
    """Say on what a mass that is found from a response depends: inputs count as newtons where a
    case does not say what they are.

    Parameters
    ----------
    unit : str
        Of the input.

    Returns
    -------
    str
        To stand behind the mass; empty of a unit that a case has to declare.

    Examples
    --------
    >>> of_newtons("N"), of_newtons("N m")
    (' if its input is in N', '')
    """
    return " if its input is in N" if unit == "N" else ""


def display_unit(unit: str, largest: float) -> tuple[str, float]:
    """Choose the unit to show values in.

    Lengths, times, forces, stiffnesses and compliances get the SI prefix with which the largest is
    1 or more; another unit stays.

    Parameters
    ----------
    unit : str
        SI unit.
    largest : float
        Largest value to be shown.

    Returns
    -------
    unit : str
    factor : float
        From `unit` to the one returned.

    Examples
    --------
    >>> display_unit("m", 4e-3), display_unit("s", 2e-5), display_unit("kg", 4e-3)
    (('mm', 1000.0), ('µs', 1000000.0), ('kg', 1.0))
    >>> display_unit("N/m", 3.6e7), display_unit("m/N", 3e-6)
    (('MN/m', 1e-06), ('µm/N', 1000000.0))
    """
    if unit in ("N", "N/m", "N m", "N m/rad") and abs(largest) >= 1e4:
        prefix, factor = next(one for one in LARGE if abs(largest) * one[1] >= 1.0)
        return prefix + unit, factor
    if unit not in ("m", "s", "rad", "m/N", "rad/N m") or largest == 0.0:
        return unit, 1.0
    for prefix, factor in (("", 1.0), ("m", 1e3), ("µ", 1e6)):
        if abs(largest) * factor >= 0.9995:  # which rounds to 1
            return prefix + unit, factor
    return f"n{unit}", 1e9


def with_unit(value: float, unit: str, digits: int = 3) -> str:
    """Write a value in the unit that an engineer would read it in.

    Parameters
    ----------
    value : float
    unit : str
        SI unit.
    digits : int
        Significant digits.

    Returns
    -------
    str

    Examples
    --------
    >>> with_unit(4.1e-5, "m"), with_unit(0.01, "m"), with_unit(0.18, "s"), with_unit(0.0, "m")
    ('41 µm', '10 mm', '180 ms', '0 m')
    >>> with_unit(9.996e-7, "m")
    '1 µm'
    """
    read, factor = display_unit(unit, value)
    return f"{number(factor * value, digits)} {read}"


def plural(number: int, noun: str) -> str:
    """Write a number of things.

    Parameters
    ----------
    number : int
    noun : str
        Singular.

    Returns
    -------
    str

    Examples
    --------
    >>> plural(1, "plant"), plural(5, "plant")
    ('1 plant', '5 plants')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"


def of_a_bound(excess: float) -> str:
    """Write exp(excess) as a share of a bound; a large one as a multiple.

    Parameters
    ----------
    excess : float
        ln of figure over bound.

    Returns
    -------
    str

    Examples
    --------
    >>> of_a_bound(0.0), of_a_bound(-0.1), of_a_bound(10.0)
    ('100 % of a bound', '90.4837 % of a bound', '2.2e+04 times a bound')
    """
    if excess < math.log(10.0):
        return f"{100.0 * math.exp(excess):.6g} % of a bound"
    return f"{math.exp(min(excess, 700.0)):.3g} times a bound"


def small_share(share: float) -> str:
    """Write a relative error in per cent, below 1e-6 as "under 0.0001 %".

    Parameters
    ----------
    share : float

    Returns
    -------
    str

    Examples
    --------
    >>> small_share(0.0123), small_share(1.9e-9)
    ('1.2 %', 'under 0.0001 %')
    """
    return f"{100.0 * share:.2g} %" if share >= 1e-6 else "under 0.0001 %"


def number(value: Any, digits: int = 5) -> str:
    """Write a number, or a dash where there is none.

    Parameters
    ----------
    value : number, bool or None
    digits : int
        Significant digits.

    Returns
    -------
    str

    Examples
    --------
    >>> number(72.0451741), number(1.5e-9, 3), number(None), number(1800.0), number(999.6, 3)
    ('72.045', '1.5e-09', '–', '1800', '999.6')
    """
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    size = abs(float(value))
    if 1.0 <= size < 1e7:
        # never fewer digits than the whole part has: 110023 stays 110023
        digits = max(digits, len(str(round(size))))
    return f"{float(value):.{digits}g}"


def distinct_texts(values: Sequence[float], digits: int = 4) -> list[str]:
    """Write numbers with as many digits as keep unequal ones apart, six more than `digits` at most.

    Parameters
    ----------
    values : sequence of float
    digits : int
        Significant digits, at least.

    Returns
    -------
    list of str

    Examples
    --------
    >>> distinct_texts([0.2402, 0.2391, 0.23]), distinct_texts([288.571, 288.574])
    (['0.2402', '0.2391', '0.23'], ['288.571', '288.574'])
    """
    found: list[str] = []
    for more in range(digits, digits + 7):
        found = [number(value, more) for value in values]
        if len(set(found)) == len(set(values)):
            break
    return found


def inwards(value: float, digits: int, decimals: int) -> float:
    """Round towards zero, so that the end of a range that is shown lies in the range.

    Parameters
    ----------
    value : float
    digits, decimals : int
        Significant digits and decimals that are left at most.

    Returns
    -------
    float

    Examples
    --------
    >>> inwards(4.19, 2, 3), inwards(-0.0829, 2, 3), inwards(3.0 - 1e-15, 2, 2), inwards(1e-6, 2, 3)
    (4.1, -0.082, 3.0, 0.0)
    """
    if value == 0.0 or not math.isfinite(value):
        return value
    places = min(decimals, digits - 1 - math.floor(math.log10(abs(value) * (1.0 + 1e-9))))
    return round(math.trunc(value * (1.0 + 1e-9) * 10.0**places) / 10.0**places, max(places, 0))


PLAIN = (".c", ".h", ".md", ".st", ".txt")  # what no mark-up is in


def package_path(name: str) -> Path:
    """Find a file of the package.

    Parameters
    ----------
    name : str
        Path in the package.

    Returns
    -------
    Path
    """
    return Path(__file__).parents[1] / name


@cache
def package_text(name: str) -> str:
    """Read a text file of the package.

    Parameters
    ----------
    name : str
        Path in the package.

    Returns
    -------
    str
    """
    return package_path(name).read_text(encoding="utf-8")


def template(name: str, **known: Any) -> "Template":
    """Load a Jinja template.

    Parameters
    ----------
    name : str
        Path in the package.
    **known
        Functions that it calls.

    Returns
    -------
    jinja2.Template
    """
    return _templates().get_template(name, globals=known)


def printable(value: Any) -> Any:
    """Replace the control characters of a text; another value stays as it is.

    Parameters
    ----------
    value

    Returns
    -------
    str, or the value
    """
    if not isinstance(value, str) or hasattr(value, "__html__"):  # mark-up of our own
        return value
    return "".join(c if c.isprintable() or c in "\n\t\xa0" else "\ufffd" for c in value)


@cache
def _templates() -> "Environment":
    """Texts are escaped where there is mark-up, and a name that nobody gives is an error."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    made = Environment(
        loader=FileSystemLoader(package_path("")), undefined=StrictUndefined, finalize=printable,
        autoescape=lambda name: not str(name).endswith(PLAIN), trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    made.globals["spoken"] = spoken
    return made


PACKAGES = ("casadi", "numpy", "scipy", "control", "slycot", "scikit-learn", "numba")


def versions() -> dict[str, str]:
    """Collect the versions of Python and of the packages that the numbers depend on.

    Returns
    -------
    dict of str to str
    """
    found = {"python": platform.python_version(), "ccd-casadi": _version("ccd-casadi")}
    return found | {name: _version(name) for name in PACKAGES}


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
