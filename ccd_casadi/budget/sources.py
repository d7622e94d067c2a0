"""What moves a stage that should stand still, and where each of it enters the loop.

    force         d in N, where the actuator acts             e = -G S d,   u = -T d
    floor motion  x_f in m, as d = (m s² + c s + k) x_f       e = -G S d,   u = -T d
    sensor noise  n in m, on what the controller reads        e = T n,      u = -KS n
    setpoint      r in m                                      e = S r,      u = KS r

e = r - y is the error of the true position, not of the measured one. With several channels each
has a source of its own, independent of the others, of the same spectrum.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from ccd_casadi.budget.spectra import ShapedSpectrum, TabulatedSpectrum
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ


class Kind(StrEnum):
    """Where a source enters."""

    FORCE = "force"
    FLOOR_MOTION = "floor_motion"
    SENSOR_NOISE = "sensor_noise"
    SETPOINT = "setpoint"


@dataclass(frozen=True)
class Source:
    """One independent source: N²/Hz of a force, m²/Hz of any other.

    `path` (m, c, k) in kg, N s/m, N/m carries floor motion to a force; with `of_acceleration` the
    floor's spectrum is one of its acceleration, in (m/s²)²/Hz. Raises ValueError for floor motion
    that reaches nothing, a filter that is not proper, and a shaped setpoint that does not fall off.
    """

    name: str
    kind: Kind
    spectrum: TabulatedSpectrum | ShapedSpectrum
    path: tuple[float, float, float] = (0.0, 0.0, 0.0)
    of_acceleration: bool = False

    def __post_init__(self) -> None:
        floor = self.kind is Kind.FLOOR_MOTION
        if floor != any(self.path) or min(self.path) < 0.0:
            raise ValueError("floor motion needs a mass, a damping or a stiffness it acts through")
        if not isinstance(self.spectrum, ShapedSpectrum):
            return
        if self.of_acceleration and any(self.path[1:]):
            words = "a filter of the floor's acceleration acts through a mass only"
            raise ValueError(f"{words}; give its displacement, or a table")
        self.shaping()
        if self.kind is Kind.SETPOINT and self.spectrum.relative_degree < 1:
            raise ValueError("the spectrum of a setpoint has to fall off; give poles_hz")

    @property
    def unit(self) -> str:
        """Of the square root of the spectrum's integral."""
        if self.kind is Kind.FORCE:
            return "N"
        return "m/s^2" if self.of_acceleration else "m"

    @property
    def shaped(self) -> bool:
        """Whether it is white noise through a filter, not a table."""
        return isinstance(self.spectrum, ShapedSpectrum)

    def density(self, hz: Array) -> Array:
        """The one-sided density over Hz of what enters the loop: force, noise or setpoint."""
        found = self.spectrum.at(hz)
        if self.kind is not Kind.FLOOR_MOTION:
            return found
        s = 2j * np.pi * np.asarray(hz, float)
        power = -2 if self.of_acceleration else 0
        m, c, k = self.path
        return np.asarray(found * np.abs((m * s**2 + c * s + k) * s**power) ** 2)

    def shaping(self) -> StateSpace:
        """The filter from white noise (one-sided 1/Hz) to what enters the loop."""
        assert isinstance(self.spectrum, ShapedSpectrum)
        if self.kind is not Kind.FLOOR_MOTION:
            return self.spectrum.filter()
        if self.of_acceleration:
            return self.spectrum.filter((self.path[0],))
        return self.spectrum.filter(self.path)

    def corners(self) -> Array:
        """Frequencies in rad/s at which the density bends: a table's points, a filter's roots."""
        if isinstance(self.spectrum, TabulatedSpectrum):
            return HZ * np.array(self.spectrum.hz)
        roots = [corner[0] for corner in (*self.spectrum.zeros, *self.spectrum.poles)]
        return HZ * np.array(roots, float)

    def times(self, factor: float) -> "Source":
        """The same source with `factor` times the amplitude."""
        spectrum = self.spectrum
        if isinstance(spectrum, ShapedSpectrum):
            return replace(self, spectrum=replace(spectrum, level=factor**2 * spectrum.level))
        density = tuple(factor**2 * value for value in spectrum.density)
        return replace(self, spectrum=replace(spectrum, density=density))


@dataclass(frozen=True)
class ErrorBudget:
    """Independent sources, and the window in s of moving average and standard deviation."""

    sources: tuple[Source, ...]
    window: float | None = None

    def __post_init__(self) -> None:
        if not self.sources:
            raise ValueError("an error budget needs a source")
        if self.window is not None and not self.window > 0.0:
            raise ValueError(f"the window is {self.window} s; give a time above 0")
