"""Modes fitted to a measured frequency response, with their uncertainty, and the set that follows.

    G(jω) = Σ_r a_r/(ω_r² - ω² + 2j ζ_r ω_r ω)        a_r in 1/kg, of either sign

A rigid body is a mode far below the first line, what lies above the last one two modes beyond it;
of these only a_r is fitted. Errors are taken as relative, complex, and alike at all lines. For
given poles the a_r follow by linear least squares (variable projection: Golub and Pereyra, 1973);
poles start at a peak, one after the other, as long as Schwarz's criterion falls and each damping
ratio is known.

With s² = Σ|r_k|²/(2N - p) the parameters scatter as s² (JᵀJ)⁻¹ around their true values, as far as
the form of G is right: what it misses is counted as noise.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import find_peaks
from scipy.special import chdtri

from ccd_casadi.fixed_structure.measured import MeasuredResponse
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.notebook import Shown
from ccd_casadi.support.units import HZ

if TYPE_CHECKING:
    import control

BELOW = 0.1  # of the first line: where a rigid body is put
ABOVE = (1.5, 6.0)  # of the last line: where what lies above it is put
BELOW_DAMPING, ABOVE_DAMPING = 0.7, 0.02
UNKNOWN = 0.2  # relative deviation of a damping ratio above which there is no such mode
STARTS = (0.003, 0.02)  # damping ratios that a new mode is tried with
NEAR = 0.01  # relative: a new mode is not tried closer to another
MOST_TRIED = 12  # peaks


@dataclass(frozen=True)
class ModalFit(Shown):
    """Modes in rising order, `hz` and `damping`; `gains` a_r in 1/kg of these, then of the `ends`.

    `ends`: (ω, ζ) of the poles that are not fitted, a rigid body's first where there is one.
    `covariance` is that of ln ω and ln ζ of every mode and of all gains over their own size.
    `noise` is s, relative, of so many `lines`.
    """

    hz: Array
    damping: Array
    gains: Array
    ends: tuple[tuple[float, float], ...]
    covariance: Array
    noise: float
    lines: int

    @cached_property
    def deviations(self) -> Array:
        """Standard deviations of the parameters: relative, of frequencies, dampings and gains."""
        return np.sqrt(np.diag(self.covariance))

    def system(self, change: Array | None = None) -> "control.StateSpace":
        """The fitted plant, N to m; with a `change` of its parameters another of the set."""
        import control

        n = len(self.hz)
        step = np.zeros(len(self.covariance)) if change is None else np.asarray(change, float)
        omega = np.append(HZ * self.hz * np.exp(step[:n]), [end[0] for end in self.ends])
        zeta = np.append(self.damping * np.exp(step[n : 2 * n]), [end[1] for end in self.ends])
        gains = self.gains * (1.0 + step[2 * n :])
        A = np.zeros((2 * len(omega), 2 * len(omega)))
        for i, (w, z) in enumerate(zip(omega.tolist(), zeta.tolist(), strict=True)):
            A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[0.0, w], [-w, -2.0 * z * w]]
        B = np.ravel(np.column_stack([np.zeros_like(omega), 1.0 / omega]))[:, None]
        C = np.ravel(np.column_stack([gains, np.zeros_like(gains)]))[None, :]
        return control.ss(A, B, C, 0.0)

    def set_of_plants(self, confidence: float = 0.999) -> "list[control.StateSpace]":
        """The fit, and the two ends of every parameter of its confidence ellipsoid.

        {δ : δᵀ Σ⁻¹ δ <= k²},  k² the quantile of χ² with p degrees,  δ = ± k Σ e_i/√Σ_ii

        Those that move most, relatively, come first: a design may begin with a few of them and be
        judged on all.
        """
        if not 0.0 < confidence < 1.0:
            raise UserError(f"confidence is {confidence:g}; give a share between 0 and 1")
        k = float(np.sqrt(chdtri(len(self.covariance), 1.0 - confidence)))
        ends = k * self.covariance / self.deviations[:, None]
        ends = ends[np.argsort(-np.linalg.norm(ends, axis=1))]
        return [self.system(), *(self.system(sign * row) for row in ends for sign in (1.0, -1.0))]


def fit_modes(
    response: MeasuredResponse, *, rigid_body: bool | None = None, most: int = 12
) -> ModalFit:
    """Modes of a measured G (m/N), one after the other from its peaks, at most `most`.

    `rigid_body`: whether G falls from the first line on as a free mass does; None: by its slope.
    Raises UserError where the lines are too few for what they show.

    >>> hz = np.geomspace(1.0, 1000.0, 400)
    >>> s = 2j * np.pi * hz
    >>> G = 1 / (4 * s**2 + 0.4 * s + 1) + 0.5 / (s**2 + 30 * s + 1500.0**2)
    >>> noisy = G * (1.0 + 0.01 * np.random.default_rng(0).normal(size=(2, 400)).T @ [1, 1j])
    >>> found = fit_modes(MeasuredResponse(hz, noisy))
    >>> light = found.damping < 0.1  # the suspension shows in the first lines
    >>> found.hz[light].round(1).tolist(), found.damping[light].round(3).tolist()
    ([238.7], [0.01])
    """
    omega = HZ * response.hz
    if rigid_body is None:
        few = max(3, len(omega) // 50)
        slope = np.polyfit(np.log(omega[:few]), np.log(np.abs(response.G[:few])), 1)[0]
        rigid_body = bool(slope < -1.0)
    ends = [(BELOW * omega[0], BELOW_DAMPING)] if rigid_body else []
    ends += [(share * omega[-1], ABOVE_DAMPING) for share in ABOVE]
    data = _Data(omega, response.G, tuple(ends))
    poles, cost = np.zeros((0, 2)), data.cost(np.zeros((0, 2)))
    peaks, fit = _peaks(data), _concluded(data, poles)
    while len(poles) < most:
        better = _with_one_more(data, poles, peaks)
        if better is None:
            break
        found = data.refined(better)
        least = data.cost(found)
        # Schwarz: three more parameters have to be worth 3 ln(2N)
        lines = 2.0 * len(omega)
        if not lines * np.log(cost / least) > 3.0 * np.log(lines):
            break
        poles, cost = found, least
        longer = _concluded(data, poles)
        if longer.deviations[len(poles) : 2 * len(poles)].max() < UNKNOWN:
            fit = longer  # else modes that are still to come may make it known
    if not len(fit.hz) and not rigid_body:
        raise UserError("no mode was found in the measured response; give it lines around one")
    return fit


class _Data:
    """The lines, and what poles (n, 2) of (ln ω, ln ζ) make of them."""

    def __init__(self, omega: Array, G: np.ndarray, ends: tuple[tuple[float, float], ...]) -> None:
        self.omega, self.G, self.ends = omega, G, ends
        self._ends = np.log(np.array(ends))
        self.low, self.high = np.log(0.5 * omega[0]), np.log(2.0 * omega[-1])

    def columns(self, poles: Array) -> np.ndarray:
        """1/(ω_r² - ω² + 2j ζ_r ω_r ω) over |G| (lines, modes and ends)."""
        both = np.exp(np.vstack([poles, self._ends]))
        w = self.omega[:, None]
        denominator = both[:, 0] ** 2 - w**2 + 2j * both[:, 1] * both[:, 0] * w
        return np.asarray(1.0 / denominator / np.abs(self.G)[:, None])

    def gains(self, poles: Array) -> tuple[Array, np.ndarray]:
        """a_r by linear least squares, and the relative residuals (lines,)."""
        columns, wanted = self.columns(poles), self.G / np.abs(self.G)
        size = np.linalg.norm(columns, axis=0)
        stacked = np.vstack([columns.real, columns.imag]) / size
        found = np.linalg.lstsq(stacked, np.concatenate([wanted.real, wanted.imag]))[0] / size
        return found, columns @ found - wanted

    def cost(self, poles: Array) -> float:
        return float((np.abs(self.gains(poles)[1]) ** 2).sum())

    def refined(self, poles: Array) -> Array:
        def residuals(flat: Array) -> Array:
            found = self.gains(flat.reshape(-1, 2))[1]
            return np.concatenate([found.real, found.imag])

        low = np.tile([self.low, np.log(1e-5)], len(poles))
        high = np.tile([self.high, 0.0], len(poles))
        start = np.clip(poles.ravel(), low + 1e-6, high - 1e-6)
        ended = least_squares(residuals, start, bounds=(low, high), x_scale=0.01, max_nfev=60)
        return np.asarray(ended.x.reshape(-1, 2))


def _peaks(data: _Data) -> Array:
    """ln ω of the local maxima of |G| ω², the most prominent first."""
    found, about = find_peaks(np.log(np.abs(data.G) * data.omega**2), prominence=0.0)
    order = np.argsort(-about["prominences"])[:MOST_TRIED]
    return np.asarray(np.log(data.omega[found[order]]))


def _with_one_more(data: _Data, poles: Array, peaks: Array) -> Array | None:
    """The poles and one more, where it lowers the cost most: at a peak, or where the fit is off."""
    worst = np.log(data.omega[int(np.abs(data.gains(poles)[1]).argmax())])
    places = [x for x in (*peaks, worst) if not (np.abs(poles[:, 0] - x) < NEAR).any()]
    tried = [np.vstack([poles, [x, np.log(zeta)]]) for x in places for zeta in STARTS]
    return min(tried, key=data.cost, default=None)


def _concluded(data: _Data, poles: Array) -> ModalFit:
    poles = poles[np.argsort(poles[:, 0])]
    gains, residuals = data.gains(poles)
    n, free = len(poles), 2 * len(data.omega) - 2 * len(poles) - len(gains)
    if free <= 0:
        raise UserError(f"{len(data.omega)} lines are too few for {n} modes; measure more of them")
    columns = data.columns(poles)
    omega, zeta = np.exp(poles).T
    # ∂(a/d) = -a/d² ∂d, columns being 1/d over |G|
    squared = -gains[:n] * columns[:, :n] ** 2 * np.abs(data.G)[:, None]
    w = data.omega[:, None]
    to_omega = squared * (2.0 * omega + 2j * zeta * w) * omega
    to_zeta = squared * (2j * omega * w) * zeta
    J = np.hstack([to_omega, to_zeta, columns * gains])
    stacked = np.vstack([J.real, J.imag])
    size = np.linalg.norm(stacked, axis=0)
    s = float(np.sqrt((np.abs(residuals) ** 2).sum() / free))
    inverse = np.linalg.pinv(stacked / size, rcond=1e-12)
    covariance = s**2 * (inverse @ inverse.T) / np.outer(size, size)
    return ModalFit(
        hz=omega / HZ, damping=zeta, gains=gains, ends=data.ends, covariance=covariance,
        noise=s, lines=len(data.omega),
    )  # fmt: skip
