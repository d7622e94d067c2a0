"""Measured frequency responses: a plant as its lines, read from files and from python-control."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ccd_casadi.plants.phase_direction import Rise, rise_of, turned_words
from ccd_casadi.plants.response_table import read_table
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ

DERIVATIVES = {1: "a mobility (velocity over force); divide it by j 2π f",
               2: "an accelerance (acceleration over force); divide it by -(2π f)²"}  # fmt: skip


@dataclass(frozen=True)
class MeasuredResponseOptions:
    """Numbers by which a measured response is read."""

    decades_below: int = 3  # that a response is extrapolated below its first line
    per_decade: int = 25  # lines of that
    derivative_gap: float = 0.35  # of slope (1) and angle (rad) from a time derivative's at most
    first_lines: float = 1.5  # over the first: up to there the slope gives the poles at 0
    peak: float = 1.0  # prominence of a resonance in ln |G|


@dataclass(frozen=True)
class MeasuredResponse:
    """A measured frequency response, force to displacement.

    Attributes
    ----------
    hz : array (k,)
        Rising frequencies of the lines, Hz.
    G : array (k,) or (k, p, m)
        Response in m/N at the lines.
    unstable_poles : int
        Number of unstable poles of G.
    poles_at_zero : int, optional
        n of G ~ (jω)^-n below the first line; by default from the slope of the first lines.
    modelled : bool
        Whether the lines are those of a model, which decides what they leave open.
    spread : array, optional
        Of repeated measurements, m/N, shape of G: each entry is within it of the plant's.
    words : str
        How a file was understood.
    least_damping : float
        Least damping ratio of a resonance: one between two lines shows on them or is harmless.
    undamped_hz : tuple of float
        Poles of G on the axis, Hz.
    options : MeasuredResponseOptions
        Of every response.

    Raises
    ------
    UserError
        The numbers are not a response.
    """

    hz: Array
    G: np.ndarray
    unstable_poles: int = 0
    poles_at_zero: int | None = None
    modelled: bool = False
    spread: Array | None = None
    words: str = field(default="", compare=False)
    least_damping: float = 5e-4
    undamped_hz: tuple[float, ...] = ()
    options: ClassVar[MeasuredResponseOptions] = MeasuredResponseOptions()

    def _not_finite(self) -> str:
        """Where the first number is that is not finite."""
        lines = np.flatnonzero(~np.isfinite(self.hz))
        if lines.size:
            return f"has no frequency at line {lines[0] + 1}"
        line, out, into = np.argwhere(~np.isfinite(self.matrix))[0]
        at = f"is not finite at {self.hz[line]:.6g} Hz"
        return at if self.G.ndim == 1 else f"{at}, output {out + 1}, input {into + 1}"

    def __post_init__(self) -> None:
        shape = self.G.shape
        if self.spread is not None and (
            self.spread.shape != shape or not (self.spread >= 0.0).all()
        ):
            raise UserError(
                "the spread of a measured response needs one value, 0 or more, for each"
            )
        if self.hz.ndim != 1 or len(self.hz) < 5 or shape[:1] != self.hz.shape or (
            len(shape) not in (1, 3)
        ):  # fmt: skip
            raise UserError("a measured response needs five lines or more, one value at each")
        if not (np.isfinite(self.hz).all() and np.isfinite(self.G).all()):
            raise UserError(f"a measured response {self._not_finite()}; drop that line")
        if self.hz[0] <= 0.0 or (np.diff(self.hz) <= 0.0).any():
            raise UserError("the lines of a measured response have to rise from above 0 Hz")
        still = self.matrix == 0.0
        for where, dead in (
            ("", still.all(axis=(1, 2))[:, None]),
            (" in output {}, whatever the input", still.all(axis=2)),
            (" in every output of input {}", still.all(axis=1)),
        ):
            if dead.any():
                line, number = np.argwhere(dead)[0]
                at = f"{self.hz[line]:.6g} Hz{where.format(number + 1)}"
                raise UserError(f"a measured response is 0 at {at}; drop that line")

    @property
    def matrix(self) -> np.ndarray:
        """G (k, p, m)."""
        return self.G if self.G.ndim == 3 else self.G[:, None, None]

    @cached_property
    def slope(self) -> int:
        """n of G ~ (jω)^-n below the first line."""
        if self.poles_at_zero is not None:
            return self.poles_at_zero
        return max(0, round(self._fall))

    @cached_property
    def _fall(self) -> float:
        """-d ln|G|/d ln f of the first lines."""
        many = max(3, int(np.searchsorted(self.hz, self.options.first_lines * self.hz[0])))
        size = np.linalg.norm(self.matrix[:many], axis=(1, 2))
        return -float(np.polyfit(np.log(self.hz[:many]), np.log(size), 1)[0])

    @property
    def derivative(self) -> str:
        """The time derivative of the displacement that its first lines are, in words: their slope
        and angle agree; empty where of none."""
        order = round(-self._fall)
        angle = float(np.angle((self.matrix[0] * (-1j) ** order).sum()))
        most = self.options.derivative_gap
        rises = order in DERIVATIVES and abs(order + self._fall) < most and abs(angle) < most
        return DERIVATIVES[order] if rises else ""

    @cached_property
    def static(self) -> np.ndarray:
        """R (p, m), real, of G ~ R (f₁/jf)^n below the first line f₁."""
        return np.asarray((self.matrix[0] * 1j**self.slope).real)

    @property
    def unsure(self) -> Array:
        """‖Δ‖ (k,) of the spread Δ, m/N, the largest singular value: that of every E within it is
        no larger. 0 without a spread."""
        if self.spread is None:
            return np.zeros(len(self.hz))
        return np.asarray(np.linalg.norm(self.spread.reshape(self.matrix.shape), 2, axis=(1, 2)))

    @property
    def resonances(self) -> np.ndarray:
        """The lines (indices) of the peaks of |G|, the strongest first."""
        return self._extremes(1.0)

    @property
    def antiresonances(self) -> np.ndarray:
        """The antiresonances among its dips, the deepest first."""
        return self._extremes(-1.0)

    def _extremes(self, sign: float) -> np.ndarray:
        from scipy.signal import find_peaks  # slow to import, and every command imports this module

        size = sign * np.log(np.linalg.norm(self.matrix, axis=(1, 2)))
        at, found = find_peaks(size, prominence=self.options.peak)
        return np.asarray(at[np.argsort(-found["prominences"])])

    @property
    def gap(self) -> float:
        """The angle (rad) between G at the first line and its asymptote there."""
        turned = self.matrix[0] * 1j**self.slope
        return float(np.arctan2(np.linalg.norm(turned.imag), np.linalg.norm(turned.real)))

    def rise(self, to_hz: float) -> Rise:
        """Compute by how much the angle of det G rises up to `to_hz`, more than that of a stable G
        of this size: each unstable pole there adds half a turn."""
        used = self.hz <= to_hz
        many = max(3, int(np.searchsorted(self.hz, self.options.first_lines * self.hz[0])))
        if used.sum() < many or self.matrix.shape[1] != self.matrix.shape[2]:
            return Rise(0.0, np.nan, np.nan)
        return rise_of(self.hz[used], np.linalg.det(self.matrix[used]))

    def require_causal(self) -> None:
        """Raise UserError where its phase rises as that of no stable causal plant.

        Raises
        ------
        UserError
            Its conjugate may be meant, or unstable poles are not stated.
        """
        if self.modelled:
            return
        where = turned_words(self.hz, self.matrix, self.resonances, self.unstable_poles)
        if where:
            raise UserError(
                f"the phase of the measured response rises {where}: is the sign of the phase or of "
                "im turned (e^-jwt)? turn it; or state unstable poles (--unstable-poles, "
                "unstable_poles)"
            )

    @cached_property
    def followed(self) -> "MeasuredResponse":
        """The response with three decades more below the first line, where it turns into its
        asymptote."""
        hz, first = self.hz, self.matrix[0]
        decades = self.options.decades_below
        count = self.options.per_decade * decades + 1
        below = np.geomspace(10.0**-decades * hz[0], hz[0], count)[:-1]
        turned = np.clip(1.0 + np.log10(below / hz[0]), 0.0, 1.0)[:, None, None]  # in a decade
        start = self.static * (-1j) ** self.slope
        lower = (start + turned * (first - start)) * ((below / hz[0]) ** -self.slope)[:, None, None]
        G = np.concatenate([lower, self.matrix])
        return replace(self, hz=np.append(below, hz), G=G, spread=None)

    def at(self, hz: float) -> np.ndarray:
        """G (p, m) between the lines, straight over ln f."""
        whole, x = self.followed, np.log(hz)
        lines = np.log(whole.hz)
        i = int(np.clip(np.searchsorted(lines, x), 1, len(lines) - 1))
        share = np.clip((x - lines[i - 1]) / (lines[i] - lines[i - 1]), 0.0, 1.0)
        return np.asarray((1.0 - share) * whole.G[i - 1] + share * whole.G[i])

    def entry(self, left: Array, right: Array, most: int) -> "MeasuredResponse":
        """leftᵀ G right as a response of one channel, on about `most` of the lines."""
        every = slice(None, None, 1 + len(self.hz) // most)
        G = np.einsum("p,kpm,m->k", left, self.matrix[every], right)
        return replace(self, hz=self.hz[every], G=G, poles_at_zero=self.slope, spread=None)


def read_frequency_response(path: str | Path) -> MeasuredResponse:
    """Read a measured frequency response.

    Parameters
    ----------
    path : path
        CSV with a header of f_hz and re, im (or magnitude or magnitude_db, and phase_deg or
        phase_rad), or .mat or .npz with these names or with f_hz and a complex G. Beside them there
        may be the `spread` of repeated measurements and, in .mat or .npz, the text `unit` of G.

    Returns
    -------
    MeasuredResponse
        G in m/N at its lines; of several channels (k, p, m), .mat and .npz only.

    Raises
    ------
    UserError
        Something is missing, not understood or may mean two plants, and what.
    """
    found = read_table(Path(path))
    try:
        return MeasuredResponse(found.hz, found.G, spread=found.spread, words=found.words)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def from_control(system: Any) -> MeasuredResponse:
    """Convert a python-control FRD.

    Parameters
    ----------
    system : control.FrequencyResponseData
        Frequencies in rad/s, response in m/N.

    Returns
    -------
    MeasuredResponse
    """
    data = np.moveaxis(np.asarray(system.frdata), -1, 0).astype(complex)
    one = data.shape[1:] == (1, 1)
    return MeasuredResponse(np.asarray(system.omega, float) / HZ, data[:, 0, 0] if one else data)
