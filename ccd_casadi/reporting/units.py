"""Units for the eye: what is stored in SI, shown in the unit that an engineer would read."""

SMALL = 0.5  # m; a length below it reads better in mm


def shown_unit(unit: str, largest: float) -> tuple[str, float]:
    """The unit to show values of this size in, and the factor to it.

    >>> shown_unit("m", 4e-3), shown_unit("kg", 4e-3)
    (('mm', 1000.0), ('kg', 1.0))
    """
    return ("mm", 1e3) if unit == "m" and abs(largest) < SMALL else (unit, 1.0)
