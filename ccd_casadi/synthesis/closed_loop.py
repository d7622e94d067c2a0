"""Measure and certify any controller on any plant, and the classical margins of its loop."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ccd_casadi.kernels.certified_design import judge
from ccd_casadi.kernels.sensitivity import Column
from ccd_casadi.lti.state_space import StateSpace, balance_system, equivalent_open_loop
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.synthesis.synthesis import (
    CertificateOptions,
    Design,
    DesignFigures,
    Outcome,
    figures_from_row,
)
from ccd_casadi.synthesis.weights import Weights

PlantAndController = Callable[[Array], tuple[NDArray, NDArray]]  # G (k, p, m) and K (k, m, p) at ω


@dataclass(frozen=True)
class ClassicalMargins:
    """Margins of one loop.

    Attributes
    ----------
    gain_down, gain_up : float
        Factors < 1 < at which stability is lost; 0 and inf where none is.
    phase_deg, delay : float
        Least change of phase, either way, at |L| = 1, and least lag there in s; inf where |L| does
        not cross 1.
    crossover : float
        Where |L| falls through 1, above it below and below it above over most of ln ω, rad/s; inf.
    places : tuple of float
        Where gain_down, gain_up and phase_deg are, rad/s; inf where there is no such margin.
    """

    gain_down: float
    gain_up: float
    phase_deg: float
    delay: float
    crossover: float
    places: tuple[float, float, float] = (np.inf, np.inf, np.inf)


def classical_margins(
    response: Callable[[Array], NDArray[np.complex128]], omega: Array
) -> ClassicalMargins:
    """Margins of the loop 1 + L = 0.

    Crossings of the negative real axis and of |L| = 1 are bracketed by neighbours of the grid,
    which has to separate them, and refined.

    Parameters
    ----------
    response : function of (k,) array
        L(jω) (k,) at any ω in rad/s.
    omega : (n,) array
        Ascending, rad/s.

    Returns
    -------
    ClassicalMargins
        The least ones.

    Examples
    --------
    >>> found = classical_margins(lambda w: 4.0 / (1j * w + 1.0) ** 3, np.geomspace(0.1, 10.0, 50))
    >>> round(found.gain_up, 9), round(found.crossover, 6), round(found.phase_deg, 4)
    (2.0, 1.232819, 27.1416)
    """
    L = response(omega)
    turned = _crossings(lambda w: response(w).imag, L.imag, omega)
    real = response(turned).real
    gains, turned = -1.0 / real[real < 0.0], turned[real < 0.0]
    low, high = gains < 1.0, gains > 1.0
    crossover = _crossings(lambda w: np.abs(response(w)) - 1.0, np.abs(L) - 1.0, omega)
    # the lag that takes L to -1; a margin of lead is what is left of a whole turn
    lags = np.mod(np.angle(-response(crossover)), 2.0 * np.pi)
    phases = np.degrees(np.minimum(lags, 2.0 * np.pi - lags))
    return ClassicalMargins(
        gain_down=float(gains[low].max(initial=0.0)),
        gain_up=float(gains[high].min(initial=np.inf)),
        phase_deg=float(phases.min(initial=np.inf)),
        delay=float((lags / crossover).min(initial=np.inf)),
        crossover=_crossover(np.log(crossover), np.log(omega[0]), abs(L[0]) > 1.0),
        places=(
            _at_least(-gains[low], turned[low]),
            _at_least(gains[high], turned[high]),
            _at_least(phases, crossover),
        ),
    )


def _crossover(falls: Array, lowest: float, above: bool) -> float:
    """Select of all ln ω where |L| crosses 1 the one below which it is above 1, and above it below,
    over most of ln ω: neither a graze at low frequencies nor a resonance further up is the
    crossover.

    `above`: whether it is at the `lowest` ln ω. inf where it never falls through 1.
    """
    signs = (1.0 if above else -1.0) * (-1.0) ** np.arange(len(falls))
    gained = np.cumsum(signs * np.diff(falls, prepend=lowest))
    gained[signs < 0.0] = -np.inf  # there it rises through 1
    best = int(gained.argmax()) if len(gained) else 0
    return float(np.exp(falls[best])) if (signs > 0.0).any() else np.inf


def _at_least(values: Array, places: Array) -> float:
    return float(places[values.argmin()]) if values.size else np.inf


def least_margins(respond: PlantAndController, omega: Array) -> ClassicalMargins:
    """The least margins of all loops broken one at a time at the plant's inputs.

    Parameters
    ----------
    respond : function of (k,) array
        G (k, p, m) and K (k, m, p) at ω in rad/s, SI.
    omega : (n,) array
        Ascending, rad/s.

    Returns
    -------
    ClassicalMargins
        See `least_of`.
    """

    def broken(at: Array, i: int) -> NDArray[np.complex128]:
        G, K = respond(at)
        return equivalent_open_loop(K @ G, i)

    inputs = respond(omega[:1])[0].shape[2]
    return least_of([classical_margins(partial(broken, i=i), omega) for i in range(inputs)])


def least_of(each: Sequence[ClassicalMargins]) -> ClassicalMargins:
    """Return of several loops the margins nearest to instability, and the lowest crossover.

    Parameters
    ----------
    each : sequence of ClassicalMargins
        At least one.

    Returns
    -------
    ClassicalMargins
        Each margin with its own place.
    """
    down = max(each, key=lambda m: m.gain_down)
    up = min(each, key=lambda m: m.gain_up)
    phase = min(each, key=lambda m: m.phase_deg)
    return ClassicalMargins(
        gain_down=down.gain_down,
        gain_up=up.gain_up,
        phase_deg=phase.phase_deg,
        delay=min(m.delay for m in each),
        crossover=min(m.crossover for m in each),
        places=(down.places[0], up.places[1], phase.places[2]),
    )


def _crossings(
    function: Callable[[Array], Array], values: Array, omega: Array, sections: int = 15
) -> Array:
    """Find where a function changes sign, one place for every two neighbours that it does between.

    Each of `sections` divides their interval by ten: 15 of them reach rounding."""
    at = np.flatnonzero(np.diff(np.signbit(values)))
    low, high, below = omega[at], omega[at + 1], np.signbit(values[at])
    rows = np.arange(at.size)
    for _ in range(sections if at.size else 0):
        points = np.linspace(low, high, 11, axis=1)
        inside = np.signbit(function(points[:, 1:-1].ravel())).reshape(-1, 9)
        first = np.argmax(np.column_stack([inside, ~below]) != below[:, None], axis=1)
        low, high = points[rows, first], points[rows, first + 1]
    return 0.5 * (low + high)


EPS = 2.0**-52


def measure(
    plant: ScaledPlant,
    controller: StateSpace,
    weights: Weights,
    *,
    omega_low: float,
    gamma: float | None = None,
    gamma_opt: float = np.nan,
    gamma_lower_bound: float = np.nan,
) -> DesignFigures:
    """Rebuild the loop from a controller, certify it against γ, and measure S.

    Parameters
    ----------
    plant : ScaledPlant
        The plant; a family of it does not count.
    controller : StateSpace
        e in, u out, SI.
    weights : Weights
        Of the norm.
    omega_low : float
        Where |S| is reported, rad/s.
    gamma : float
        What the norm may not exceed; None: it is not judged.
    gamma_opt, gamma_lower_bound : float
        Of a synthesis, passed on to the figures.

    Returns
    -------
    DesignFigures
        SI; NaN from where the certificate fails.
    """
    w0, row = plant.omega_0, np.full(int(Column.COUNT), np.nan)
    row[Column.GAMMA_OPT], row[Column.GAMMA_LOWER_BOUND] = gamma_opt, gamma_lower_bound
    row[Column.LIMITED_BY_BOUND] = 0.0
    K = controller.in_units(w0, plant.force)
    # what rounding may move the loop's poles by grows with the entries: sections are not balanced
    A, B, C, D = *balance_system(K.A, K.B, K.C), np.ascontiguousarray(K.D)
    level = CertificateOptions().unbounded if gamma is None else gamma
    judge(plant.A, plant.B, plant.C, A, B, C, D, weights.scale(w0), weights.delta, level,
          omega_low / w0, row)  # fmt: skip
    return figures_from_row(row, weights, w0)


def recertified_in_si(
    plant: ScaledPlant, design: Design, omega_low: float, *, rounding: float = 1e-6
) -> Design:
    """The design, no longer certified where its controller in SI is lost in rounding.

    What is certified in a synthesis is the controller in the plant's own units. Where the loop
    hangs on digits that doubles do not have (a plant of gain 10¹², for instance), the controller
    that a user gets is another one: it is certified again, to its bound, as it is written.

    Parameters
    ----------
    plant, design : ScaledPlant, Design
        What was made, and on what.
    omega_low : float
        rad/s.
    rounding : float
        Relative: what the conversion to SI may change of a norm and of a bandwidth.

    Returns
    -------
    Design
        The same, or with the outcome LOST_IN_ROUNDING.
    """
    if not design.figures.certified:
        return design
    bound = design.figures.certificate.norm_bound * (1.0 + rounding)  # the γ reached is a grid's
    rng = np.random.default_rng(0)  # the way to SI and back alone may change no digit at all
    K = design.controller
    rounded = StateSpace(
        *(X * (1.0 + EPS * rng.choice([-1.0, 1.0], X.shape)) for X in (K.A, K.B, K.C, K.D))
    )
    again = measure(plant, rounded, design.weights, gamma=bound, omega_low=omega_low)
    if again.certified and abs(again.bandwidth / design.figures.bandwidth - 1.0) <= rounding:
        return design
    return replace(design, figures=replace(design.figures, outcome=Outcome.LOST_IN_ROUNDING))
