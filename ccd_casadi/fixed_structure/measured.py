"""A measured frequency response as the plant: read, and a controller judged on its lines.

Bounds are looked at on every line. Between two lines L = GK is taken to lie within r of the chord,

    r = 2 h²/8 max|L''|,   L'' by the second differences at both ends and one line further:

twice the error of linear interpolation, where L bends between two lines as around them. A
resonance that fits between two lines is not seen. With it |S| <= 1/(distance of -1 to the chord
less r).

Stability is the winding of 1 + GK. Over all ω > 0 its angle grows by

    Δ = (π/2)(q + 2P - 2Z)

with Z poles of the closed loop and P of GK in the right half plane, and q of GK at 0. P is given.
The angle below the first line is that of the known K and of a G that is taken to go on as its first
lines rise, c (jω)^-n: stable poles far below, where |GK| >> 1, count as poles at 0. Above the last
line |GK| is taken to stay below 1. What of this the data can show is looked at: `sure`.
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat

from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.lti.hold import tustin
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError, described
from ccd_casadi.support.units import HZ

HALF_POWER = 2.0**-0.5
GAP = 0.25 * np.pi  # of G's angle at the first line to its asymptote, above which Z is not sure
BELOW = 3  # decades that K is followed below the first line
SAFETY = 2.0  # on the error of interpolation
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


def read_frequency_response(path: str | Path) -> MeasuredResponse:
    """A CSV with a header of f_hz and re, im (or magnitude or magnitude_db, and phase_deg or
    phase_rad), or a .mat file with these names or with f_hz and a complex G.

    G is displacement over force, m/N. Raises UserError with what is missing.
    """
    path = Path(path)
    if path.suffix.lower() == ".mat":
        return _of_columns(_mat(path), path)
    try:
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
    try:
        variables = loadmat(path)
    except OSError as error:
        words = f"cannot be read as a frequency response: {error.strerror or error}"
        raise UserError(f"{path}: {words}") from None
    except Exception as error:  # whatever its reader stumbles over in a damaged or newer file
        words = f"is no .mat file of version 7 or older ({described(error)}); save -v7, or a CSV"
        raise UserError(f"{path}: {words}") from None
    found = {}
    for name, value in variables.items():
        numbers = np.asarray(value).ravel()
        if not name.startswith("__") and numbers.dtype.kind in "iufc":
            found[COLUMNS.get(name.lower(), name)] = numbers
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
    runs = K if period is None else tustin(K, period)
    return runs.response(HZ * np.asarray(hz, float))[:, 0, 0]


@dataclass(frozen=True)
class Extended:
    """A measured response with G as c (jω)^-n on further lines below; `first` of the measured ones.

    `gap`: the angle between G there and its asymptote.
    """

    hz: Array
    G: np.ndarray
    first: int
    poles_at_zero: int
    gap: float


def extended(measured: MeasuredResponse, poles_at_zero: int | None = None) -> Extended:
    """Three decades further down; n by the slope of |G| at its first lines where none is given."""
    hz, G = measured.hz, measured.G
    n = poles_at_zero
    if n is None:
        many = max(3, int(np.searchsorted(hz, 1.5 * hz[0])))
        x, y = np.log(hz[:many]), np.log(np.abs(G[:many]))
        n = max(0, round(-float(np.polyfit(x, y, 1)[0])))
    angle = float(np.angle(G[0]))
    asymptotes = -0.5 * np.pi * n + np.pi * np.arange(-4, 5)
    nearest = float(asymptotes[np.argmin(np.abs(angle - asymptotes))])
    below = np.geomspace(10.0**-BELOW * hz[0], hz[0], 25 * BELOW + 1)[:-1]
    turned = np.clip(1.0 + np.log10(below / hz[0]), 0.0, 1.0)  # within the last decade
    phase = nearest + turned * (angle - nearest)
    G_below = np.abs(G[0]) * (below / hz[0]) ** -n * np.exp(1j * phase)
    return Extended(np.append(below, hz), np.append(G_below, G), len(below), n,
                    abs(angle - nearest))  # fmt: skip


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
    `unstable_poles` and `poles_at_zero` of G; the latter by default by the slope of its first
    lines. `integrator` of K: then the shape counts from 0 on, else from ω_low.
    """
    if period is not None and measured.hz[-1] > 0.5 / period:
        raise UserError("the lines reach beyond half the sampling rate; drop those above")
    whole = extended(measured, poles_at_zero)
    k = controller_response(K, whole.hz, period)
    Z, doubts = winding(whole, whole.G * k, unstable_poles, int(integrator))
    head = "stable" if Z == 0 else f"unstable, {Z} poles in the right half plane"
    assumed = (
        f"{head} by the winding of 1 + GK, with {unstable_poles} unstable poles of G, and G as "
        f"(jω)^-{whole.poles_at_zero} below {measured.hz[0]:.4g} Hz and |GK| < 1 above "
        f"{measured.hz[-1]:.4g} Hz"
    )
    words, sure = "; ".join([assumed, *doubts]), not doubts
    if Z != 0:
        none = dict.fromkeys(FIGURES, np.nan)
        return MeasuredFigures(False, sure, Z, words=words, **none)
    hz, G, k = measured.hz, measured.G, k[whole.first :]
    L = G * k
    S = 1.0 / (1.0 + L)
    omega = HZ * hz
    KS, T = np.nan, np.nan
    if bounds.weights is not None:
        _, W_KS, W_T = np.abs(bounds.weights.responses(omega))
        KS, T = float(np.abs(W_KS * k * S).max()), float(np.abs(W_T * L * S).max())
    ln_S = np.log(np.abs(S))
    at = int(np.argmax(ln_S))
    between = clearances(hz, L)
    return MeasuredFigures(
        stable=True,
        sure=sure,
        right_half_plane=0,
        S_peak=float(np.abs(S[at])),
        S_peak_frequency=float(omega[at]),
        S_between=float(1.0 / between.min()) if (between > 0.0).all() else np.inf,
        S_low=float(np.exp(np.interp(np.log(bounds.omega_low), np.log(omega), ln_S))),
        bandwidth=_bandwidth(omega, ln_S, bounds, integrator),
        KS=float(np.abs(k * S).max()),
        T=float(np.abs(L * S).max()),
        GS=float(np.abs(G * S).max()),
        weighted_KS=KS,
        weighted_T=T,
        words=words,
    )


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
    return np.asarray(SAFETY * np.diff(x) ** 2 / 8.0 * np.maximum(each[:-1], each[1:]))


