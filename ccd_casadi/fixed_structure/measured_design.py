"""The largest bandwidth of a fixed structure on a measured frequency response, without a model.

    max ω_b   s.t.  1 + GK winds as a stable loop does, and on every line
                    |S| <= S_max,  |S| <= 1/√2 below ω_b,  |S| <= shape (ω/ω_b)/√2,
                    |S(jω_low)| <= S_low,
                    |W_KS KS|, |W_T T| <= weighted_level,  |GS| <= compliance_max

Every line is a row of its own, with exact derivatives to κ; ω_b and ω_low lie between lines, where
ln|S| is a straight line over ln ω. The search is `local_search`'s, from controllers by rules whose
winding is right; the judge is `measured.judge`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.fixed_structure.local_search import descend
from ccd_casadi.fixed_structure.loop_problem import Constraints, Curve, log_weights
from ccd_casadi.fixed_structure.measured import (
    MeasuredFigures,
    MeasuredResponse,
    extended,
    judge,
    winding,
)
from ccd_casadi.fixed_structure.structure import (
    Kind,
    Structure,
    response,
    response_and_slopes,
    second_slopes,
    state_space,
)
from ccd_casadi.kernels.limits import HALF_POWER
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.optim.trust_region import Iterate, Model, Rows
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ

MARGIN = 1e-6  # in logarithms: what is designed lies so far within its bounds
RELEVANT = -1.0  # ln of a figure over its bound below which a line is none of ours
RACED = 4  # starts that climb
SHORT = 0.05  # of ω over a crossover that a start aims at: its bandwidth at first


@dataclass(frozen=True)
class MeasuredDesign:
    """A controller found on measured lines; SI, frequencies in rad/s.

    `figures` are the judge's; `usable` where it is stable, surely so, and within every bound on
    every line. `words` say what is missing.
    """

    structure: Structure
    kappa: Array
    controller: StateSpace | None
    bandwidth: float
    figures: MeasuredFigures | None
    usable: bool
    words: str
    steps: int


def design_on_data(
    measured: MeasuredResponse,
    structure: Structure,
    bounds: Bounds,
    *,
    period: float | None = None,
    unstable_poles: int = 0,
    poles_at_zero: int | None = None,
    starts: int = 12,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> MeasuredDesign:
    """max ω_b of a structure on the lines; `period`, `unstable_poles` as in `judge`.

    `poles_at_zero`: those of G; by default by the slope of |G| at its first lines. The frequencies
    of K lie between a tenth of the first line and three times the last, sampled 2/T at most.
    """
    model = _OnLines(measured, structure, bounds, period, unstable_poles, poles_at_zero)
    tell = progress or (lambda words: None)
    tried = (model.at(np.append(*start)) for start in _starts(model, starts, seed))
    points = [point for point in tried if point is not None]
    points = sorted(points, key=lambda point: point.violation)[:RACED]
    if not points:
        words = "no start is stable by its winding; give poles_at_zero, or more low lines"
        nothing = np.full(len(structure.names), np.nan)
        return MeasuredDesign(structure, nothing, None, np.nan, None, False, words, 0)
    ends, steps = [], 0
    for point in points:
        end, count = descend(model, point, np.zeros((len(point.x), len(point.x))), MARGIN)
        steps += count
        ends.append(end)
        tell(f"{np.exp(end.x[-1]) / HZ:.2f} Hz, bounds exceeded by {end.violation:.1g}")
    best = min(ends, key=lambda end: (end.violation > 1e-5, -end.x[-1]))
    kappa = best.x[:-1]
    controller = state_space(structure, kappa)
    figures = judge(
        measured, controller, bounds, period=period, unstable_poles=unstable_poles,
        poles_at_zero=poles_at_zero, integrator=structure.integrator,
    )  # fmt: skip
    broken = [f"{name} by {ratio - 1.0:.2g}" for name, ratio in bounds.shares(figures).items()
              if figures.stable and not ratio <= 1.0 + 1e-5]  # fmt: skip
    words = figures.words
    if broken:
        words = f"exceeds its bound on {', '.join(broken)} (relative); {words}"
    usable = figures.stable and figures.sure and not broken
    return MeasuredDesign(
        structure, kappa, controller, figures.bandwidth, figures, usable, words, steps
    )


class _OnLines(Model[Constraints]):
    """The lines as rows over x = (κ, τ), κ in SI."""

    corrected = True

    def __init__(
        self,
        measured: MeasuredResponse,
        structure: Structure,
        bounds: Bounds,
        period: float | None,
        unstable_poles: int,
        poles_at_zero: int | None,
    ) -> None:
        self.structure, self.bounds, self.G = structure, bounds, measured.G
        self.hz, self.omega = measured.hz, HZ * measured.hz
        self.unstable_poles = unstable_poles
        self.s = 1j * self.omega
        fastest = 3.0 * self.omega[-1]
        if period is not None:
            self.s = 2j / period * np.tan(0.5 * self.omega * period)
            fastest = min(fastest, 2.0 / period)
        self.whole = extended(measured, poles_at_zero)
        below = 1j * HZ * self.whole.hz[: self.whole.first]
        if period is not None:
            below = 2j / period * np.tan(0.5 * below.imag * period)
        self.below = below
        inverse = 1.0 / np.abs(self.G)
        self.box = structure.bounds(
            (0.1 * self.omega[0], fastest), (1e-3 * inverse.min(), 1e3 * inverse.max())
        )

        self.low, self.high = np.append(self.box[0], -np.inf), np.append(self.box[1], np.inf)

    def at(self, x: Array) -> Iterate[Constraints] | None:
        """Every line within a factor e of its bound, and the two points between lines."""
        kappa, tau = np.clip(x[:-1], *self.box), float(x[-1])
        n = len(kappa)
        K, g, _ = response_and_slopes(self.structure, kappa, self.s)
        L = self.G * K
        low = self.whole.G[: self.whole.first] * response(self.structure, kappa, self.below)
        joint = np.append(low, L)
        integrators = int(self.structure.integrator)
        stable = winding(self.whole, joint, self.unstable_poles, integrators)[0] == 0
        if not stable or not np.log(self.omega[0]) < tau < np.log(self.omega[-1]):
            return None
        S = 1.0 / (1.0 + L)
        of_s, of_t = -((1.0 - S)[:, None] * g).real, (S[:, None] * g).real
        ln_S, bounds, omega = np.log(np.abs(S)), self.bounds, self.omega
        lines = np.arange(len(omega))
        parts = [(Curve.S_MAX, lines, ln_S - np.log(bounds.S_max), of_s, np.zeros(len(omega)))]
        below = lines[np.log(omega) <= tau]
        level = ln_S + HALF_POWER
        parts.append((Curve.LEVEL, below, level[below], of_s[below], np.zeros(len(below))))
        if bounds.shape is not None:
            at = lines if bounds.shape_ends is ShapeEnd.S_MAX else below
            counted = omega[at]
            if not self.structure.integrator:
                counted = np.maximum(counted, bounds.omega_low)
            shaped = np.log(bounds.shape * counted) - tau
            parts.append((Curve.SHAPE, at, level[at] - shaped, of_s[at], np.ones(len(at))))
        ends = (
            (Curve.CROSSING, tau, -HALF_POWER),
            (Curve.S_LOW, np.log(bounds.omega_low), np.log(bounds.S_low)),
        )
        for kind, place, level in ends:
            i = int(np.clip(np.searchsorted(np.log(omega), place), 1, len(omega) - 1))
            width = np.log(omega[i] / omega[i - 1])
            share = np.clip((place - np.log(omega[i - 1])) / width, 0.0, 1.0)
            weights = np.array([1.0 - share, share])
            value, slope = weights @ ln_S[i - 1 : i + 1], weights @ of_s[i - 1 : i + 1]
            to_tau = (ln_S[i] - ln_S[i - 1]) / width if kind is Curve.CROSSING else 0.0
            parts.append((kind, np.array([i]), np.array([value - level]), slope[None],
                          np.array([to_tau])))  # fmt: skip
        nothing = np.zeros(len(omega))
        if bounds.weighted_level is not None and bounds.weights is not None:
            W, _ = log_weights(bounds.weights, omega)
            level = np.log(bounds.weighted_level)
            ln_K = np.log(np.abs(K))
            parts.append((Curve.KS, lines, ln_K + ln_S + W[0] - level, of_t, nothing))
            ln_T = np.log(np.abs(L)) + ln_S
            parts.append((Curve.T, lines, ln_T + W[1] - level, of_t, nothing))
        if bounds.compliance_max is not None:
            ln_GS = np.log(np.abs(self.G)) + ln_S
            parts.append((Curve.GS, lines, ln_GS - np.log(bounds.compliance_max), of_s, nothing))
        curve = np.concatenate([np.full(len(part[1]), part[0]) for part in parts])
        at, value, to_kappa, to_tau = (
            np.concatenate([part[i] for part in parts]) for i in (1, 2, 3, 4)
        )
        value = value + MARGIN
        kept = value > RELEVANT
        rows = Constraints(
            curve[kept], at[kept], omega[at[kept]], value[kept], to_kappa[kept], to_tau[kept]
        )
        violation = max(0.0, float(value.max()))
        return Iterate(np.append(kappa, tau), -tau, -np.eye(n + 1)[n], violation, rows)

    def rows(self, here: Iterate[Constraints], radius: float) -> Rows:
        """All of them curved."""
        rows = here.data

        def second(index: np.ndarray) -> Array:
            return self.hessians(here.x[:-1], rows.only(index))

        slopes = np.column_stack([rows.to_kappa, rows.to_tau])
        return Rows(rows.value, slopes, hessians=second, curved=len(rows.v))

    def hessians(self, kappa: Array, rows: Constraints) -> Array:
        """(m, n + 1, n + 1) at fixed lines: -Re(S T g gᵀ + T ∂²ln K) of S, -Re(S T g gᵀ - S ∂²ln K)
        of KS and T."""
        n, s = len(kappa), self.s[rows.plant]
        K, g, _ = response_and_slopes(self.structure, kappa, s)
        S = 1.0 / (1.0 + self.G[rows.plant] * K)
        T = 1.0 - S
        sign = np.where(np.isin(rows.curve, (Curve.KS, Curve.T)), S, -T)[:, None, None]
        weighted = sign * second_slopes(self.structure, kappa, s)
        out = np.zeros((len(s), n + 1, n + 1))
        out[:, :n, :n] = (weighted - (S * T)[:, None, None] * g[:, :, None] * g[:, None, :]).real
        return out


def _starts(model: _OnLines, count: int, seed: int) -> list[tuple[Array, float]]:
    """PID by the rule of a third at crossovers over the lines, biquads neutral, and jittered."""
    rng = np.random.default_rng(seed)
    structure, omega = model.structure, model.omega
    found = []
    for crossover in np.geomspace(3.0 * omega[0], 0.3 * omega[-1], max(count, 2)):
        for turn in range(3):
            kappa = np.zeros(len(structure.names))
            for i, (name, kind) in enumerate(zip(structure.names, structure.kinds, strict=True)):
                share = 1.0
                if name == "integrator":
                    share = 0.1
                elif name.startswith("lead"):
                    share = 0.33 if name.endswith("zero") else 3.0
                elif name.startswith("roll-off"):
                    share = 6.0
                elif name.startswith("biquad"):
                    share = 2.0
                if kind is Kind.FREQUENCY:
                    kappa[i] = np.log(share * crossover)
                elif kind is Kind.DAMPING:
                    kappa[i] = np.log(0.7)
            kappa[1:] += 0.5 * turn * rng.normal(size=len(kappa) - 1)
            at = int(np.argmin(np.abs(omega - crossover)))
            K = response_and_slopes(structure, kappa, model.s[at : at + 1])[0][0]
            kappa[0] = -np.log(abs(model.G[at] * K))
            tau = float(np.log(max(SHORT * crossover, 1.01 * omega[0])))
            found.append((kappa, tau))
    return found
