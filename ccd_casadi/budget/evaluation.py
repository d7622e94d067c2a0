"""An error budget evaluated for a loop, with derivatives to the controller and to θ."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy.linalg.lapack import dgees, dtrsyl

from ccd_casadi.budget.error_density import (
    has_lost_digits,
    integrate,
    integrate_densities,
    panels,
    responses,
)
from ccd_casadi.budget.noise_process import (
    FORCES,
    Matrix,
    Process,
    average_gain,
    average_matrix,
    process,
    process_of_plant,
)
from ccd_casadi.budget.sources import ErrorBudget, ErrorSource, SourceKind
from ccd_casadi.lti.loop import Loop, Sampling, tustin, zoh
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ

COMPLEX_STEP = 1e-30  # of derivatives by imaginary parts: its square is below any rounding


def variances(loop: Loop, budget: ErrorBudget) -> Array | None:
    """Compute the variances of a loop under all sources of a budget.

    Parameters
    ----------
    loop : Loop
        SI.
    budget : ErrorBudget

    Returns
    -------
    array (3,), or None of an unstable loop
        σ² of the error (m²), of its moving average (m²; NaN without a window), of the force (N²).
    """
    if not loop.stable:
        return None
    return np.asarray(
        np.sum([of_source(loop, source, budget.window) for source in budget.sources], 0)
    )


def of_source(loop: Loop, source: ErrorSource, window: float | None) -> Array:
    """Compute the variances of one source in a stable loop, as `variances` does."""
    average = np.nan
    if source.shaped:
        model = process(loop, source).balance()
        P = Lyapunov(model.A, sampled=model.sampled).covariance(model.noise)
        error, force = np.trace(model.C @ P @ model.C.T), np.trace(model.F @ P @ model.F.T)
        force = np.inf if model.infinite_force else force + (model.V**2).sum()
        if window is not None:
            M = average_matrix(model.A, window, loop.period)
            average = np.trace(model.C @ M @ P @ model.C.T)
    elif window is None:
        error, force, _ = integrate_densities(loop, source, np.zeros_like).value
    else:
        gain = partial(average_gain, window=window, period=loop.period)
        error, force, average = integrate_densities(loop, source, gain).value
    return np.array([error, average, force])


@dataclass(frozen=True)
class ErrorVariance:
    """σ² of the error of a plant under a budget, with controllers of one order.

    Attributes
    ----------
    plant : StateSpace
        SI.
    budget : ErrorBudget
    hold : Sampling or None
        How the loop runs.
    order : int
        States of the controllers.
    """

    plant: StateSpace
    budget: ErrorBudget
    hold: Sampling | None
    order: int

    @cached_property
    def filters(self) -> tuple[ErrorSource, ...]:
        """The sources with a state space."""
        return tuple(source for source in self.budget.sources if source.shaped)

    @cached_property
    def open(self) -> Process:
        """The process of the filters without a controller."""
        return process_of_plant(self.plant, self.filters, self.hold, self.order)

    def at(
        self, parts: Sequence[Matrix], M: Matrix, plants: Sequence[StateSpace] = ()
    ) -> tuple[float, Array] | None:
        """σ² (m²) and its derivatives (n + k,), None for an unstable loop.

        A, B, C, D (n + 1, ·, ·) of the controller, and of it after a step ih along each of n
        parameters, with their `run_matrix` M; `plants`: k such steps of the plant.
        """
        model = self.open.close(M[0].real)
        scale = model.scales()
        model = model.transform(scale)
        equation, C = Lyapunov(model.A, sampled=model.sampled), model.C
        if not equation.stable:
            return None
        P, X = equation.covariance(model.noise), equation.adjoint(C.T @ C)
        out, after = P @ C.T, P + model.A @ P if model.sampled else P
        to_M = 2.0 * model.L.T @ X @ (after @ model.R.T + model.E @ model.W.T)
        value, slopes = float(np.sum(C.T * out)), [np.tensordot(M[1:].imag / COMPLEX_STEP, to_M, 2)]
        for G in plants:
            moved = process_of_plant(G, self.filters, self.hold, self.order).close(M[0].real)
            moved = moved.transform(scale)
            dA, dQ, dC = (part.imag / COMPLEX_STEP for part in (moved.A, moved.noise, moved.C))
            half = np.sum(X * (dA @ after.T)) + 0.5 * np.sum(X * dQ) + np.sum(dC.T * out)
            slopes.append(np.array([2.0 * half]))
        gradient = np.concatenate(slopes)
        for source in self.budget.sources:
            if not source.shaped:
                found = self._of_table(source, parts, plants)
                value, gradient = value + found[0], gradient + found[1]
        return value, gradient

    def _of_table(
        self, source: ErrorSource, parts: Sequence[Matrix], plants: Sequence[StateSpace]
    ) -> tuple[float, Array]:
        K, *stepped = (StateSpace(*own) for own in zip(*parts, strict=True))
        K = StateSpace(*(np.real(part) for part in (K.A, K.B, K.C, K.D)))
        loop = Loop(self.plant, K, self.hold)

        def rows(hz: Array) -> Array:
            """S_e, and its derivatives along every step."""
            moving, at = _ResponseChanges(loop, hz), responses(loop, hz)
            H = at.of(source.kind)[0]
            found = [(np.abs(H) ** 2).sum((1, 2))]
            for dG, dK, dfree in (
                *map(moving.of_controller, stepped), *map(moving.of_plant, plants)
            ):  # fmt: skip
                d = -at.S @ (dG @ at.K + at.G @ dK) @ at.S
                if source.kind in FORCES:
                    d = -d @ at.free - at.S @ dfree
                elif source.kind is not SourceKind.SETPOINT:
                    d = -d
                found.append(2.0 * (H.conj() * d).real.sum((1, 2)))
            return np.array(found) * source.density(hz)

        value, *gradient = integrate(rows, panels(loop, source), 1).value
        return float(value), np.array(gradient)


class _ResponseChanges:
    """dG and dK as in the loop, and d of the disturbed G, at frequencies in Hz.

    d(C X) = C R dA X + dC X + C R dB + dD,   R = (s - A)⁻¹,  X = R B

    with eigenvectors V of A, where these are sound, as the states: R is diagonal there.
    """

    def __init__(self, loop: Loop, hz: Array) -> None:
        self.hold, self.free = loop.sampling, 1j * HZ * np.asarray(hz, float)
        self.s = loop.as_run[0].variable(HZ * np.asarray(hz, float))
        self.none = np.zeros((len(hz), 1, 1))
        self.known: dict[str, tuple[np.ndarray, ...]] = {}

    def of_controller(self, K: StateSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(dG, dK, d of the disturbed G) of a stepped controller."""
        run = K if self.hold is None else tustin(K, self.hold.period)
        return self.none, self._change("K", run, self.s), self.none

    def of_plant(self, G: StateSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the changes of the responses with a stepped plant."""
        dG = dfree = self._change("free", G, self.free)
        if self.hold is not None:
            dG = self._change("G", zoh(G, self.hold.period, self.hold.delay), self.s)
        return dG, self.none, dfree

    def _change(self, name: str, system: StateSpace, s: np.ndarray) -> np.ndarray:
        """Compute the change of a response from the imaginary parts of a system's matrices over the
        step."""
        parts = (system.A, system.B, system.C, system.D)
        dA, dB, dC, dD = (np.imag(part) / COMPLEX_STEP for part in parts)
        if name not in self.known:
            self.known[name] = _halves(StateSpace(*(np.real(part) for part in parts)), s)
        X, Y, V, inverse = self.known[name]
        dA, dB, dC = inverse @ dA @ V, inverse @ dB, dC @ V
        return np.asarray((Y @ dA + dC) @ X + Y @ dB + dD)


def _halves(system: StateSpace, s: np.ndarray) -> tuple[np.ndarray, ...]:
    """R B and C R (k, ·, ·) in the states V⁻¹x, V and V⁻¹: eigenvectors, or 1."""
    if system.modes is None:
        one = np.eye(len(system.A))
        R = np.linalg.inv(s[:, None, None] * one - system.A)
        return R @ system.B, system.C @ R, one, one
    poles, drive, reading = system.modes
    R = 1.0 / (s[:, None] - poles)
    V = np.linalg.eig(system.A)[1]
    return R[:, :, None] * drive, reading * R[:, None, :], V, np.linalg.inv(V)


class Lyapunov:
    """Lyapunov's equations A P + P Aᵀ + Q = 0 and Aᵀ X + X A + W = 0 by one Schur form.

    Parameters
    ----------
    A : array (n, n)
        1/s; of a sampled process the change over a period.
    sampled : bool

    Attributes
    ----------
    stable : bool
    """

    def __init__(self, A: Array, *, sampled: bool) -> None:
        self.inverse = np.linalg.inv(2.0 * np.eye(len(A)) + A) if sampled else None
        continuous = A if self.inverse is None else self.inverse @ A
        self.T, _, real, _, self.U, *_ = dgees(_select_none, continuous)
        self.stable = bool(real.max(initial=-np.inf) < 0.0)

    def covariance(self, Q: Array) -> Array:
        """P of a stable process, Q symmetric."""
        return self._solve(self.inverse, Q, "N", "T")

    def adjoint(self, W: Array) -> Array:
        """X at a symmetric weight W."""
        return self._solve(None if self.inverse is None else self.inverse.T, W, "T", "N")

    def _solve(self, inverse: np.ndarray | None, Q: Array, left: str, right: str) -> Array:
        if inverse is not None:
            Q = 2.0 * inverse @ Q @ inverse.T
        found, scale, _ = dtrsyl(self.T, self.T, -self.U.T @ Q @ self.U, left, right)
        P = scale * self.U @ found @ self.U.T
        return np.asarray(0.5 * (P + P.T))


def _select_none(real: float, imaginary: float) -> bool:
    return False


@dataclass(frozen=True)
class SourceFigures:
    """The contribution of one source to error and force.

    Attributes
    ----------
    source : ErrorSource
    error, average, deviation : float
        RMS error, MA and MSD in m; the last two NaN without a window.
    force : float
        RMS, N.
    disagreement : float
        Relative: between Lyapunov's equation and the integral over frequency, or for a table the
        error estimate of the quadrature. Infinite where white noise passes undamped.
    hz, cumulative : array (k,)
        The variance of the error in m² up to each frequency.
    """

    source: ErrorSource
    error: float
    average: float
    deviation: float
    force: float
    disagreement: float
    hz: Array
    cumulative: Array


@dataclass(frozen=True)
class BudgetFigures:
    """All sources and their root sum of squares.

    Attributes
    ----------
    sources : tuple of SourceFigures
    error, average, deviation, force : float
        m, m, m, N.
    window : float or None
        s.
    """

    sources: tuple[SourceFigures, ...]
    error: float
    average: float
    deviation: float
    force: float
    window: float | None

    @property
    def disagreement(self) -> float:
        """The largest of any source."""
        return max(item.disagreement for item in self.sources)

    @property
    def by_integral(self) -> bool:
        """Whether that counts for a source, where Lyapunov's equation has no digits."""
        return any(
            has_lost_digits(item.disagreement) for item in self.sources if item.source.shaped
        )


def evaluate_budget(loop: Loop, budget: ErrorBudget) -> BudgetFigures | None:
    """Evaluate the budget of a loop in SI, plant without feedthrough.

    With several channels errors and forces are those of the vectors.

    Parameters
    ----------
    loop : Loop
    budget : ErrorBudget

    Returns
    -------
    BudgetFigures or None
        None for a loop that is not stable, which has no stationary error.

    Raises
    ------
    UserError
        The plant has a feedthrough.

    >>> import numpy as np
    >>> from ccd_casadi.budget import ErrorBudget, SourceKind, ShapedSpectrum, ErrorSource
    >>> from ccd_casadi.lti.state_space import StateSpace
    >>> mass = StateSpace(np.array([[0.0, 1.0], [-1.0, -2.0]]), np.eye(2, 1, -1), np.eye(1, 2),
    ...                   np.zeros((1, 1)))
    >>> none = StateSpace(*(np.zeros((i, j)) for i, j in ((0, 0), (0, 1), (1, 0), (1, 1))))
    >>> white = ErrorBudget((ErrorSource("cable", SourceKind.FORCE, ShapedSpectrum(1.0)),))
    >>> loop = Loop(mass, none)
    >>> round(evaluate_budget(loop, white).error ** 2, 12)  # 1/2 over 2 d k, d = 2, k = 1
    0.125
    """
    if np.any(loop.plant.D):
        raise UserError("the plant of an error budget has no feedthrough")
    if not loop.stable:
        return None
    found = tuple(_figures(loop, source, budget.window) for source in budget.sources)

    def total(name: str) -> float:
        return float(np.sqrt(sum(getattr(item, name) ** 2 for item in found)))

    return BudgetFigures(
        found, total("error"), total("average"), total("deviation"), total("force"), budget.window
    )


def _figures(loop: Loop, source: ErrorSource, window: float | None) -> SourceFigures:

    def weight(hz: Array) -> Array:
        return np.ones_like(hz) if window is None else average_gain(hz, window, loop.period)

    whole = integrate_densities(loop, source, weight)
    if source.shaped:
        error, average, force = map(float, of_source(loop, source, window))
        ratio = whole.value[0] / error if error != 0.0 else 1.0
        disagreement = abs(float(ratio) - 1.0)
        if has_lost_digits(disagreement):
            error, finite, average = map(float, whole.value)
            force = force if force == np.inf else finite
    else:
        error, force, average = map(float, whole.value)
        average = np.nan if window is None else average
        disagreement = float((whole.error / np.maximum(whole.value, 1e-300)).max())
    return SourceFigures(
        source, np.sqrt(error), np.sqrt(max(average, 0.0)), np.sqrt(max(error - average, 0.0)),
        np.sqrt(force), disagreement,
        whole.ends, whole.cumulative()[0],
    )  # fmt: skip
