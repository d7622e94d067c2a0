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
    def _often(self) -> str:
        return "" if self.slower == 1 else f"; the position is read at every {self.slower}th call"

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
        number = "int64_t" if self._fixed else real
        suffix = "f" if real == "float" else ""

        def value(x: Any) -> str:
            return str(int(x)) if self._fixed else f"{float(x)!r}{suffix}"

        rows = [f"    {{{', '.join(map(value, own))}}}" for own in (*self.setpoint, *self.current)]
        count, n = len(rows), len(self.setpoint)
        inside = ("x = u", "c[0] * x + c[1] * s[0] + c[2] * s[1] - c[3] * s[2] - c[4] * s[3]", "y")
        if self._fixed:  # of a whole product 64 bits hold no more than 8 kN
            half = self.options.bits // 2
            inside = ("x = llrint(u / GRAIN)",
                      f"(PRODUCTS(>> {half}) + (PRODUCTS(& {2**half - 1}) >> {half})) >> {half}",
                      "(real)(y * GRAIN)")  # fmt: skip
        gains = [
            f"{float(g)!r}{suffix}"
            for g in (self.Kv, self.Kp, self.share, self.rate, self.ahead, self.push)
        ]
        return f"""/* {title}: position, velocity and filters of a drive,
   one call each period{self._often}.
   cc -std=c99 -O2 -ffp-contract=off; right shifts of negative integers are arithmetic. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define GRAIN {self.options.grain!r}
#define PRODUCTS(part) ((c[0] part) * x + (c[1] part) * s[0] + (c[2] part) * s[1] \\
    - (c[3] part) * s[2] - (c[4] part) * s[3])
typedef {real} real;
typedef {number} number;
typedef struct {{
    real last, total, held, before, speed;
    int begun, call;
    number old[{max(count, 1)}][4];
}} cascade_state;

static const number FILTERS[{max(count, 1)}][5] = {{
{("," + chr(10)).join(rows) or "    {0}"}
}};

static real filtered(const number *c, number *s, real u)
{{
    number {inside[0]};
    number y = {inside[1]};
    s[1] = s[0]; s[0] = x; s[3] = s[2]; s[2] = y;
    return {inside[2]};
}}

void cascade_reset(cascade_state *s) {{ memset(s, 0, sizeof *s); }}

/* r, y: setpoint and sensor of the position, m: the motor's sensor, m; the force, N. */
real cascade_step(cascade_state *s, real r, real y, real m)
{{
    real v, w, u, fast;
    int i;
    if (s->call == 0) s->held = {gains[0]} * (r - y);
    s->call = (s->call + 1) % {self.slower};
    if (!s->begun) {{ s->last = m; s->before = r; s->begun = 1; }}
    fast = (r - s->before) * {gains[3]};
    s->before = r;
    v = s->held + {gains[4]} * fast;
    for (i = 0; i < {n}; i++) v = filtered(FILTERS[i], s->old[i], v);
    w = v - (m - s->last) * {gains[3]};
    s->last = m;
    s->total = s->total + {gains[2]} * w;
    u = {gains[1]} * (w + s->total) + {gains[5]} * (fast - s->speed);
    s->speed = fast;
    for (i = {n}; i < {count}; i++) u = filtered(FILTERS[i], s->old[i], u);
    return u;
}}
"""


def program_of(
    cascade: Cascade, values: Array, ahead: tuple[float, float] = (0.0, 0.0),
    options: ArithmeticOptions = ArithmeticOptions(),
) -> Program:  # fmt: skip
    """The program of a cascade with rounded values.

    Parameters
    ----------
    cascade, values : Cascade, array (n,)
        SI.
    ahead : (float, float)
        f, and m in kg; 0: no feedforward.
    options : ArithmeticOptions

    Returns
    -------
    Program
    """
    kind = cascade.drive.number
    real = np.float32 if kind is Number.SINGLE else float
    own: dict[str, list[tuple[Any, ...]]] = {"setpoint": [], "current": []}
    for slot, block, part in zip(cascade.slots, cascade.filters, cascade.parts(values),
                                 strict=True):  # fmt: skip
        b, a = block.coefficients(part)
        numbers = [*b.tolist(), *a[1:].tolist()]
        if kind is Number.FIXED_30:
            own[slot.place].append(tuple(round(c * 2**options.bits) for c in numbers))
        else:
            own[slot.place].append(tuple(real(c) for c in numbers))
    Kv, Kp, Tn = (float(value) for value in values[:3])
    share, rate = float(real(cascade.period / Tn)), float(real(1.0 / cascade.period))
    return Program(kind, real, float(real(Kv)), float(real(Kp)), share, rate,
                   tuple(own["setpoint"]), tuple(own["current"]), options,
                   cascade.slower, float(real(ahead[0])),
                   float(real(ahead[1] / cascade.period)))  # fmt: skip


def following_error(program: Program, plant: StateSpace, position: int, velocity: int) -> float:
    """Simulate a move and find how far the position is behind its setpoint at most.

    The setpoint is the polynomial of seventh order from rest to rest. Sensors are exact.

    Parameters
    ----------
    program : Program
    plant : StateSpace
        From force to all sensors at the program's rate (`lti.loop.sampled`).
    position, velocity : int
        Numbers of the sensors.

    Returns
    -------
    float
        m.
    """
    o, step, x, worst = program.options, program.started(), np.zeros(len(plant.A)), 0.0
    for k in range(round((o.seconds + o.rest) * program.rate)):
        t = min(k / program.rate / o.seconds, 1.0)
        r = o.distance * t**4 * (35.0 - 84.0 * t + 70.0 * t**2 - 20.0 * t**3)
        y = plant.C @ x
        worst = max(worst, abs(r - y[position]))
        x = plant.A @ x + plant.B[:, 0] * float(step(r, y[position], y[velocity]))
    return float(worst)
