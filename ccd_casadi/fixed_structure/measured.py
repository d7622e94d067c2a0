"""A measured frequency response as the plant: read, and a controller judged on its lines.

Bounds are looked at on every line. Between two lines L = GK is taken to lie within r of the chord,

    r = h²/8 max|L''|,   L'' by the second differences at both ends and one line further:

the error of linear interpolation, where L bends between two lines no more than around them. A
resonance that fits between two lines is not seen. With it |S| <= 1/(distance of -1 to the chord
less r).

Stability is the winding of 1 + GK. Over all ω > 0 its angle grows by

    Δ = (π/2)(q + 2P - 2Z)

with Z poles of the closed loop and P of GK in the right half plane, q of GK at 0 (counted so are
stable ones far below the first line, where |L| >> 1). P is given. Z is sure under assumptions
written out in `words`: below the first line 1 + GK goes on as (jω)^-q, above the last line |L|
stays below 1, and between the lines L lies within r of the chords, which do not touch -1.
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.units import HZ

HALF_POWER = 2.0**-0.5
GAP = np.pi / 4.0  # of the angle at the first line to its asymptote, above which Z is not sure
LARGE, SMALL = 2.0, 0.5  # |L| at the first line at least, at the last at most
FIGURES = ("S_peak", "S_peak_frequency", "S_between", "S_low", "bandwidth", "KS", "T", "GS",
           "weighted_KS", "weighted_T")  # fmt: skip
COLUMNS = {"f_hz": "hz", "hz": "hz", "frequency_hz": "hz", "re": "re", "im": "im", "real": "re",
           "imag": "im", "magnitude": "size", "magnitude_db": "db", "phase_deg": "deg",
           "phase_rad": "rad"}  # fmt: skip


@dataclass(frozen=True)
class MeasuredResponse:
    """G (k,) in m/N at rising lines (k,) in Hz. Raises UserError where that is none."""

    hz: Array
    G: np.ndarray

    def __post_init__(self) -> None:
        if self.hz.ndim != 1 or self.hz.shape != self.G.shape or len(self.hz) < 5:
            raise UserError("a measured response needs five lines or more, one value at each")
        if not (np.isfinite(self.hz).all() and np.isfinite(self.G).all()):
            raise UserError("a measured response holds finite numbers only; drop the other lines")
        if self.hz[0] <= 0.0 or (np.diff(self.hz) <= 0.0).any():
            raise UserError("the lines of a measured response have to rise from above 0 Hz")
        if (self.G == 0.0).any():
            raise UserError("a measured response is 0 at a line; drop it")


@dataclass(frozen=True)
class MeasuredFigures:
    """A loop on its lines. Frequencies in rad/s, KS in N/m, GS in m/N; NaN where not stable.

    `right_half_plane`: Z. `sure`: whether the assumptions that the data can show hold. `S_between`
    bounds |S| between the lines by r, infinite where -1 may lie on the curve; `bandwidth` is the
    largest that the shape allows on the lines.
    """

    stable: bool
    sure: bool
    right_half_plane: int
    S_peak: float
    S_peak_frequency: float
    S_between: float
    S_low: float
    bandwidth: float
    KS: float
    T: float
    GS: float
    weighted_KS: float
    weighted_T: float
    words: str

    def over(self, bounds: Bounds) -> dict[str, float]:
        """Every bound's figure over the bound; above 1 where it is not met."""
        found = {"S_max": self.S_peak / bounds.S_max, "S_low": self.S_low / bounds.S_low}
        if bounds.weighted_level is not None:
            found["KS"] = self.weighted_KS / bounds.weighted_level
            found["T"] = self.weighted_T / bounds.weighted_level
        if bounds.compliance_max is not None:
            found["GS"] = self.GS / bounds.compliance_max
        return found


def read_frequency_response(path: str | Path) -> MeasuredResponse:
    """A CSV with a header of f_hz and re, im (or magnitude or magnitude_db, and phase_deg or
    phase_rad), or a .mat file with these names or with f_hz and a complex G.

    G is displacement over force, m/N. Raises UserError with what is missing.
    """
    path = Path(path)
    try:
        if path.suffix.lower() == ".mat":
            return _of_columns(_mat(path), path)
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if row and not row[0].lstrip().startswith("#")]
        names = [name.strip().lower() for name in rows[0]]
        table = np.array([[float(part) for part in row] for row in rows[1:]])
        columns = {COLUMNS.get(name, name): column for name, column in
                   zip(names, table.T, strict=True)}  # fmt: skip
    except (OSError, ValueError, IndexError) as error:
        reason = getattr(error, "strerror", None) or "it is no table of numbers with a header"
        raise UserError(f"{path}: cannot be read as a frequency response: {reason}") from None
    return _of_columns(columns, path)


