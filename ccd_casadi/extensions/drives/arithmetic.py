"""A cascade's difference equations as they run: in Python, and the same as C.

Counts of the encoders in, force out. Of the setpoint r the velocity is added to what the position
controller wants, and the acceleration times the mass to the PI's force:

    v = F_s (Kv e + f (r_k - r_{k-1})/T),   u = F_c (PI(v - v_m) + m (r_k - 2r_{k-1} + r_{k-2})/T²)

With f = 1 and m the rigid mass the error falls with the jerk no more: what the delays leave follows
the fourth derivative. Gains and the PI compute in the drive's floating point; a fixed-point filter
takes and gives integers of `grain` N, its exact sum of products shifted right by 30, towards minus
infinity; the C does so in 64 bits by halves of the coefficients.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ccd_casadi.extensions.drives.cascade import Cascade
from ccd_casadi.extensions.drives.drive_data import Number
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import template


@dataclass(frozen=True)
class ArithmeticOptions:
    """What the drive's file does not say.

    Attributes
    ----------
    grain : float
        N, of an integer of a fixed-point filter's signal.
    bits : int
        Of its coefficients' fraction.
    distance, seconds, rest : float
        m and s of the move that is simulated, and s of what follows.
    """

    grain: float = 2.0**-20
    bits: int = 30
    distance: float = 0.01
    seconds: float = 0.2
    rest: float = 0.1


@dataclass(frozen=True)
class Program:
    """Numbers of one cascade's program, in the order in which they are used.

    Attributes
    ----------
    kind : Number
    real : type
        The floating point.
    Kv, Kp, share, rate : float
        1/s; N s/m; T/Tn; 1/T.
    setpoint, current : tuple of (b0, b1, b2, a1, a2)
        Filters; integers where the drive has fixed point.
    options : ArithmeticOptions
    slower : int
        Calls to one of the position loop.
    ahead, push : float
        f, and m/T in kg/s.
    """

    kind: Number
    real: type
    Kv: float
    Kp: float
    share: float
    rate: float
    setpoint: tuple[tuple[Any, ...], ...]
    current: tuple[tuple[Any, ...], ...]
    options: ArithmeticOptions
    slower: int = 1
    ahead: float = 0.0
    push: float = 0.0

    def run(self, reference: Array, position: Array, motor: Array) -> list[Any]:
        """Force at every instant, of the reference and both sensors in m as the drive has them."""
        step = self.started()
        return [step(*row) for row in zip(reference, position, motor, strict=True)]

    def started(self) -> Callable[[float, float, float], Any]:
        """The program at rest: the force of (r, y, m), call after call."""
        real = self.real
        states = {id(own): [0, 0, 0, 0] if self._fixed else [real(0)] * 4
                  for own in (*self.setpoint, *self.current)}  # fmt: skip
        last, before, speed, total, held, call = None, None, real(0), real(0), real(0), 0

        def step(reference: float, position: float, motor: float) -> Any:
            nonlocal last, before, speed, total, held, call
            r, m = real(reference), real(motor)
            last, before = m if last is None else last, r if before is None else before
            if call % self.slower == 0:
                held = real(self.Kv) * (r - real(position))
            call += 1
            fast = (r - before) * real(self.rate)
            v = held + real(self.ahead) * fast
            for own in self.setpoint:
                v = self._filtered(own, states[id(own)], v)
            w = v - (m - last) * real(self.rate)
            total = total + real(self.share) * w
            u = real(self.Kp) * (w + total) + real(self.push) * (fast - speed)
            last, before, speed = m, r, fast
            for own in self.current:
                u = self._filtered(own, states[id(own)], u)
            return u

        return step

    @property
    def _fixed(self) -> bool:
        return self.kind is Number.FIXED_30

    def _filtered(self, own: tuple[Any, ...], state: list[Any], u: Any) -> Any:
        """y_k of u_k; `state`: u and y of the two instants before."""
        b0, b1, b2, a1, a2 = own
        grain = self.options.grain
        x = round(float(u) / grain) if self._fixed else u
        y = b0 * x + b1 * state[0] + b2 * state[1] - a1 * state[2] - a2 * state[3]
        if self._fixed:
            y >>= self.options.bits
        state[:] = [x, state[0], y, state[2]]
        return self.real(y * grain) if self._fixed else y

    def code(self, title: str) -> str:
        """The same as one C99 file: `cascade_step(state, r, y, m)`."""
        real = "float" if self.real is np.float32 else "double"

        def value(x: Any) -> str:
            return f"{float(x)!r}{'f' if real == 'float' else ''}"

        filters = (*self.setpoint, *self.current)
        gains = ("Kv", "Kp", "share", "rate", "ahead", "push")
        return template("extensions/drives/templates/cascade.c").render(
            title=title, slower=self.slower, real=real, number="int64_t" if self._fixed else real,
            grain=repr(self.options.grain), half=self.options.bits // 2, count=len(filters),
            rows=[[str(int(x)) if self._fixed else value(x) for x in row] for row in filters],
            setpoint=len(self.setpoint), **{name: value(getattr(self, name)) for name in gains},
        )  # fmt: skip


def program_of(
    cascade: Cascade, values: Array, ahead: tuple[float, float] = (0.0, 0.0),
    options: ArithmeticOptions = ArithmeticOptions(),
) -> Program:  # fmt: skip
    """The program of a cascade with rounded values (SI); `ahead`: f, and m in kg."""
    kind = cascade.drive.number
    real = np.float32 if kind is Number.SINGLE else float

    def held(c: float) -> Any:
        return round(c * 2**options.bits) if kind is Number.FIXED_30 else real(c)

    own = {place: tuple(tuple(map(held, (*b.tolist(), *a[1:].tolist()))) for b, a in each)
           for place, each in cascade.coefficients(values).items()}  # fmt: skip
    Kv, Kp, Tn = (float(value) for value in values[:3])
    share, rate = float(real(cascade.period / Tn)), float(real(1.0 / cascade.period))
    return Program(kind, real, float(real(Kv)), float(real(Kp)), share, rate,
                   own["setpoint"], own["current"], options,
                   cascade.slower, float(real(ahead[0])),
                   float(real(ahead[1] / cascade.period)))  # fmt: skip


def following_error(program: Program, plant: StateSpace, position: int, velocity: int) -> float:
    """How far in m the position is behind its setpoint at most, in a simulated move.

    The setpoint is the polynomial of seventh order from rest to rest; sensors are exact. `plant`:
    from force to all sensors at the program's rate; `position`, `velocity`: their numbers.
    """
    o, step, x, worst = program.options, program.started(), np.zeros(len(plant.A)), 0.0
    for k in range(round((o.seconds + o.rest) * program.rate)):
        t = min(k / program.rate / o.seconds, 1.0)
        r = o.distance * t**4 * (35.0 - 84.0 * t + 70.0 * t**2 - 20.0 * t**3)
        y = plant.C @ x
        worst = max(worst, abs(r - y[position]))
        x = plant.A @ x + plant.B[:, 0] * float(step(r, y[position], y[velocity]))
    return float(worst)
