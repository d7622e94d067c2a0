"""Units and numbers in words: SI inside, and the one factor that is everywhere."""

import math

HZ = 2.0 * math.pi  # rad/s in one hertz


def metres(value: float, digits: int = 3) -> str:
    """A length in m in the unit that an engineer would read it in.

    >>> metres(4.1e-5), metres(0.01), metres(-2.5e-10), metres(0.0)
    ('41 um', '10 mm', '-0.25 nm', '0 m')
    """
    if value == 0.0:
        return "0 m"
    for factor, unit in ((1.0, "m"), (1e3, "mm"), (1e6, "um")):
        if abs(value) * factor >= 1.0:
            return f"{factor * value:.{digits}g} {unit}"
    return f"{1e9 * value:.{digits}g} nm"


def counted(number: int, noun: str) -> str:
    """A number of things.

    >>> counted(1, "plant"), counted(5, "plant")
    ('1 plant', '5 plants')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"