def from_control(system: Any) -> MeasuredResponse:
    """Of a SISO python-control FRD (frequencies in rad/s)."""
    data = np.asarray(system.frdata)
    if data.shape[:2] != (1, 1):
        raise UserError("the frequency response is not SISO; take one channel of it")
    omega = np.asarray(system.omega, float)
    return MeasuredResponse(omega / HZ, data[0, 0].astype(complex))


def _mat(path: Path) -> dict[str, np.ndarray]:
    found = {}
    for name, value in loadmat(path).items():
        if not name.startswith("__"):
            found[COLUMNS.get(name.lower(), name)] = np.asarray(value).ravel()
    return found


def _of_columns(columns: dict[str, np.ndarray], path: Path) -> MeasuredResponse:
    if "hz" not in columns:
        raise UserError(f"{path}: has no column f_hz; name the frequencies so")
    hz = np.real(columns["hz"]).astype(float)
    if "G" in columns:
        return MeasuredResponse(hz, np.asarray(columns["G"], complex))
    if "re" in columns and "im" in columns:
        return MeasuredResponse(hz, columns["re"] + 1j * columns["im"])
    size = columns.get("size")
    if "db" in columns:
        size = 10.0 ** (columns["db"] / 20.0)
    angle = columns.get("rad")
    if "deg" in columns:
        angle = np.deg2rad(columns["deg"])
    if size is None or angle is None:
        words = "needs re and im, or magnitude (or magnitude_db) and phase_deg (or phase_rad)"
        raise UserError(f"{path}: {words}")
    return MeasuredResponse(hz, size * np.exp(1j * angle))


def controller_response(K: StateSpace, hz: Array, period: float | None = None) -> np.ndarray:
    """K at frequencies in Hz; with a period by Tustin's rule, without prewarping."""
    s = 1j * HZ * np.asarray(hz, float)
    if period is not None:
        s = 2j / period * np.tan(0.5 * HZ * np.asarray(hz, float) * period)
    whole = s[:, None, None] * np.eye(len(K.A)) - K.A
    return np.asarray((K.C @ np.linalg.solve(whole, K.B + 0j) + K.D)[:, 0, 0])


def judge(
    measured: MeasuredResponse,
    K: StateSpace,
    bounds: Bounds,
    *,
    period: float | None = None,
    unstable_poles: int = 0,
    poles_at_zero: int | None = None,
    integrator: bool = True,
) -> MeasuredFigures:
    """The figures of an SI controller (e in, u out) on the lines.

    `period` in s: K is sampled, and G was measured as the controller sees it, hold and delay in it.
    `unstable_poles`: P of G. `poles_at_zero`: q of L; by default by the slope of |L| at its first
    lines. `integrator`: the shape counts from 0 on, else from ω_low.
    """
    if period is not None and measured.hz[-1] > 0.5 / period:
        raise UserError("the lines reach beyond half the sampling rate; drop those above")
    k = controller_response(K, measured.hz, period)
    return judge_values(measured, k, bounds, unstable_poles=unstable_poles,
                        poles_at_zero=poles_at_zero, integrator=integrator)  # fmt: skip


def judge_values(
    measured: MeasuredResponse,
    k: np.ndarray,
    bounds: Bounds,
    *,
    unstable_poles: int = 0,
    poles_at_zero: int | None = None,
    integrator: bool = True,
) -> MeasuredFigures:
    """`judge` of a controller's values (k,) at the lines."""
    hz, G = measured.hz, measured.G
    L = G * k
    S = 1.0 / (1.0 + L)
    Z, sure, words = winding(hz, L, unstable_poles, poles_at_zero)
    if Z != 0:
        none = dict.fromkeys(FIGURES, np.nan)
        return MeasuredFigures(False, sure, Z, words=words, **none)
    omega = HZ * hz
    KS, T = np.nan, np.nan
    if bounds.weights is not None:
        _, W_KS, W_T = np.abs(bounds.weights.responses(omega))
        KS, T = float(np.abs(W_KS * k * S).max()), float(np.abs(W_T * L * S).max())
    ln_S = np.log(np.abs(S))
    at = int(np.argmax(ln_S))
    return MeasuredFigures(
        True, sure, 0, float(np.abs(S[at])), float(omega[at]),
        float((1.0 / np.maximum(clearances(hz, L), 1e-300)).max()),
        float(np.exp(np.interp(np.log(bounds.omega_low), np.log(omega), ln_S))),
        _bandwidth(omega, ln_S, bounds, integrator),
        float(np.abs(k * S).max()), float(np.abs(L * S).max()), float(np.abs(G * S).max()),
        KS, T, words,
    )  # fmt: skip


