"""A drive's cascade sample by sample, from its parameters alone and written apart from the package.

Coefficients are made in 50 digits and then put into the drive's numbers; fixed point is Python's
integers, single precision one rounding after each operation.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np

Quadratic = tuple[float, float]  # Hz, damping


def coefficients(zeros: Quadratic, poles: Quadratic, rate_hz: float) -> list[mpmath.mpf]:
    """b0, b1, b2, a1, a2 of a general second-order filter that is exact at its two frequencies."""
    with mpmath.workdps(50):
        sides = []
        for hertz, damping in (zeros, poles):
            g = mpmath.tan(mpmath.pi * mpmath.mpf(hertz) / mpmath.mpf(rate_hz))  # Ω T/2
            d = 2 * mpmath.mpf(damping) * g
            sides.append([(g * g + d + 1) / g**2, 2 * (g * g - 1) / g**2, (g * g - d + 1) / g**2])
        above, below = sides
        return [*(c / below[0] for c in above), below[1] / below[0], below[2] / below[0]]


def exactly(number: mpmath.mpf, steps_per_one: int) -> int:
    """The nearest integer number of steps."""
    with mpmath.workdps(50):
        return int(mpmath.nint(number * steps_per_one))


def fixed_filter(c: Sequence[int], grain: Fraction) -> Callable[[float], float]:
    """y of u, both of a float, inside integers of `grain` with 30 bits of fraction."""
    u1 = u2 = y1 = y2 = 0

    def step(u: float) -> float:
        nonlocal u1, u2, y1, y2
        exact = Fraction(u) / grain
        near = round(exact)  # ties to even
        total = c[0] * near + c[1] * u1 + c[2] * u2 - c[3] * y1 - c[4] * y2
        y = total // 2**30
        u1, u2, y1, y2 = near, u1, y, y1
        return float(Fraction(y) * grain)

    return step


def float_filter(c: Sequence[Any]) -> Callable[[Any], Any]:
    """The same in the floating point of its coefficients, from the left to the right."""
    old = [c[0] * 0] * 4

    def step(u: Any) -> Any:
        y = c[0] * u
        y = y + c[1] * old[0]
        y = y + c[2] * old[1]
        y = y - c[3] * old[2]
        y = y - c[4] * old[3]
        old[1], old[0], old[3], old[2] = old[0], u, old[2], y
        return y

    return step


def controller(
    gains: tuple[float, float, float], setpoint: list[Callable[[Any], Any]],
    current: list[Callable[[Any], Any]], rate_hz: float, real: Callable[[Any], Any],
    slower: int = 1, ahead: tuple[float, float] = (0.0, 0.0),
) -> Callable[[float, float, float], Any]:  # fmt: skip
    """u of (reference, position, motor), call after call: Kv in 1/s, Kp, Tn in s; `ahead`: the
    share of the reference's velocity, and kg of its acceleration, that are fed forward."""
    Kv, Kp, Tn = gains
    share, rate = real(1.0 / rate_hz / Tn), real(rate_hz)
    s: dict[str, Any] = {"integral": real(0.0), "before": None, "call": 0, "fast": real(0.0)}
    per_call = real(ahead[1] * rate_hz)

    def step(reference: float, position: float, motor: float) -> Any:
        if s["call"] % slower == 0:
            s["read"] = real(Kv) * (real(reference) - real(position))
        s["call"] += 1
        to = real(reference)
        s.setdefault("from", to)
        fast = (to - s["from"]) * rate
        wanted, s["from"] = s["read"] + real(ahead[0]) * fast, to
        for one in setpoint:
            wanted = one(wanted)
        here = real(motor)
        speed = (here - (here if s["before"] is None else s["before"])) * rate
        s["before"] = here
        error = wanted - speed
        s["integral"] = s["integral"] + share * error
        u = real(Kp) * (error + s["integral"]) + per_call * (fast - s["fast"])
        s["fast"] = fast
        for one in current:
            u = one(u)
        return u

    return step


def force(
    gains: tuple[float, float, float], setpoint: list[Callable[[Any], Any]],
    current: list[Callable[[Any], Any]], rate_hz: float, real: Callable[[Any], Any],
    signals: np.ndarray, slower: int = 1, ahead: tuple[float, float] = (0.0, 0.0),
) -> list[Any]:  # fmt: skip
    """u of rows (reference, position, motor)."""
    step = controller(gains, setpoint, current, rate_hz, real, slower, ahead)
    return [step(*row) for row in signals.tolist()]
