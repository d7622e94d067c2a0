"""A drive's cascade as one controller of the position and the motor's sensor.

    v = F_s(z) Kv e,   w = v - (1 - 1/z)/T y_m,   u = F_c(z) Kp (1 + T/Tn 1/(1 - 1/z)) w

e = r - y_p is the error of the position's sensor, y_m the motor's: its velocity is the difference
of its counts. F_s are filters of the velocity setpoint, F_c those of the current command. As
K = [K_p, K_m] both sensors' gains are tied by the same PI and filters.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from ccd_casadi.extensions.drives.drive_data import FORMS, PLACES, Drive, Filter, Setting, Slot
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ

Values = Sequence[float] | Array  # SI, in the order of the settings


class Polynomials(NamedTuple):
    """K as products of polynomials in 1/z: K_j = Π above_j/(Π below (1 - 1/z)), of which the
    motor's is above times (1 - 1/z). Multiplied out they would lose digits next to z = 1."""

    position: tuple[Array, ...]
    velocity: tuple[Array, ...]
    below: tuple[Array, ...]


@dataclass(frozen=True)
class Cascade:
    """Which of a drive's blocks are used, and on which sensors.

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
        """Which settings are frequencies of filters."""
        return np.array([setting.unit == "Hz" for setting in self.settings])

    def allowed(self, values: Values) -> Array:
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
        for place, at, F, steep in self._filtered(values, z):
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

    def _filtered(
        self, values: Values, z: np.ndarray
    ) -> Iterator[tuple[str, slice, np.ndarray, np.ndarray]]:
        """Of every filter its place, where its values are, F (k,) and ∂ln F/∂ln values (n, k)."""
        at = 3
        for slot, block, own in zip(self.slots, self.filters, self.parts(values), strict=True):
            F, steep = block.response(own, z)
            yield slot.place, slice(at, at + len(steep)), F, steep
            at += len(steep)

    def rises(self, values: Values, z: np.ndarray) -> tuple[Array, Array]:
        """ln of the gain of all filters behind the motor's sensor and behind the position's (2, k),
        and its slopes to ln values (n, 2, k)."""
        found, slopes = np.zeros((2, len(z))), np.zeros((len(self.settings), 2, len(z)))
        for place, at, F, steep in self._filtered(values, z):
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
