"""A beam on two motors with two gauges: lift (z) and tilt, and its first two bending modes."""

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

LENGTH, WIDTH, DENSITY, YOUNG = 0.6, 0.12, 2700.0, 70e9  # an aluminium beam, SI
PAYLOAD = 3.0  # kg
ROOTS = (4.730041, 7.853205)  # β L of a free beam


def shapes(place: float) -> list[float]:
    """Of a free beam's first two modes, at so many lengths from its middle; modal masses as its."""
    even, odd = (root * place for root in ROOTS)
    half, other = (0.5 * root for root in ROOTS)
    return [
        float(np.cos(even) / np.cos(half) + np.cosh(even) / np.cosh(half)),
        float(np.sin(odd) / np.sin(other) + np.sinh(odd) / np.sinh(other)),
    ]


def beam(theta: Mapping[str, Any], zeta: float = 0.01, offset: float = 0.0) -> dict[str, Any]:
    """Motors a quarter of the beam from its middle, gauges at its ends, the payload `offset` m off.

    Coordinates: z, tilt, first and second bending mode; h is the beam's thickness in m.
    """
    h = theta["h"]
    mass = DENSITY * LENGTH * WIDTH * h
    speed = h / LENGTH**2 * (YOUNG / DENSITY / 12.0) ** 0.5
    first, second = (root**2 * speed for root in ROOTS)

    def at(place: float) -> list[float]:
        """What each coordinate moves a place by, that so many lengths from the middle."""
        return [1.0, place * LENGTH, *shapes(place)]

    carried = PAYLOAD * np.outer(at(offset / LENGTH), at(offset / LENGTH))
    return {
        "mass": ca.diag(mass * ca.DM([1.0, LENGTH**2 / 12.0, 1.0, 1.0])) + carried,
        "stiffness": ca.diag(ca.vertcat(0.0, 0.0, mass * first**2, mass * second**2)),
        "damping_ratio": zeta,
        "input": np.transpose([at(-0.25), at(0.25)]),
        "output": np.array([at(-0.5), at(0.5)]),
        "hardware_cost": mass,
    }