def clearances(hz: Array, L: np.ndarray) -> Array:
    """Least distance of -1 to L between neighbouring lines (k - 1,): to the chord, less r."""
    start, step = 1.0 + L[:-1], np.diff(L)
    size = np.abs(step) ** 2
    share = np.clip(-(start * step.conj()).real / np.where(size == 0.0, 1.0, size), 0.0, 1.0)
    return np.asarray(np.abs(start + share * step) - interpolation_errors(hz, L))


def interpolation_errors(hz: Array, L: np.ndarray) -> Array:
    """r between neighbouring lines (k - 1,), by second divided differences over ln f."""
    x = np.log(hz)
    slope = np.diff(L) / np.diff(x)
    second = np.abs(2.0 * np.diff(slope) / (x[2:] - x[:-2]))
    around = np.concatenate([second[:1], second, second[-1:]])  # at each line
    wider = np.maximum(np.append(around[1:], 0.0), np.insert(around[:-1], 0, 0.0))
    each = np.maximum(around, wider)
    return np.asarray(np.diff(x) ** 2 / 8.0 * np.maximum(each[:-1], each[1:]))


def winding(
    hz: Array, L: np.ndarray, unstable_poles: int = 0, poles_at_zero: int | None = None
) -> tuple[int, bool, str]:
    """Z, whether the data show the assumptions to hold, and these in words."""
    F = 1.0 + L
    q = poles_at_zero
    if q is None:
        many = max(3, int(np.searchsorted(hz, 1.5 * hz[0])))
        q = max(0, round(-float(np.polyfit(np.log(hz[:many]), np.log(np.abs(L[:many])), 1)[0])))
    begins = float(np.angle(F[0]))
    ends = -0.5 * np.pi * q + np.pi * np.arange(-4, 5)
    gap = float(np.min(np.abs(begins - ends)))
    first = float(ends[np.argmin(np.abs(begins - ends))])
    grown = (begins - first) + float(np.angle(F[1:] / F[:-1]).sum()) - float(np.angle(F[-1]))
    Z = round(unstable_poles + 0.5 * q - grown / np.pi)
    near = int((clearances(hz, L) <= 0.0).sum())
    doubts = []
    if gap > GAP or (q > 0 and abs(L[0]) < LARGE):
        doubts.append(f"the first line, {hz[0]:.4g} Hz, does not reach where GK is (jω)^-{q}")
    if abs(L[-1]) > SMALL:
        doubts.append(f"the last line, {hz[-1]:.4g} Hz, does not reach where |GK| is small")
    if near:
        doubts.append(f"between {near} pairs of lines GK may pass -1")
    head = "stable" if Z == 0 else f"unstable, {Z} poles in the right half plane"
    assumed = (
        f"{head} by the winding of 1 + GK, with {unstable_poles} unstable poles of G and GK as "
        f"(jω)^-{q} below the first line"
    )
    return Z, not doubts, "; ".join([assumed, *doubts])


def _bandwidth(omega: Array, ln_S: Array, bounds: Bounds, integrator: bool) -> float:
    """The largest ω_b with |S| <= min(1, shape ω/ω_b)/√2 on the lines below it."""
    level = np.log(HALF_POWER)
    above = np.flatnonzero(ln_S > level)
    crossing = float(omega[-1])
    if len(above):
        i = int(above[0])
        if i == 0:
            return 0.0
        share = (level - ln_S[i - 1]) / (ln_S[i] - ln_S[i - 1])
        crossing = float(np.exp(np.log(omega[i - 1]) + share * np.log(omega[i] / omega[i - 1])))
    if bounds.shape is None:
        return crossing
    counted = omega if integrator else np.maximum(omega, bounds.omega_low)
    below = omega <= crossing
    allowed = bounds.shape * counted[below] * HALF_POWER / np.exp(ln_S[below])
    return float(min(crossing, allowed.min()))
