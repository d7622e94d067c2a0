"""What moves a stage that should stand still, and where each of it enters the loop.

    force         d in N, where the actuator acts             e = -G S d,   u = -T d
    floor motion  x_f in m, as d = (m s² + c s + k) x_f       e = -G S d,   u = -T d
    sensor noise  n in m, on what the controller reads        e = T n,      u = -KS n
    setpoint      r in m                                      e = S r,      u = KS r

e = r - y is the error of the true position, not of the measured one. Behind an actuator a(s) and
before a sensor c(s), with G = c g a, d acts on the mechanics g, n enters behind c, r is compared
with what c gives, e = r - z counts z = g (a u + d), and the force is a u. With several channels
each has a source of its own, independent of the others, of the same spectrum.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ

Corner = tuple[float, ...]  # (Hz,) of a real root, (Hz, damping ratio) of a pair


@dataclass(frozen=True)
class TabulatedSpectrum:
    """S at given frequencies; S ~ f^β between two of them, 0 outside.

    Attributes
    ----------
    hz : tuple of float
        Rising, two or more.
    density : tuple of float
        Above 0.

    Raises
    ------
    ValueError
        Fewer than two points, frequencies that do not rise, or values of S that are not above 0.
    """

    hz: tuple[float, ...]
    density: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.hz) != len(self.density) or len(self.hz) < 2:
            raise ValueError("a table of a spectrum needs two points or more")
        if not (np.isfinite(self.hz).all() and np.isfinite(self.density).all()):
            raise ValueError("a table of a spectrum holds finite numbers only")
        if self.hz[0] <= 0.0 or (np.diff(self.hz) <= 0.0).any():
            raise ValueError("the frequencies of a table have to rise, from above 0 Hz")
        if min(self.density) <= 0.0:
            raise ValueError("the densities of a table have to be above 0; leave out what is not")

    def at(self, hz: Array) -> Array:
        """S at frequencies in Hz."""
        x = np.log(np.maximum(hz, 1e-300))
        inside = (hz >= self.hz[0]) & (hz <= self.hz[-1])
        return np.where(inside, np.exp(np.interp(x, np.log(self.hz), np.log(self.density))), 0.0)

    def rms(self) -> float:
        """The root of ∫ S df, each straight line between two points in closed form."""
        f, S = np.array(self.hz), np.array(self.density)
        beta = np.diff(np.log(S)) / np.diff(np.log(f)) + 1.0
        x = beta * np.diff(np.log(f))
        grown = np.where(np.abs(x) < 1e-8, 1.0 + 0.5 * x, np.expm1(x) / np.where(x == 0.0, 1.0, x))
        return float(np.sqrt((S[:-1] * f[:-1] * np.diff(np.log(f)) * grown).sum()))


@dataclass(frozen=True)
class ShapedSpectrum:
    """S = level |Π_z (1 + s/z) / Π_p (1 + s/p)|² at s = 2πjf, pairs as 1 + 2ζ s/ω + s²/ω².

    Zeros and poles are (Hz,) or (Hz, damping ratio); without any the spectrum is white. Raises
    ValueError for a level or a root that is not positive.
    """

    level: float
    zeros: tuple[Corner, ...] = ()
    poles: tuple[Corner, ...] = ()

    def __post_init__(self) -> None:
        if not (self.level > 0.0 and np.isfinite(self.level)):
            raise ValueError(f"the level of a spectrum is {self.level}; give a number above 0")
        for corner in (*self.zeros, *self.poles):
            if len(corner) not in (1, 2) or not all(value > 0.0 for value in corner):
                raise ValueError(f"{corner} is not a corner; give (Hz,) or (Hz, damping), above 0")

    @property
    def relative_degree(self) -> int:
        """The number of poles beyond the zeros."""
        return sum(map(len, self.poles)) - sum(map(len, self.zeros))

    def at(self, hz: Array) -> Array:
        """S at frequencies in Hz."""
        s = 2j * np.pi * np.asarray(hz, float)
        top, bottom = polynomial(self.zeros, 1.0), polynomial(self.poles, 1.0)
        return np.asarray(self.level * np.abs(np.polyval(top, s) / np.polyval(bottom, s)) ** 2)

    def rms(self) -> float | None:
        """The root of ∫ S df; None where it is infinite."""
        if self.relative_degree < 1:
            return None
        f = self.filter()
        P = solve_continuous_lyapunov(f.A, -0.5 * f.B @ f.B.T)
        return float(np.sqrt((f.C @ P @ f.C.T)[0, 0]))

    def filter(self, path: tuple[float, ...] = (1.0,)) -> StateSpace:
        """The shaping filter times a polynomial in s, highest power first; time in s.

        Raises ValueError where the product is not proper.
        """
        corners = [corner[0] for corner in self.poles]
        unit = HZ * float(np.exp(np.mean(np.log(corners)))) if corners else 1.0
        scaled = np.array(path) * unit ** np.arange(len(path) - 1, -1, -1.0)
        top = np.polymul(polynomial(self.zeros, unit), scaled)
        bottom = polynomial(self.poles, unit)
        top = np.trim_zeros(np.atleast_1d(top), "f") * np.sqrt(self.level)
        if len(top) > len(bottom):
            raise ValueError("a shaping filter needs as many poles as zeros; give more poles")
        # The controller canonical form; SciPy's is 0.4 s to import, in every process.
        n, top = len(bottom) - 1, np.pad(top, (len(bottom) - len(top), 0)) / bottom[0]
        A, row = np.eye(n, k=-1), -bottom[1:] / bottom[0]
        A[:1] = row
        C = (top[1:] + top[0] * row)[None]
        return StateSpace(unit * A, unit * np.eye(n, 1), C, top[:1, None])


def polynomial(corners: Iterable[Corner], unit: float) -> Array:
    """Multiply the factors 1 + s/ω (one corner), 1 + 2ζ s/ω + s²/ω² (a pair).

    Parameters
    ----------
    corners : iterable of Corner
        (Hz,) or (Hz, damping ratio).
    unit : float
        Unit of s, rad/s.

    Returns
    -------
    array
        Coefficients, highest power first.
    """
    out: Array = np.ones(1)
    for corner in corners:
        x = unit / (HZ * corner[0])
        factor = [x, 1.0] if len(corner) == 1 else [x * x, 2.0 * corner[1] * x, 1.0]
        out = np.asarray(np.polymul(out, factor), float)
    return out


class SourceKind(StrEnum):
    """The place where a source enters the loop.

    Attributes
    ----------
    FORCE
        At the plant's input, N.
    FLOOR_MOTION
        Through mass, damping and stiffness at the plant's input, m or m/s².
    SENSOR_NOISE, SETPOINT
        At the measured output, and the reference, m.
    """

    FORCE = "force"
    FLOOR_MOTION = "floor_motion"
    SENSOR_NOISE = "sensor_noise"
    SETPOINT = "setpoint"


@dataclass(frozen=True)
class ErrorSource:
    """One independent source of a budget.

    Attributes
    ----------
    name : str
    kind : SourceKind
    spectrum : TabulatedSpectrum or ShapedSpectrum
        One-sided density: N²/Hz of a force, m²/Hz of any other.
    path : tuple (m, c, k)
        kg, N s/m, N/m: transmits floor motion to a force.
    of_acceleration : bool
        The floor's spectrum is that of its acceleration, (m/s²)²/Hz.

    Raises
    ------
    ValueError
        Floor motion has no path, a filter is not proper, or a shaped setpoint does not fall off.
    """

    name: str
    kind: SourceKind
    spectrum: TabulatedSpectrum | ShapedSpectrum
    path: tuple[float, float, float] = (0.0, 0.0, 0.0)
    of_acceleration: bool = False

    def __post_init__(self) -> None:
        floor = self.kind is SourceKind.FLOOR_MOTION
        if floor != any(self.path) or min(self.path) < 0.0:
            raise ValueError("floor motion needs a mass, a damping or a stiffness it acts through")
        if not isinstance(self.spectrum, ShapedSpectrum):
            return
        if self.of_acceleration and any(self.path[1:]):
            words = "a filter of the floor's acceleration acts through a mass only"
            raise ValueError(f"{words}; give its displacement, or a table")
        self.shaping()
        if self.kind is SourceKind.SETPOINT and self.spectrum.relative_degree < 1:
            raise ValueError("the spectrum of a setpoint has to fall off; give poles_hz")

    @property
    def unit(self) -> str:
        """The unit of the square root of the spectrum's integral."""
        if self.kind is SourceKind.FORCE:
            return "N"
        return "m/s^2" if self.of_acceleration else "m"

    @property
    def shaped(self) -> bool:
        """Whether it is white noise through a filter, not a table."""
        return isinstance(self.spectrum, ShapedSpectrum)

    def density(self, hz: Array) -> Array:
        """The one-sided density over Hz of what enters the loop: force, noise or setpoint."""
        found = self.spectrum.at(hz)
        if self.kind is not SourceKind.FLOOR_MOTION:
            return found
        s = 2j * np.pi * np.asarray(hz, float)
        power = -2 if self.of_acceleration else 0
        m, c, k = self.path
        return np.asarray(found * np.abs((m * s**2 + c * s + k) * s**power) ** 2)

    def shaping(self) -> StateSpace:
        """The filter from white noise (one-sided 1/Hz) to what enters the loop."""
        assert isinstance(self.spectrum, ShapedSpectrum)
        if self.kind is not SourceKind.FLOOR_MOTION:
            return self.spectrum.filter()
        return self.spectrum.filter(self.path[:1] if self.of_acceleration else self.path)

    def corners(self) -> Array:
        """Frequencies in rad/s at which the density bends: a table's points, a filter's roots."""
        if isinstance(self.spectrum, TabulatedSpectrum):
            return HZ * np.array(self.spectrum.hz)
        roots = [corner[0] for corner in (*self.spectrum.zeros, *self.spectrum.poles)]
        return HZ * np.array(roots, float)


@dataclass(frozen=True)
class ErrorBudget:
    """Independent sources of error.

    Attributes
    ----------
    sources : tuple of ErrorSource
    window : float or None
        Of moving average and standard deviation, s.
    """

    sources: tuple[ErrorSource, ...]
    window: float | None = None

    def __post_init__(self) -> None:
        if not self.sources:
            raise ValueError("an error budget needs a source")
        if self.window is not None and not self.window > 0.0:
            raise ValueError(f"the window is {self.window} s; give a time above 0")
