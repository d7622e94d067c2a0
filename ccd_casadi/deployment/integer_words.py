"""What integers of a deployed controller are, add and may spoil, in words."""

from math import isfinite

from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.deployment.fixed_point import FixedPoint
from ccd_casadi.deployment.integer_loop import RoundingBound
from ccd_casadi.deployment.on_hardware import UNLIMITED, OnHardware
from ccd_casadi.support.text import spoken, with_unit


def rounding_finding(found: RoundingBound) -> Finding:
    """What integers add.

    Parameters
    ----------
    found : RoundingBound

    Returns
    -------
    Finding
    """
    why = Reason.ROUNDING if isfinite(found.largest) else Reason.ROUNDING_UNKNOWN
    return why(bits=found.bits, largest=found.largest)


def integer_words(
    fixed: FixedPoint | None, rounding: RoundingBound | None, moved: OnHardware | None
) -> tuple[str, ...]:
    """What the integers of the code are, what they add, and what they may spoil.

    Parameters
    ----------
    fixed, rounding, moved : FixedPoint, RoundingBound, OnHardware or None

    Returns
    -------
    tuple of str
        Lines; empty of floating point.
    """
    if fixed is None:
        return ()
    counts = [
        f"{name} {' and '.join(f'{step:.3g}' for step in dict.fromkeys(steps.tolist()))} {unit}"
        for name, steps, unit in (("e", fixed.errors, "m"), ("u", fixed.forces, "N"))
    ]
    count = spoken(f"a count of {', of '.join(counts)}")
    first = f"{fixed.bits} bits, saturating; {count}; coefficients judged as rounded"
    faults = integer_faults(rounding, moved)
    added = () if faults or rounding is None else (rounding_finding(rounding).words(),)
    return first, *added, *faults


def integer_faults(rounding: RoundingBound | None, moved: OnHardware | None) -> tuple[str, ...]:
    """What integers may spoil: a move that saturates a word, roundings that leave its window.

    Parameters
    ----------
    rounding, moved : RoundingBound, OnHardware or None

    Returns
    -------
    tuple of str
    """
    if rounding is None or moved is None:
        return ()
    parts = []
    if not rounding.largest <= moved.window:
        window = with_unit(moved.window, spoken("m"))
        beyond = f", beyond its window, {window}" if isfinite(rounding.largest) else ""
        parts.append(f"{rounding_finding(rounding).words()}{beyond}")
    full = [name for name, move in moved.ways.items() if name in UNLIMITED and move.saturated]
    if full:
        parts.append(f"a move saturates words of {rounding.bits} bits ({full[0]})")
    return tuple(parts)