def winding(
    whole: Extended, L: np.ndarray, unstable_poles: int = 0, integrators: int = 0
) -> tuple[int, list[str]]:
    """Z of L = GK (with `integrators` of K) on the extended lines, and what the data leave open."""
    F = 1.0 + L
    q = whole.poles_at_zero + integrators
    begins = float(np.angle(F[0]))
    asymptotes = -0.5 * np.pi * q + np.pi * np.arange(-4, 5)
    first = float(asymptotes[np.argmin(np.abs(begins - asymptotes))])
    grown = begins - first + float(np.angle(F[1:] / F[:-1]).sum() - np.angle(F[-1]))
    Z = round(unstable_poles + 0.5 * q - grown / np.pi)
    hz, measured = whole.hz[whole.first :], L[whole.first :]
    near = int((clearances(hz, measured) <= 0.0).sum())
    doubts = []
    if whole.gap > GAP:
        doubts.append(f"at the first line, {hz[0]:.4g} Hz, the angle of G is not that of its slope")
    if q > 0 and abs(measured[0]) < LARGE:
        doubts.append(f"at the first line, {hz[0]:.4g} Hz, |GK| is not large")
    if abs(measured[-1]) > SMALL:
        doubts.append(f"at the last line, {hz[-1]:.4g} Hz, |GK| is not small")
    if near:
        doubts.append(f"between {near} pairs of lines GK may pass -1")
    return Z, doubts


def _bandwidth(omega: Array, ln_S: Array, bounds: Bounds, integrator: bool) -> float:
    """The largest ω_b with |S| <= 1/√2 on the lines below it and |S| within the shape."""
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
    allowed = bounds.shape * counted * HALF_POWER / np.exp(ln_S)
    if bounds.shape_ends is ShapeEnd.CROSSING:
        allowed = allowed[omega <= crossing]
    return float(min(crossing, allowed.min()))
