"""A modal table as a smooth function of θ, with exact derivatives and the error of rows left out.

In the frame of `frames` the entries of ln K, ln D, B and C are interpolated one by one
(`entries`). The matrix logarithm makes K = exp(ln K) positive definite at every θ, and frequencies,
which follow powers of lengths and masses, nearly linear. Source: Arsigny et al., SIAM J. Matrix
Anal. Appl. 29 (2007), for log-Euclidean interpolation; the derivative of exp is that of Daleckii
and Krein.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb, prod
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.distance import cdist

from ccd_casadi.extensions.imported.modal_table import Frame, ModalTable, frames
from ccd_casadi.plants.plant import Mechanics, named_values
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import PlantError

Errors = tuple[float, float]  # of a sample left out: frequency, response
ANY: Errors = (np.inf, np.inf)


@dataclass(frozen=True)
class InterpolationOptions:
    """Numbers of the interpolation between samples."""

    same: float = 1e-6  # share of the range below which a distance to a sample is zero
    damped: float = 0.1  # compared at s = (damped + j) ω, where no moving resonance dominates
    frequencies: int = 120  # number of these


@dataclass(frozen=True)
class LeftOut:
    """Errors of N samples, each predicted without it (relative): of the frequencies of its flexible
    modes (N, r), and of its response (N,)."""

    frequencies: Array
    responses: Array

    @property
    def frequency(self) -> float:
        """The largest error of a frequency."""
        return float(self.frequencies.max(initial=0.0))

    @property
    def response(self) -> float:
        """The largest error of a response."""
        return float(self.responses.max())


LOST = "the samples cannot be interpolated"


@dataclass(frozen=True)
class EntryFitOptions:
    """Numbers of the fit of entries: a polynomial and radial functions of Matérn's kind.

    Attributes
    ----------
    most_degree, most_terms : int
        Of the polynomial.
    singular : float
        Relative pivot below which terms are not distinguished by the samples, and leverage of
        the other samples below which a sample alone settles a term.
    lengths : tuple of float
        Lengths of the radial functions that are tried, over half the range of each parameter.
    largest_coefficient : float
        Of a radial function, over the numbers: beyond, the sum loses digits.
    """

    most_degree: int = 12
    most_terms: int = 500
    singular: float = 1e-9
    lengths: tuple[float, ...] = (0.5, 1.0, 2.0)
    largest_coefficient: float = 1e4


def fit_entries(
    theta: Array, Y: Array, *, options: EntryFitOptions = EntryFitOptions()
) -> tuple[ca.Function, Array]:
    """θ -> q numbers, of numbers Y (N, q) at samples θ (N, p), and the error (N, q) at each sample,
    predicted without it. Raises PlantError where the samples are too few, or one is there twice."""
    lower, width = theta.min(axis=0), np.ptp(theta, axis=0)
    N, p = theta.shape
    unit = 2.0 * (theta - lower) / np.where(width > 0.0, width, np.nan) - 1.0
    if not np.isfinite(unit).all():
        raise PlantError(f"{LOST}: a parameter does not vary among the samples; add samples")
    if len(np.unique(unit, axis=0)) < N:
        raise PlantError("two samples are at the same theta; keep one of them")
    squares = ((unit[:, None] - unit) ** 2).sum(axis=2)
    radial = [_matern(squares / length**2, np) for length in options.lengths]
    left_out, trend = np.full(Y.shape, np.inf), np.zeros((0, Y.shape[1]))
    spread = np.zeros((len(options.lengths), *Y.shape))
    powers = np.zeros((0, p))
    for degree in range(options.most_degree + 1):
        if not comb(p + degree, degree) < min(N, options.most_terms + 1):
            break
        rows = combinations_with_replacement(range(p), degree)
        powers = np.vstack([powers, [np.bincount(row, minlength=p) for row in map(list, rows)]])
        trend = np.pad(trend, ((0, len(powers) - len(trend)), (0, 0)))
        Q, R = np.linalg.qr(np.prod(unit[:, None, :] ** powers, axis=2), mode="complete")
        (own, rest), R = np.split(Q, [len(powers)], axis=1), R[: len(powers)]
        pivots = np.abs(np.diag(R))
        singular = options.singular
        if pivots.min() < singular * pivots.max() or (rest**2).sum(axis=1).min() < singular:
            continue
        for k, phi in enumerate(radial):
            W = rest @ np.linalg.solve(rest.T @ phi @ rest, rest.T)
            a = W @ Y
            errors = a / np.diag(W)[:, None]
            better = (errors**2).sum(axis=0) < (left_out**2).sum(axis=0)
            largest = options.largest_coefficient * np.abs(Y).max(axis=0)
            better &= (k == 0) | (np.abs(a).max(axis=0) <= largest)
            left_out[:, better], spread[:, :, better] = errors[:, better], 0.0
            spread[k][:, better] = a[:, better]
            trend[:, better] = np.linalg.solve(R, own.T @ (Y - phi @ a))[:, better]
    if not np.isfinite(left_out).all():
        words = f"{N} samples of {p} parameters do not settle a polynomial; add samples"
        raise PlantError(f"{LOST}: {words}")
    x = ca.MX.sym("theta", p)
    scaled = 2.0 * (x - lower) / width - 1.0
    terms = [prod((scaled[j] ** int(k) for j, k in enumerate(row) if k), start=ca.MX(1.0))
             for row in powers]  # fmt: skip
    y = ca.mtimes(ca.DM(trend.T), ca.vertcat(*terms))
    away = ca.sum1((ca.repmat(scaled, 1, N) - ca.DM(unit.T)) ** 2).T
    for length, a in zip(options.lengths, spread, strict=True):
        if a.any():
            y += ca.mtimes(ca.DM(a.T), _matern(away / length**2, ca))
    return ca.Function("entries", [x], [y]), left_out


def _matern(squares: Any, module: Any) -> Any:
    """φ of squared distances over l², by NumPy or CasADi."""
    x = module.sqrt(7.0 * squares + 1e-16)  # φ has no slope at a sample, but this root would
    return (1.0 + x + 0.4 * x**2 + x**3 / 15.0) * module.exp(-x)


class InterpolatedModes:
    """θ -> Mechanics (M = I) between the samples of a modal table; `left_out` is its error.

    Frequencies below `rigid_below` (rad/s) are rigid-body modes. `refusal` says which sample is
    missed by more than is `accepted`: then no plant is known but those of the samples. Raises
    PlantError where samples differ in their number of rigid-body modes, or are too few.
    """

    def __init__(
        self,
        table: ModalTable,
        rigid_below: float,
        accepted: Errors = ANY,
        *,
        options: InterpolationOptions = InterpolationOptions(),
    ) -> None:
        self.options = options
        counts = (table.omega < rigid_below).sum(axis=1)
        if np.ptp(counts) > 0:
            s = int(counts.argmin())
            words = named_values(table.names, table.theta[s])
            raise PlantError(
                f"the sample {words} has {counts[s]} rigid-body modes, another {counts.max()}; "
                "correct the table, or rigid_below_hz"
            )
        self.table, self.rigid = table, int(counts[0])
        self.ratio = _common_ratio(table, self.rigid)
        tried = map(self._fit, frames(table, self.rigid))
        self.frame, entries, self.left_out = min(tried, key=lambda one: one[2].response)
        theta = ca.MX.sym("theta", len(table.names))
        y = entries(theta)
        self._entries = ca.Function("entries", [theta], [y, ca.jacobian(y, theta)])
        self.refusal = self._worst_sample(*accepted)

    def __call__(self, theta: Sequence[float]) -> Mechanics:
        """M, D, K, B, C and their derivatives at θ."""
        index, distance = self.nearest(theta)
        if self.refusal and distance > self.options.same:
            known = named_values(self.table.names, self.table.theta[index])
            raise PlantError(f"{self.refusal}; at a sample, such as {known}, the plant is known")
        y, slopes = (np.array(value) for value in self._entries(np.asarray(theta, float)))
        L, log_D, B, C = self._matrices(y.T, self.frame)
        dL, dlog_D, dB, dC = self._matrices(slopes.T, self.frame)
        r, count = self.table.omega.shape[1], len(dL)
        K, dK = self._exponential(L[0], dL)
        D, dD = np.zeros((r, r)), np.zeros((count, r, r))
        if self.ratio is None:
            D, dD = self._exponential(log_D[0], dlog_D)
        derivatives = (np.zeros((count, r, r)), dD, dK, dB, dC)
        return Mechanics(np.eye(r), D, K, B[0], C[0], self.ratio, derivatives)

    def nearest(self, theta: Sequence[float]) -> tuple[int, float]:
        """The nearest sample, and how far it is (the largest share of the table's range)."""
        low, high = self.table.theta.min(axis=0), self.table.theta.max(axis=0)
        width = np.where(high > low, high - low, 1.0)
        distance = np.abs((self.table.theta - np.asarray(theta)) / width).max(axis=1)
        return int(distance.argmin()), float(distance.min())

    def _worst_sample(self, frequency: float, response: float) -> str:
        """The sample that is missed by most, over what is accepted, in words; else nothing."""
        table, errors = self.table, self.left_out
        worst = errors.frequencies.max(axis=1, initial=0.0) / frequency
        worst = np.maximum(worst, errors.responses / response)
        s = int(worst.argmax())
        if not worst[s] > 1.0:
            return ""
        place, more = (named_values(table.names, at) for at in (table.theta[s], self._between(s)))
        words = f"{100.0 * errors.responses[s]:.2g} % off in its response"
        if errors.frequencies.size:
            i = int(errors.frequencies[s].argmax())
            hz = table.omega[s, self.rigid + i] / (2.0 * np.pi)
            words += f" and {100.0 * errors.frequencies[s, i]:.2g} % in the frequency of mode "
            words += f"{self.rigid + i + 1} ({hz:.4g} Hz)"
        missed = (errors.frequencies > frequency).any(axis=0)
        few = f"the {self.rigid + int(missed.argmax())} lowest" if missed.any() else "fewer"
        return (
            f"the samples do not settle the plant between them: {place}, left out, is predicted "
            f"{words}, where {100.0 * response:.2g} % and {100.0 * frequency:.2g}"
            f" % are accepted; add a sample at {more}, or keep {few} modes"
        )

    def _between(self, s: int) -> Array:
        """Half way from a sample to that of its neighbours that is predicted worst, no other sample
        being as near to the middle as these two."""
        theta, errors = self.table.theta, self.left_out.responses
        unit = theta / np.ptp(theta, axis=0)
        middle = 0.5 * (unit + unit[s])
        half = np.linalg.norm(middle - unit[s], axis=1)
        beside = cdist(middle, unit).min(axis=1) >= (1.0 - self.options.same) * half
        beside[s] = False
        return np.asarray(0.5 * (theta[s] + theta[np.where(beside, errors, -np.inf).argmax()]))

    def _fit(self, frame: Frame) -> tuple[Frame, ca.Function, LeftOut]:
        """θ -> entries in the frame: ln K, ln D where it is not modal, B and C; and their error."""
        table, Q, flexible = self.table, frame.Q, slice(self.rigid, None)
        omega, own = table.omega[:, flexible], Q[:, flexible, flexible]
        logarithms = [2.0 * np.log(omega)]
        if self.ratio is None:
            logarithms.append(np.log(2.0 * table.zeta[:, flexible] * omega))
        full = [(own * values[:, None]) @ own.transpose(0, 2, 1) for values in logarithms]
        rows, columns = self._pairs(frame)
        Y = np.hstack([
            *(part[:, rows, columns] for part in full),
            *((Q @ part).reshape(len(Q), -1) for part in (table.inputs, table.outputs)),
        ])  # fmt: skip
        entries, left_out = fit_entries(table.theta, Y)
        return frame, entries, self._left_out(Y, Y - left_out, frame)

    def _pairs(self, frame: Frame) -> tuple[np.ndarray, ...]:
        """Rows and columns of the entries of ln K that are not zero, upper triangle."""
        label = np.zeros(self.table.omega.shape[1], int)
        for number, group in enumerate(frame.groups):
            label[list(group)] = number
        own = label[self.rigid :]
        return np.nonzero(np.triu(own[:, None] == own))

    def _matrices(self, Y: Array, frame: Frame) -> tuple[Array, Array, Array, Array]:
        """ln K, ln D (flexible modes), B and C of rows (k, q) of such entries."""
        rows, columns = self._pairs(frame)
        r, m, start = self.table.omega.shape[1], self.table.inputs.shape[2], 0
        logarithms = np.zeros((2, len(Y), r - self.rigid, r - self.rigid))
        for L in logarithms[: 1 if self.ratio is not None else 2]:
            L[:, rows, columns] = L[:, columns, rows] = Y[:, start : start + len(rows)]
            start += len(rows)
        B, C = np.split(Y[:, start:], [r * m], axis=1)
        C = C.reshape(len(Y), r, self.table.outputs.shape[2]).transpose(0, 2, 1)
        return *logarithms, B.reshape(len(Y), r, m), C

    def _exponential(self, L: Array, dL: Array) -> tuple[Array, Array]:
        """exp(L) and its derivatives on the flexible modes, zero on the rigid ones."""
        r, a = self.table.omega.shape[1], self.rigid
        full, slopes = np.zeros((r, r)), np.zeros((len(dL), r, r))
        lam, E = np.linalg.eigh(L)
        gap = lam[:, None] - lam[None, :]
        # (e^a - e^b)/(a - b) = e^b (e^(a-b) - 1)/(a - b), which expm1 gives to rounding
        ratio = np.divide(np.expm1(gap), gap, out=np.ones_like(gap), where=gap != 0.0)
        divided = np.exp(lam)[None, :] * ratio
        full[a:, a:] = (E * np.exp(lam)) @ E.T
        slopes[:, a:, a:] = E @ (divided * (E.T @ dL @ E)) @ E.T
        return full, 0.5 * (slopes + slopes.transpose(0, 2, 1))

    def _left_out(self, Y: Array, predicted: Array, frame: Frame) -> LeftOut:
        omega = np.exp(0.5 * np.linalg.eigvalsh(self._matrices(predicted, frame)[0]))
        moved = np.abs(omega / self.table.omega[:, self.rigid :] - 1.0)
        missed = []
        for pair in zip(Y, predicted, strict=True):
            one, other = (self._response(y[None], frame) for y in pair)
            sizes = np.linalg.norm(one, axis=(1, 2))
            missed.append((np.linalg.norm(other - one, axis=(1, 2)) / sizes).max())
        return LeftOut(moved, np.array(missed))

    def _response(self, y: Array, frame: Frame) -> np.ndarray:
        """G at s = (0.1 + j) ω over the band of the modes, undamped."""
        (L,), _, (B,), (C,) = self._matrices(y, frame)
        K, _ = self._exponential(L, np.zeros((0, *L.shape)))
        flexible = self.table.omega[:, self.rigid :]
        low, high = (flexible.min(), flexible.max()) if flexible.size else (1.0, 10.0)
        omega = np.geomspace(0.3 * low, 1.2 * high, self.options.frequencies)
        s = (self.options.damped + 1j) * omega
        inverse = np.linalg.inv(K + (s**2)[:, None, None] * np.eye(len(K)))
        return np.asarray(C @ inverse @ B)


def row_of(table: ModalTable, rigid: int, index: int) -> Mechanics:
    """The modal model of one sample as it stands in the table, whose first `rigid` modes are."""
    r, n, ratio = table.omega.shape[1], len(table.names), _common_ratio(table, rigid)
    lam = np.where(np.arange(r) < rigid, 0.0, table.omega[index] ** 2)
    D = np.zeros((r, r)) if ratio is not None else np.diag(2.0 * table.zeta[index] * np.sqrt(lam))
    B, C = table.inputs[index].copy(), table.outputs[index].T.copy()
    M, K = np.eye(r), np.diag(lam)
    none = tuple(np.zeros((n, *part.shape)) for part in (M, D, K, B, C))
    return Mechanics(M, D, K, B, C, ratio, none)  # type: ignore[arg-type]


def _common_ratio(table: ModalTable, rigid: int) -> float | None:
    """The damping ratio of every flexible mode, None where they differ."""
    damping = table.zeta[:, rigid:]
    if damping.size and damping.min() <= 0.0:
        raise PlantError("a flexible mode has no damping; give a damping ratio above 0")
    return float(damping.flat[0]) if damping.size and np.ptp(damping) == 0.0 else None
