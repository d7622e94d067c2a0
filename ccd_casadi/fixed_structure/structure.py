"""A controller of fixed structure: gain, integrator, leads, biquads, roll-off.

    K(s) = k (1 + ω_i/s) Π (1 + s/z)/(1 + s/p) Π q(s; ω_z, ζ_z)/q(s; ω_p, ζ_p) · 1/r(s)
    q(s; ω, ζ) = 1 + 2ζ s/ω + s²/ω²,   r of order `roll_off`

The parameters κ are the logarithms of k, ω_i, z, p, ω_z, ζ_z, ω_p, ζ_p and of the roll-off's
frequency and damping ratio: all positive, so K is stable (but the integrator) and of minimum phase
by construction. κ has the units of what it is multiplied with: everything here is blind to them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

import numpy as np

from ccd_casadi.kernels.sections import GAIN, INTEGRATOR, PAIR, REAL
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError
from ccd_casadi.support.text import HZ


class ParameterKind(StrEnum):
    """The kind of a controller's parameter, which determines its unit.

    Attributes
    ----------
    GAIN, FREQUENCY, DAMPING
        N/m, rad/s, and a ratio.
    """

    GAIN = "gain"
    FREQUENCY = "frequency"
    DAMPING = "damping"


@dataclass(frozen=True)
class Structure:
    """Number of sections of each kind in K(s).

    Parameters
    ----------
    integrator : bool
        Whether K has one, with a zero.
    lead, biquads, roll_off : int
        First-order leads, pairs of zeros and poles, order of the roll-off.
    least_damping : float
        Of the biquads' zeros and poles.
    slowest_zero_hz : float
        Least |zero| of K; above 0 no biquad's zeros are two real ones. The loop has poles beside
        slow zeros of K, and what a constant force moved decays with them; 0 for any.
    """

    integrator: bool = True
    lead: int = 1
    biquads: int = 2
    roll_off: int = 2
    least_damping: float = 0.0
    slowest_zero_hz: float = 0.0
    # Ratios: below the first a notch is a needle; at the second two real roots are 34 times apart.
    dampings: ClassVar[tuple[float, float]] = (1e-3, 3.0)
    least_roll_off_damping: ClassVar[float] = 0.3  # below it a roll-off is a resonance

    def __post_init__(self) -> None:
        for name in ("lead", "biquads", "roll_off"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}; give 0 or more sections")
        if not 0.0 <= self.least_damping < self.dampings[1]:
            raise ValueError(f"least_damping is {self.least_damping}; give a ratio from 0 to 1")
        if not 0.0 <= self.slowest_zero_hz < np.inf:
            raise ValueError(f"slowest_zero_hz is {self.slowest_zero_hz}; give Hz, or 0 for none")

    def identity(self) -> dict[str, object]:
        """Return its values; those that came later only where they are not the default."""
        later = {"slowest_zero_hz": 0.0}
        return {key: value for key, value in vars(self).items() if value != later.get(key)}

    @property
    def order(self) -> int:
        """The number of states of K."""
        return int(self.integrator) + self.lead + 2 * self.biquads + self.roll_off

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters in the order of κ."""
        found = ["gain"] + ["integrator"] * self.integrator
        for i in range(1, self.lead + 1):
            found += [f"lead {i} zero", f"lead {i} pole"]
        for i in range(1, self.biquads + 1):
            for root in ("zeros", "poles"):
                found += [f"biquad {i} {root}", f"biquad {i} {root} damping"]
        for i in range(1, self.roll_off // 2 + 1):
            found += [f"roll-off {i}", f"roll-off {i} damping"]
        if self.roll_off % 2:
            found.append("roll-off real")
        return tuple(found)

    @property
    def kinds(self) -> tuple[ParameterKind, ...]:
        """The kind of each parameter."""
        return tuple(
            ParameterKind.GAIN
            if name == "gain"
            else ParameterKind.DAMPING
            if "damping" in name
            else ParameterKind.FREQUENCY
            for name in self.names
        )

    @property
    def factors(self) -> np.ndarray:
        """(f, 3) as `kernels.sections` has them: kind, +1 above or -1 below, first parameter."""
        found, at = [], 0
        kinds = [(GAIN, 1)] + [(INTEGRATOR, 1)] * self.integrator
        kinds += [(REAL, sign) for _ in range(self.lead) for sign in (1, -1)]
        kinds += [(PAIR, sign) for _ in range(self.biquads) for sign in (1, -1)]
        kinds += [(PAIR, -1)] * (self.roll_off // 2) + [(REAL, -1)] * (self.roll_off % 2)
        for kind, sign in kinds:
            found.append((kind, sign, at))
            at += 2 if kind == PAIR else 1
        return np.array(found, np.int64)

    def bounds(
        self, frequencies: tuple[float, float], gains: tuple[float, float], omega_0: float
    ) -> Array:
        """Lower and upper bounds (2, n) of κ for frequencies and gains within these; frequencies
        in units of `omega_0` (rad/s)."""
        least, most = max(self.least_damping, self.dampings[0]), self.dampings[1]
        slowest = max(frequencies[0], HZ * self.slowest_zero_hz / omega_0)
        if slowest >= frequencies[1]:
            fastest = f"{frequencies[1] * omega_0 / HZ:.4g} Hz"
            words = f"slowest_zero_hz is {self.slowest_zero_hz:g}; K has no root above {fastest}"
            raise PlantError(f"{words}: give less")
        found = []
        for name, kind in zip(self.names, self.kinds, strict=True):
            of_zeros = name == "integrator" or "zero" in name
            if kind is ParameterKind.GAIN:
                found.append(gains)
            elif kind is ParameterKind.FREQUENCY:
                found.append((slowest, frequencies[1]) if of_zeros else frequencies)
            elif of_zeros and self.slowest_zero_hz:
                found.append((least, max(least, 1.0)))
            elif name.startswith("roll-off"):
                found.append((max(least, self.least_roll_off_damping), most))
            else:
                found.append((least, most))
        return np.log(np.array(found).T)

    def in_units(self, kappa: Array, frequency: float, gain: float) -> Array:
        """κ with frequencies times `frequency` and the gain times `gain`."""
        shift = dict(zip(ParameterKind, (np.log(gain), np.log(frequency), 0.0), strict=True))
        return kappa + np.array([shift[kind] for kind in self.kinds])

    def integrates(self, error: int | None) -> bool:
        """Whether S falls to zero towards 0 Hz."""
        return self.integrator

    @property
    def structures(self) -> "tuple[Structure, ...]":
        """The structures of its channels: itself."""
        return (self,)

    @property
    def slices(self) -> tuple[slice, ...]:
        """The slice of κ with each channel's parameters."""
        return (slice(0, len(self.names)),)

    @property
    def directions(self) -> tuple[Array, Array]:
        """U (p, c) of outputs and V (m, c) of inputs of its channels."""
        return np.eye(1), np.eye(1)

    def split(self, kappa: Array) -> "Iterator[tuple[Structure, Array]]":
        """The structure and the parameters of each channel."""
        yield self, kappa

    def response(self, kappa: Array, s: np.ndarray) -> np.ndarray:
        """K(s), of the shape of s; `kappa` (n,) or (n, ...) with trailing axes that go with s's."""
        values = np.exp(kappa)
        K = values[0] * np.ones_like(s)
        for kind, sign, at in self.factors[1:].tolist():
            x = values[at] / s if kind == INTEGRATOR else s / values[at]
            factor = 1.0 + 2.0 * values[at + 1] * x + x * x if kind == PAIR else 1.0 + x
            K = K * factor if sign > 0 else K / factor
        return K

    def roots(self, kappa: Array) -> tuple[np.ndarray, np.ndarray]:
        """The zeros and the poles of K, the integrator's pole included."""
        values = np.exp(kappa)
        zeros: list[complex] = []
        poles: list[complex] = [0.0] * self.integrator
        for kind, sign, at in self.factors[1:].tolist():
            found = _pair(values[at], values[at + 1]) if kind == PAIR else [-values[at]]
            (zeros if sign > 0 else poles).extend(found)
        return np.array(zeros, complex), np.array(poles, complex)

    def state_space(self, kappa: Array) -> StateSpace:
        """K as a real cascade of its sections, e to u; every section in its own scale."""
        return StateSpace(*(part[0] for part in self.state_spaces(np.asarray(kappa, float)[None])))

    def state_spaces(self, kappa: Array) -> tuple[Array, Array, Array, Array]:
        """The cascades of many parameters κ (N, n): A (N, o, o), B (N, o, 1), C (N, 1, o), D.

        Analytic in κ, which may be complex: a step along the imaginary axis gives derivatives.
        """
        kappa = np.asarray(kappa)
        values, at, count = np.exp(kappa).T, 1, len(kappa)
        A, B, C = np.zeros((count, 0, 0)), np.zeros((count, 0, 1)), np.zeros((count, 1, 0))
        D = values[0][:, None, None] * np.ones((count, 1, 1))

        def append(a: list, b: list, c: list, d: object) -> None:
            """The next section behind what there is: u of it is y of the one before."""
            nonlocal A, B, C, D
            k, n = len(b), A.shape[1]
            a_, b_ = _stack(a, values), _stack([[x] for x in b], values)
            c_, d_ = _stack([c], values), _stack([[d]], values)
            joint = np.zeros((count, n + k, n + k), values.dtype)
            joint[:, :n, :n], joint[:, n:, n:], joint[:, n:, :n] = A, a_, b_ @ C
            A, B = joint, np.concatenate([B, b_ @ D], axis=1)
            C, D = np.concatenate([d_ @ C, c_], axis=2), d_ @ D

        if self.integrator:
            append([[0.0]], [values[1]], [1.0], 1.0)
            at = 2
        for _ in range(self.lead):
            z, p = values[at], values[at + 1]
            append([[-p]], [p], [1.0 - p / z], p / z)
            at += 2
        for _ in range(self.biquads):
            wz, dz, wp, dp = values[at : at + 4]
            g = (wp / wz) ** 2
            c = [1.0 - g, 2.0 * g * (dz * wz - dp * wp) / wp]
            append([[0.0, wp], [-wp, -2.0 * dp * wp]], [0.0, wp], c, g)
            at += 4
        for _ in range(self.roll_off // 2):
            w, d = values[at], values[at + 1]
            append([[0.0, w], [-w, -2.0 * d * w]], [0.0, w], [1.0, 0.0], 0.0)
            at += 2
        if self.roll_off % 2:
            append([[-values[at]]], [values[at]], [1.0], 0.0)
        return A, B, C, D


def _pair(omega: float, zeta: float) -> list[complex]:
    root = np.sqrt(complex(zeta**2 - 1.0))
    slow = -omega / (zeta + root) if zeta > 1.0 else omega * (-zeta + root)
    return [slow, omega**2 / slow]


def _stack(entries: list, like: Array) -> Array:
    """(N, p, m) of entries that are numbers or (N,), of the type of `like` (n, N)."""
    out = np.empty((like.shape[1], len(entries), len(entries[0])), like.dtype)
    for i, row in enumerate(entries):
        for j, entry in enumerate(row):
            out[:, i, j] = entry
    return out
