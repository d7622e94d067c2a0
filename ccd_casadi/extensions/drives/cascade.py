"""A drive's cascade: one controller of the position and the motor's sensor, and its program.

    v = F_s(z) Kv e,   w = v - (1 - 1/z)/T y_m,   u = F_c(z) Kp (1 + T/Tn 1/(1 - 1/z)) w

e = r - y_p is the error of the position's sensor, y_m the motor's: its velocity is the difference
of its counts. F_s are filters of the velocity setpoint, F_c those of the current command. As
K = [K_p, K_m] both sensors' gains are tied by the same PI and filters.

Its difference equations as they run (`Program`), in Python and the same as C, take counts of the
encoders and give the force. Of the setpoint r the velocity is added to what the position controller
wants, and the acceleration times the mass to the PI's force:

    v = F_s (Kv e + f (r_k - r_{k-1})/T),   u = F_c (PI(v - v_m) + m (r_k - 2r_{k-1} + r_{k-2})/T²)

With f = 1 and m the rigid mass the error falls with the jerk no more: what the delays leave follows
the fourth derivative. Gains and the PI compute in the drive's floating point; a fixed-point filter
takes and gives integers of `grain` N, its exact sum of products shifted right by 30, towards minus
infinity; the C does so in 64 bits by halves of the coefficients.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag

from ccd_casadi.extensions.drives.drive_data import (
    FORMS,
    PLACES,
    Drive,
    Filter,
    Number,
    Setting,
    Slot,
)
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ, template

Values = Sequence[float] | Array  # SI, in the order of the settings


class Polynomials(NamedTuple):
    """K as products of polynomials in 1/z: K_j = Π above_j/(Π below (1 - 1/z)), of which the
    motor's is above times (1 - 1/z). Multiplied out they would lose digits next to z = 1."""

    position: tuple[Array, ...]
    velocity: tuple[Array, ...]
    below: tuple[Array, ...]


