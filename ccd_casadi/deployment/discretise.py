"""Controllers of lower order, in discrete time, and at which rate they run.

Each reduced controller is certified stable in its loop. Two ways, because neither is the best at
every order, balance K, and set the states at rest that matter least (singular perturbation, so
that K(0) is kept):

* its stable part (Moore 1981);
* closed-loop balancing (Enns 1984; Ceton, Wortelboer and Bosgra 1993): balanced are the
  controller's blocks of the loop's Gramians from r to y, that is K weighted by S on its input
  and by S G on its output.

The reduction happens in the scaled units of the plant.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag, eigh, schur, solve_sylvester, svd
from scipy.linalg import solve_continuous_lyapunov as lyapunov

from ccd_casadi.analysis.loop_channels import (
    LoopChannel,
    SampledFigures,
    loop_figures,
    worst_figures,
)
from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment import Timing
from ccd_casadi.deployment.robust_set import Member, WorstFirst
from ccd_casadi.lti.loop import tustin, zoh
from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.state_space import StateSpace, closed_loop
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import DesignFigures
from ccd_casadi.synthesis.weights import Weights


class Reduction(StrEnum):
    """The method by which a controller was reduced."""

    PERTURBATION = "singular perturbation"
    CLOSED_LOOP = "closed-loop balancing"
    NONE = "as designed"


@dataclass(frozen=True)
class LoopLimits:
    """Most of ‖S‖∞, of σ_max(S) at ω_low and of the weighted norm, least of ω_b (rad/s)."""

    peak: float
    low: float
    norm: float
    bandwidth: float


@dataclass(frozen=True)
class ReducedController:
    """A controller in SI of some order, and its loop; figures of an unstable loop are NaN."""

    order: int
    method: Reduction
    controller: StateSpace
    figures: DesignFigures

    def meets(self, limits: LoopLimits) -> bool:
        """Whether the loop is stable and within the limits."""
        f = self.figures
        return (
            f.certified
            and f.sensitivity_peak <= limits.peak
            and f.sensitivity_low <= limits.low
            and f.bandwidth >= limits.bandwidth
            and f.gamma <= limits.norm
        )


def reductions(
    channel: LoopChannel, weights: Weights, omega_low: float, negligible: float = 1e-9
) -> list[ReducedController]:
    """Every method at every order from the minimal one down to 1, highest order first.

    A method that cannot give an order is left out there. ω_low in rad/s. A state whose closed-loop
    Hankel value is `negligible`, as a share of the largest, is not in the minimal one.
    """
    plant = channel.plant
    K = channel.controller.in_units(plant.omega_0, plant.force)
    loop = closed_loop(plant.system, K).T
    _, values = _truncate(K, loop, 0)
    order = int(np.sum(values > negligible * values[0]))
    K, _ = _truncate(K, loop, order)
    found = []
    for r in range(order, 0, -1):
        for method, reduce in _METHODS.items():
            if r == order and method is not Reduction.CLOSED_LOOP:
                continue  # nothing is reduced yet
            smaller = reduce(plant, K, r)
            if smaller is None:
                continue
            controller = smaller.in_units(1.0 / plant.omega_0, 1.0 / plant.force)
            figures = measure(plant, controller, weights, omega_low=omega_low)
            found.append(ReducedController(r, method, controller, figures))
    return found


def smallest(
    rows: list[ReducedController],
    limits: LoopLimits,
    holds: Callable[[ReducedController], bool] = lambda row: True,
) -> ReducedController:
    """The row of least order within the limits; of several, the one with the lowest peak.

    `holds`: what else it has to keep, on other plants. The minimal realisation where none does.
    """
    met = [row for row in rows if row.meets(limits)]
    met.sort(key=lambda row: (row.order, row.figures.sensitivity_peak))
    return next((row for row in met if holds(row)), rows[0])


def _perturbation(plant: ScaledPlant, K: StateSpace, r: int) -> StateSpace | None:
    S, Q, k = schur(K.A, sort="lhp")
    if r <= len(S) - k:
        return None
    stable, rest = slice(None, k), slice(k, None)
    apart = np.eye(len(S))
    apart[stable, rest] = solve_sylvester(S[stable, stable], -S[rest, rest], -S[stable, rest])
    B, C = np.linalg.solve(apart, Q.T @ K.B), K.C @ Q @ apart
    part = StateSpace(S[stable, stable], B[stable], C[:, stable], K.D)
    small = _without_fast(part, part, r - len(S) + k)
    return StateSpace(
        block_diag(small.A, S[rest, rest]),
        np.vstack([small.B, B[rest]]),
        np.hstack([small.C, C[:, rest]]),
        small.D,
    )


def _without_fast(K: StateSpace, whole: StateSpace, r: int) -> StateSpace:
    """K with r states, balanced as in `_truncate`, those of the smallest values at rest.

    ẋ₂ = 0 of these, so that K(0) is kept.
    """
    K, _ = _truncate(K, whole, len(K.A))
    rest = np.linalg.solve(K.A[r:, r:], np.hstack([K.A[r:, :r], K.B[r:]]))
    A2, B2 = rest[:, :r], rest[:, r:]
    return StateSpace(
        K.A[:r, :r] - K.A[:r, r:] @ A2,
        K.B[:r] - K.A[:r, r:] @ B2,
        K.C[:, :r] - K.C[:, r:] @ A2,
        K.D - K.C[:, r:] @ B2,
    )


def _truncate(K: StateSpace, whole: StateSpace, order: int) -> tuple[StateSpace, Array]:
    """K truncated to `order` in the coordinates in which its states, the last of a stable system
    `whole`, are as much driven as seen there; and the Hankel values."""
    A, B, C, n = whole.A, whole.B, whole.C, len(whole.A) - len(K.A)
    R = _root(lyapunov(A, -B @ B.T)[n:, n:])
    L = _root(lyapunov(A.T, -C.T @ C)[n:, n:])
    U, s, Vt = svd(L.T @ R)
    size = np.sqrt(s[:order])
    turned, inverse = R @ Vt[:order].T / size, (U[:, :order] / size).T @ L.T
    return StateSpace(inverse @ K.A @ turned, inverse @ K.B, K.C @ turned, K.D), s


_METHODS: dict[Reduction, Callable[[ScaledPlant, StateSpace, int], StateSpace | None]] = {
    Reduction.PERTURBATION: _perturbation,
    Reduction.CLOSED_LOOP: lambda plant, K, r: _without_fast(K, closed_loop(plant.system, K).T, r),
}


def _root(gramian: Array) -> Array:
    """R with R Rᵀ = the Gramian, which rounding may have left slightly indefinite."""
    values, vectors = eigh(0.5 * (gramian + gramian.T))
    return vectors * np.sqrt(np.maximum(values, 0.0))


@dataclass(frozen=True)
class RateOptions:
    """Numbers of the search for a sampling rate."""

    slowest: float = 4.0  # rate tried, over ω_b/2π
    fastest: float = 4000.0
    accuracy: float = 1e-3  # relative: how closely the least rate is bracketed


class Conversion(StrEnum):
    """The rule by which K(s) becomes K(z): Tustin's, or ramp-invariant, with or without a lead.

    Ramp-invariant is exact for an error that is straight between samples; it needs the lower rate
    on every case measured. The lead is (1 + α) - α z⁻¹, whose phase is that of a time advance of αT
    at low frequency; α = τ/T + 1/2. Its price is the gain 1 + 2α at half the sampling rate.
    """

    TUSTIN = "tustin"  # of loops that were designed as they run
    RAMP = "foh"
    LEAD = "foh with lead"


def discretise(
    controller: StateSpace, conversion: Conversion, period: float, delay: float
) -> StateSpace:
    """K(z) for a period and a delay in s, the lead on its input."""
    from scipy.signal import cont2discrete  # slow to import

    if conversion is Conversion.TUSTIN:
        found = tustin(controller, period)
        A, B, C, D = found.A, found.B, found.C, found.D
    else:
        parts = (controller.A, controller.B, controller.C, controller.D)
        A, B, C, D, _ = cont2discrete(parts, period, Conversion.RAMP.value)
    if conversion is not Conversion.LEAD:
        return StateSpace(A, B, C, D, period=period)
    alpha = delay / period + 0.5
    n, m = B.shape
    return StateSpace(
        np.block([[A, -alpha * B], [np.zeros((m, n + m))]]),
        np.vstack([(1.0 + alpha) * B, np.eye(m)]),
        np.hstack([C, -alpha * D]),
        (1.0 + alpha) * D,
        period=period,
    )


@dataclass(frozen=True)
class Target:
    """The goals of a sampled loop: ‖S‖∞ <= (1 + excess) S_max, |ω_b/bandwidth - 1| <= tolerance."""

    S_max: float
    excess: float
    bandwidth: float  # rad/s
    tolerance: float

    @property
    def peak(self) -> float:
        """The largest ‖S‖∞ that is allowed."""
        return self.S_max * (1.0 + self.excess)

    def met(self, figures: SampledFigures) -> bool:
        """Whether it does; an unstable loop does not."""
        change = abs(figures.bandwidth / self.bandwidth - 1.0)
        return self.held(figures) and change <= self.tolerance

    def held(self, figures: SampledFigures) -> bool:
        """Whether the loop is stable within the peak: what every plant of a set requires."""
        return figures.stable and figures.sensitivity_peak <= self.peak


def loop_at(
    plant: StateSpace, controller: StateSpace, conversion: Conversion, period: float, delay: float,
    places: Sequence[BreakPoint] = (),
) -> SampledFigures:  # fmt: skip
    """The figures of the sampled loop; of several sensors on one actuator at these `places`."""
    K = discretise(controller, conversion, period, delay)
    return loop_figures(closed_loop(zoh(plant, period, delay), K), places)


def needed_rate(
    met: Callable[[float], bool],
    bandwidth_hz: float,
    also: Sequence[float] = (),
    options: RateOptions = RateOptions(),
) -> float | None:
    """The least rate in Hz from which on every rate tried meets, None where the fastest does not.

    Tried are, from the fastest down to the slowest, those of `nice_rate`, their geometric means and
    `also`; the least is bracketed. A rate below one that fails is never called enough.
    """
    low, high = options.slowest * bandwidth_hz, options.fastest * bandwidth_hz
    round_ones = [nice_rate(low)]
    while round_ones[-1] < high:
        round_ones.append(nice_rate(round_ones[-1] * 1.01))
    between = [float(np.sqrt(a * b)) for a, b in pairwise(round_ones)]
    good, bad = None, np.nan
    for rate in sorted({*round_ones, *between, *also}, reverse=True):
        if not met(rate):
            bad = rate
            break
        good = rate
    if good is None or np.isnan(bad):
        return good
    while good / bad > 1.0 + options.accuracy:
        middle = float(np.sqrt(good * bad))
        if met(middle):
            good = middle
        else:
            bad = middle
    return good


def nice_rate(rate: float) -> float:
    """The next rate of the series 1, 1.25, 1.6, 2, 2.5, 3.2, 4, 5, 6.4, 8 times a power of ten.

    >>> nice_rate(8123.0), nice_rate(10000.0)
    (10000.0, 10000.0)
    """
    series = (1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.4, 8.0, 10.0)
    power = 10.0 ** np.floor(np.log10(rate))
    return float(next(power * nice for nice in series if power * nice >= rate * (1.0 - 1e-12)))


def loops_meet(
    loops: Sequence[tuple[LoopChannel, StateSpace]], target: Target, conversion: Conversion,
    rate: float, timing: Timing, order: WorstFirst,
) -> bool:  # fmt: skip
    """Whether the nominal loop of all channels, each with its controller, meets the target at a
    rate, and those of all members hold it."""
    delay = timing.delay_at(rate)

    def at(member: Member | None = None) -> SampledFigures:
        return worst_figures([
            loop_at((c.plant if member is None else member.seen_by(c)).plant_si(), K, conversion,
                    1.0 / rate, delay, c.places)
            for c, K in loops
        ])  # fmt: skip

    return target.met(at()) and order.all(lambda member: target.held(at(member)))


def choose(
    run: FinishedRun, timing: Timing, loops: Sequence[tuple[LoopChannel, StateSpace]],
    target: Target, family: tuple[Member, ...], progress: Callable[[str], None], attempt: int,
    remedy: str,
) -> tuple[Conversion, float | None, float]:  # fmt: skip
    """The conversion, the rate in Hz that it needs (None: no rate will do), and the rate to take.

    Raises UserError where no rate is given and none will do.
    """
    bandwidth_hz = run.bandwidth / HZ
    conversion = Conversion.LEAD if timing.lead else Conversion.RAMP
    again = f", once more for a plant in between ({attempt})" if attempt else ""
    progress(f"rate for {conversion.value}{again}")
    met = partial(loops_meet, loops, target, conversion, timing=timing, order=WorstFirst(family))
    needed = needed_rate(met, bandwidth_hz, () if timing.rate_hz is None else (timing.rate_hz,))
    if timing.rate_hz is not None:
        return conversion, needed, timing.rate_hz
    if needed is None:
        fastest = RateOptions().fastest * bandwidth_hz
        words = f"no sampling rate up to {fastest:.3g} Hz keeps S_max to 5 %"
        where = " on all plants of its [robust] set" if family else ""
        raise UserError(
            f"{run.folder}: {words} and omega_b to 3 %{where} with this delay; {remedy}"
        )
    return conversion, needed, nice_rate(needed)