@dataclass(frozen=True)
class Cascade:
    """The blocks of a drive that are used, and the sensors they read.

    Attributes
    ----------
    drive : Drive
    period : float
        T, s.
    slots : tuple of Slot
        The filters in use.
    position, velocity, sensors : int
        Numbers of the sensors of position and of velocity, and how many there are.
    filter_gain : float
        What all filters on a sensor's way may raise at any frequency, relative to their gain at
        rest: without a limit they become leads that amplify noise.
    filters_above, decay : float
        Least frequency of a filter over ω_b; largest ω_b Tn and ω_b/Kv (`allowed`).
    slower : int
        N: the position's error is read at every N-th instant, and held between (`two_rates`).
    stiff_below : float
        rad/s up to which compliance_max holds.
    current : tuple of (Setting, float)
        Of a designed current loop (`drive_case`), SI.
    """

    drive: Drive
    period: float
    slots: tuple[Slot, ...]
    position: int
    velocity: int
    sensors: int
    filter_gain: float = np.inf
    filters_above: float = 2.0
    decay: float = 4.0
    slower: int = 1
    stiff_below: float = np.inf
    current: tuple[tuple[Setting, float], ...] = ()

    @cached_property
    def settings(self) -> tuple[Setting, ...]:
        """Every parameter, in the order of the values."""
        own = self.drive.position, self.drive.velocity, self.drive.integral
        filters = (slot.settings[k] for slot in self.slots for k in FORMS[slot.form].names)
        return (*own, *filters)

    @cached_property
    def filters(self) -> tuple[Filter, ...]:
        """The filters of the slots."""
        rule, number = self.drive.rule, self.drive.number
        return tuple(Filter(FORMS[slot.form], rule, number, self.period) for slot in self.slots)

    @property
    def ranges(self) -> Array:
        """Least and largest values (2, n), SI; frequencies below half the rate."""
        found = np.array([setting.range for setting in self.settings]).T
        found[1, self.hertz] = np.minimum(found[1, self.hertz], 0.49 / self.period)
        return found

    @cached_property
    def hertz(self) -> np.ndarray:
        """Whether each setting is the frequency of a filter."""
        return np.array([setting.unit == "Hz" for setting in self.settings])

    def allowed_bandwidths(self, values: Values) -> Array:
        """The ω_b that Kv, Tn and each filter's frequency allow.

        Filters an octave or more above ω_b shape resonances; beside it they take the place of the
        gains. A force that steps to F moves the load by F/(Kp Kv), and that decays with poles of
        the loop next to the zeros -1/Tn and -Kv of K: where these are slow the axis creeps back.
        So ω_b Tn <= a and ω_b/Kv <= a. The symmetric optimum has Tn = a/ω_c, a of 2 to 4, ω_c the
        crossover of the velocity loop.
        """
        by_filters = HZ * np.asarray(values)[self.hertz] / self.filters_above
        return np.concatenate([[self.decay * values[0], self.decay / values[2]], by_filters])

    def parts(self, values: Values) -> list[dict[str, float]]:
        """The parameters of each filter by name."""
        found, at = [], 3
        for slot in self.slots:
            names = FORMS[slot.form].names
            own = [float(value) for value in values[at : at + len(names)]]
            found.append(dict(zip(names, own, strict=True)))
            at += len(names)
        return found

    def responses(self, values: Values, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """K (p, k) before coefficients are rounded, and ∂K/∂ln values (n, p, k).

        Of a slower position loop the part that has the frequency of e: the hold over N instants
        is 1/N (1 - z⁻ᴺ)/(1 - 1/z).
        """
        Kv, Kp, Tn = (float(value) for value in values[:3])
        away, n = 1.0 - 1.0 / z, len(self.settings)
        lag = self.period / Tn / away
        base = Kp * (1.0 + lag)
        held = np.mean([z**-i for i in range(self.slower)], axis=0)
        slopes = np.zeros((2, n, len(z)), complex)  # of ln of the motor's path, and the position's
        slopes[1, 0] = slopes[:, 1] = 1.0
        slopes[:, 2] = -lag / (1.0 + lag)
        ahead = np.ones(len(z), complex)
        for place, at, F, steep in self._filter_responses(values, z):
            slopes[1, at] = steep
            if place == "current":
                base = base * F
                slopes[0, at] = steep
            else:
                ahead = ahead * F
        K, dK = np.zeros((self.sensors, len(z)), complex), np.zeros((n, self.sensors, len(z)),
                                                                    complex)  # fmt: skip
        paths = base * away / self.period, base * ahead * Kv * held
        for sensor, path, steep in zip((self.velocity, self.position), paths, slopes, strict=True):
            K[sensor] += path
            dK[:, sensor] += path * steep
        return K, dK

    def _filter_responses(
        self, values: Values, z: np.ndarray
    ) -> Iterator[tuple[str, slice, np.ndarray, np.ndarray]]:
        """Yield of every filter its place, where its values are, F (k,) and ∂ln F/∂ln values (n,
        k)."""
        at = 3
        for slot, block, own in zip(self.slots, self.filters, self.parts(values), strict=True):
            F, steep = block.response(own, z)
            yield slot.place, slice(at, at + len(steep)), F, steep
            at += len(steep)

    def rises(self, values: Values, z: np.ndarray) -> tuple[Array, Array]:
        """ln of the gain of all filters behind the motor's sensor and behind the position's (2, k),
        and its slopes to ln values (n, 2, k)."""
        found, slopes = np.zeros((2, len(z))), np.zeros((len(self.settings), 2, len(z)))
        for place, at, F, steep in self._filter_responses(values, z):
            ways = slice(0, 2) if place == "current" else slice(1, 2)
            found[ways] += np.log(np.abs(F))
            slopes[at, ways] += steep.real[:, None]
        return found, slopes

    def coefficients(self, values: Values) -> dict[str, list[tuple[Array, Array]]]:
        """b and a of the filters at each place, as the drive rounds them."""
        found: dict[str, list[tuple[Array, Array]]] = {place: [] for place in PLACES}
        for slot, block, own in zip(self.slots, self.filters, self.parts(values), strict=True):
            found[slot.place].append(block.coefficients(own))
        return found

    def polynomials(self, values: Values) -> Polynomials:
        """K with its coefficients as the drive rounds them."""
        Kv, Kp, Tn = (float(value) for value in values[:3])
        PI = Kp * np.array([1.0 + self.period / Tn, -1.0])
        used = self.coefficients(values)
        above = {place: [b for b, _ in each] for place, each in used.items()}
        below = {place: [a for _, a in each] for place, each in used.items()}
        return Polynomials(
            (Kv * PI, *above["current"], *above["setpoint"]),
            (PI / self.period, *above["current"], *below["setpoint"]),
            (*below["current"], *below["setpoint"]),
        )

    def state_space(self, values: Values) -> StateSpace:
        """K(z), errors of all sensors in, force out, coefficients as the drive rounds
        them; of a slower position loop e as it is held."""
        (Kv, Kp, Tn), T = map(float, values[:3]), self.period
        blocks = {place: [_second_order(b, a, T) for b, a in each]
                  for place, each in self.coefficients(values).items()}  # fmt: skip
        sensor = np.eye(self.sensors)
        reads, none = sensor[[self.velocity]], np.zeros((1, 0))
        position = StateSpace(none[:0], sensor[:0], none, Kv * sensor[[self.position]], period=T)
        for one in blocks["setpoint"]:
            position = position.series(one)
        # the motor's: w = (y_k - y_{k-1})/T
        motor = StateSpace(np.zeros((1, 1)), reads, np.array([[-1.0 / T]]), reads / T, period=T)
        found = StateSpace(
            block_diag(position.A, motor.A), np.vstack([position.B, motor.B]),
            np.hstack([position.C, motor.C]), position.D + motor.D, period=T,
        )  # fmt: skip
        share = Kp * T / Tn
        PI = StateSpace(np.eye(1), np.ones((1, 1)), np.array([[share]]), np.array([[Kp + share]]),
                        period=T)  # fmt: skip
        for one in (PI, *blocks["current"]):
            found = found.series(one)
        return found

    def require_fit(self, values: Values) -> None:
        """Raise UserError where the drive's numbers do not hold a filter's coefficients."""
        for slot, block, own in zip(self.slots, self.filters, self.parts(values), strict=True):
            if not block.fits(own):
                words = f"{slot.name}: a coefficient exceeds what {self.drive.number} holds"
                raise UserError(f"{words}; use fewer of these filters, or a lower S_max")


def _second_order(b: Array, a: Array, T: float) -> StateSpace:
    """The transposed direct form."""
    return StateSpace(np.array([[-a[1], 1.0], [-a[2], 0.0]]),
                      np.array([[b[1] - a[1] * b[0]], [b[2] - a[2] * b[0]]]),
                      np.array([[1.0, 0.0]]), np.array([[b[0]]]), period=T)  # fmt: skip


@dataclass(frozen=True)
class ArithmeticOptions:
    """Numbers of the arithmetic that the drive's file does not state."""

    grain: float = 2.0**-20  # N, of an integer of a fixed-point filter's signal
    bits: int = 30  # of its coefficients' fraction
    distance: float = 0.01  # m, of the move that is simulated
    seconds: float = 0.2  # that it takes
    rest: float = 0.1  # s of what follows


@dataclass(frozen=True)
class Program:
    """Numbers of one cascade's program, in the order in which they are used."""

    kind: Number
    real: type  # the floating point
    Kv: float  # 1/s
    Kp: float  # N s/m
    share: float  # T/Tn
    rate: float  # 1/T
    setpoint: tuple[tuple[Any, ...], ...]  # filters (b0, b1, b2, a1, a2); fixed point: int
    current: tuple[tuple[Any, ...], ...]  # the same
    options: ArithmeticOptions
    slower: int = 1  # calls to one of the position loop
    ahead: float = 0.0  # f
    push: float = 0.0  # m/T, kg/s

    def run(self, reference: Array, position: Array, motor: Array) -> list[Any]:
        """Force at every instant, of the reference and both sensors in m as the drive has them."""
        step = self.start()
        return [step(*row) for row in zip(reference, position, motor, strict=True)]

    def start(self) -> Callable[[float, float, float], Any]:
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
                v = self._filter(own, states[id(own)], v)
            w = v - (m - last) * real(self.rate)
            total = total + real(self.share) * w
            u = real(self.Kp) * (w + total) + real(self.push) * (fast - speed)
            last, before, speed = m, r, fast
            for own in self.current:
                u = self._filter(own, states[id(own)], u)
            return u

        return step

    @property
    def _fixed(self) -> bool:
        return self.kind is Number.FIXED_30

    def _filter(self, own: tuple[Any, ...], state: list[Any], u: Any) -> Any:
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
    """Compute the largest lag in m of the position behind its setpoint, in a simulated move.

    The setpoint is the polynomial of seventh order from rest to rest; sensors are exact. `plant`:
    from force to all sensors at the program's rate; `position`, `velocity`: their numbers.
    """
    o, step, x, worst = program.options, program.start(), np.zeros(len(plant.A)), 0.0
    for k in range(round((o.seconds + o.rest) * program.rate)):
        t = min(k / program.rate / o.seconds, 1.0)
        r = o.distance * t**4 * (35.0 - 84.0 * t + 70.0 * t**2 - 20.0 * t**3)
        y = plant.C @ x
        worst = max(worst, abs(r - y[position]))
        x = plant.A @ x + plant.B[:, 0] * float(step(r, y[position], y[velocity]))
    return float(worst)
