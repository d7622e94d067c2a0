"""The inner problem: the largest certified bandwidth at a fixed θ.

    ω_b*(θ) = max over (ω_S, ω_T) of ω_b   s.t.  ‖S‖∞ <= S_max,  σ_max(S(jω_low)) <= S_low
    (paper, equation (8)), and where it is given  ‖GS‖∞ <= compliance_max

The feasible set can be disconnected. The paper's sweep covers the box; every local maximum of
the sweep, feasible or nearly so, then starts a local constrained solve with exact derivatives.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view

from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.terminal import NotebookHtml
from ccd_casadi.synthesis.derivatives import Sensitivities, sensitivities
from ccd_casadi.synthesis.synthesis import DesignFigures, sweep
from ccd_casadi.synthesis.weights import Weights

Point = tuple[float, float]  # ω_S, ω_T in rad/s
At = Callable[[Point], Sensitivities]  # one certified synthesis with its derivatives
LABELS = {
    "S_max": "peak of S",
    "S_low": "|S(j omega_low)|",
    "compliance_max": "compliance |GS| in m/N",
}


@dataclass(frozen=True)
class SweepOptions:
    """Numbers of the local solves after a sweep.

    Attributes
    ----------
    margin : float
        ln: how far inside a constraint they aim, so that a result satisfies it.
    near : float
        ln ω: closer to an uncertified design no better one is searched.
    starts : int
        Local solves at most.
    penalty : float
        ln ω_b per ln of a violated bound, where starts are compared.
    syntheses, steps : int
        Of a local solve, and of SLSQP within it, at most.
    tolerance : float
        SLSQP's, of ln ω_b.
    active : float
        Relative distance within which a constraint counts as binding.
    """

    margin: float = 1e-9
    near: float = 1e-3
    starts: int = 6
    penalty: float = 3.0
    syntheses: int = 40
    steps: int = 30
    tolerance: float = 1e-9
    active: float = 1e-5


@dataclass(frozen=True)
class InnerBounds:
    """The constraints and the search box of the inner problem.

    Attributes
    ----------
    S_max, S_low, omega_low : float
        ‖S‖∞ <= S_max, σ_max(S(jω_low)) <= S_low; rad/s.
    omega_S, omega_T : tuple of two floats
        The box, rad/s.
    gamma_backoff : float
        γ of a synthesis over γ_opt.
    sweep_points : tuple of two ints
        Along ω_S and ω_T.
    compliance_max : float or None
        m/N: ‖GS‖∞ at most.
    """

    S_max: float
    S_low: float
    omega_low: float
    omega_S: tuple[float, float]
    omega_T: tuple[float, float]
    gamma_backoff: float = 1.02
    sweep_points: tuple[int, int] = (20, 20)
    compliance_max: float | None = None

    @property
    def bounds(self) -> dict[str, tuple[str, float]]:
        """Name of each bound -> the figure that it is on, the bound, in the order of
        `Sensitivities.values[1:-1]`."""
        found = {
            "S_max": ("sensitivity_peak", self.S_max),
            "S_low": ("sensitivity_low", self.S_low),
        }
        if self.compliance_max is not None:
            found["compliance_max"] = ("compliance", self.compliance_max)
        return found

    @property
    def levels(self) -> Array:
        """ln of each bound, in that order."""
        return np.log([bound for _, bound in self.bounds.values()])

    @property
    def synthesis_options(self) -> dict[str, Any]:
        """The options of each synthesis and its measurement, as keyword arguments."""
        return {
            "omega_low": self.omega_low,
            "gamma_backoff": self.gamma_backoff,
            "compliance": self.compliance_max is not None,
        }

    def excess(self, figures: object) -> float:
        """ln of the largest figure over its bound, of a row or a stored sample; feasible up to 0,
        NaN where a figure is."""
        bounds = self.bounds.values()
        return float(np.max([np.log(getattr(figures, name) / bound) for name, bound in bounds]))

    def feasible(self, figures: DesignFigures) -> bool:
        """Certified, inside the box and within every bound."""
        return figures.certified and all(
            getattr(figures, name) <= bound for name, bound in self.bounds.values()
        )

    def frequencies(self, x: Sequence[float] | Array) -> Point:
        """Return the frequencies from their logarithms, the last two of x, which may begin with θ.

        They are clipped to the box, since exp(log(bound)) may miss a bound by rounding.
        """
        S, T = np.clip(np.exp(x[-2]), *self.omega_S), np.clip(np.exp(x[-1]), *self.omega_T)
        return float(S), float(T)

    def axes(self) -> tuple[Array, Array]:
        """Logarithmic sweep grids of ω_S and ω_T."""
        return (
            np.geomspace(*self.omega_S, self.sweep_points[0]),
            np.geomspace(*self.omega_T, self.sweep_points[1]),
        )


@dataclass(frozen=True)
class InnerResult(NotebookHtml):
    """The solution of the inner problem at a θ.

    Attributes
    ----------
    optimum : Sensitivities or None
        None if infeasible.
    active : tuple of str
        What binds there.
    rows, syntheses : tuple of DesignFigures, int
        Every synthesis that was made, and their number.
    shortfall : str
        How near the certified designs came, if infeasible.
    violation : float
        The least one, in ln of the bounds, of any certified design; zero if solved.
    """

    optimum: Sensitivities | None
    active: tuple[str, ...]
    rows: tuple[DesignFigures, ...]
    syntheses: int
    shortfall: str = ""
    violation: float = 0.0

    @property
    def bandwidth(self) -> float:
        """ω_b* in rad/s; NaN where infeasible."""
        return np.nan if self.optimum is None else self.optimum.figures.bandwidth


def sweep_inner(plant: ScaledPlant, weights: Weights, problem: InnerBounds) -> InnerResult:
    """The paper's sweep over the whole box, refined to the continuous optimum."""
    rows = sweep(plant, weights, *problem.axes(), **problem.synthesis_options)
    at = partial(evaluate, plant, weights, problem)
    return refine(at, problem, rows, sweep_starts(problem, rows))


def refine(
    at: At,
    problem: InnerBounds,
    rows: Sequence[DesignFigures],
    starts: Iterable[Point],
    limit: int = SweepOptions.syntheses,
) -> InnerResult:
    """Local constrained solves from `starts` (rad/s); the best feasible design of all wins.

    `limit` bounds the syntheses of each local solve. A row has no derivatives: where the fastest
    feasible one is faster than every end, its design is made anew, with them.
    """
    steps = [step for start in starts for step in local_solve(at, problem, start, limit)]
    tried = [*rows, *(step.figures for step in steps)]
    feasible = [step for step in steps if problem.feasible(step.figures)]
    best = max(feasible, key=lambda step: step.figures.bandwidth, default=None)
    swept = (row for row in rows if problem.feasible(row))
    for row in sorted(swept, key=lambda row: -row.bandwidth):
        if best is not None and best.figures.bandwidth >= row.bandwidth:
            break
        other = at((row.omega_S, row.omega_T))
        tried.append(other.figures)
        if problem.feasible(other.figures):  # it is not where derivatives are not finite
            best = other
            break
    if best is None:
        least = min((_violation(problem, row) for row in tried if row.certified), default=np.inf)
        words = shortfall(problem, tried)
        return InnerResult(None, (), tuple(tried), len(tried), words, least)
    active = active_constraints(problem, best.figures)
    return InnerResult(best, active, tuple(tried), len(tried))


def evaluate(
    plant: ScaledPlant, weights: Weights, problem: InnerBounds, point: Point
) -> Sensitivities:
    """Make one certified synthesis with derivatives.

    Parameters
    ----------
    plant, weights, problem : ScaledPlant, Weights, InnerBounds
    point : tuple of two floats
        ω_S and ω_T in rad/s.

    Returns
    -------
    Sensitivities
    """
    return sensitivities(plant, weights.at(*point), **problem.synthesis_options)


def sweep_starts(
    problem: InnerBounds, rows: Sequence[DesignFigures], options: SweepOptions = SweepOptions()
) -> list[Point]:
    """Local maxima of ln ω_b - penalty·violation over the eight neighbours on the sweep grid, best
    first.

    Designs a little outside the bounds count too: a feasible sliver may lie between grid points.
    """
    merit = np.array([
        np.log(row.bandwidth) - options.penalty * _violation(problem, row)
        if row.certified else -np.inf for row in rows
    ])  # fmt: skip
    merit = np.nan_to_num(merit, nan=-np.inf)  # an unknown figure is no merit
    around = np.pad(merit.reshape(problem.sweep_points), 1, constant_values=-np.inf)
    highest = sliding_window_view(around, (3, 3)).max(axis=(2, 3)).ravel()
    found = np.flatnonzero(np.isfinite(merit) & (merit >= highest))
    best = found[np.argsort(-merit[found], kind="stable")][: options.starts]
    return [(rows[i].omega_S, rows[i].omega_T) for i in best]


def _violation(problem: InnerBounds, row: DesignFigures) -> float:
    """ln of the largest figure over its bound, 0 within all; infinite where a figure is unknown."""
    excess = problem.excess(row)
    return np.inf if np.isnan(excess) else max(0.0, excess)


class _Stop(Exception):
    """Raised through SLSQP, which cannot step over a design without figures, or beyond a limit."""


def local_solve(
    made_at: At, problem: InnerBounds, start: Point, limit: int = SweepOptions.syntheses,
    options: SweepOptions = SweepOptions(),
) -> list[Sensitivities]:  # fmt: skip
    """Maximise ln ω_b from `start` by SLSQP over (ln ω_S, ln ω_T); every design on the way.

    Where a step ends in an uncertified design, the search continues from the best one so far in a
    box that reaches half way to the nearest of these, until that is `near` or a solve changes
    nothing.
    """
    bounds = np.log([problem.omega_S, problem.omega_T])
    levels = problem.levels - options.margin
    seen: dict[tuple[float, float], Sensitivities] = {}

    def at(x: Array) -> Sensitivities:
        clipped = np.clip(x, bounds[:, 0], bounds[:, 1])
        key = (float(clipped[0]), float(clipped[1]))
        if key not in seen:
            if len(seen) >= limit:
                raise _Stop
            seen[key] = made_at(problem.frequencies(clipped))
        if not seen[key].figures.certified:
            raise _Stop
        return seen[key]

    def climbed(x: Array, low: Array, high: Array) -> bool:
        """Whether SLSQP ended by itself; of `values` and its gradients the first is ω_b, the last
        γ_opt, and between them are the logarithms of what is bounded."""
        try:
            scipy.optimize.minimize(
                lambda x: -np.log(at(x).values[0]),
                x,
                jac=lambda x: -at(x).to_break_frequencies[0] / at(x).values[0],
                bounds=np.column_stack([low, high]),
                constraints={
                    "type": "ineq",
                    "fun": lambda x: levels - at(x).values[1:-1],
                    "jac": lambda x: -at(x).to_break_frequencies[1:-1],
                },
                method="SLSQP",
                options={"ftol": options.tolerance, "maxiter": options.steps},
            )
        except _Stop:
            return False
        return True

    def rank(x: tuple[float, float]) -> tuple[float, float]:
        return _violation(problem, seen[x].figures), -seen[x].figures.bandwidth

    x, low, high = np.log(start), bounds[:, 0], bounds[:, 1]
    while len(seen) < limit:
        ended = climbed(x, low, high)
        certified = [key for key, design in seen.items() if design.figures.certified]
        lost = [key for key, design in seen.items() if not design.figures.certified]
        if not certified or not lost:
            break
        best = np.array(min(certified, key=rank))
        half = 0.5 * float(np.abs(np.array(lost) - best).max(axis=1).min())
        if half < options.near or (ended and np.array_equal(best, x)):
            break
        x, low, high = best, *np.clip([best - half, best + half], *bounds.T)
    return list(seen.values())


def active_constraints(
    problem: InnerBounds, figures: DesignFigures, *, active: float = SweepOptions.active
) -> tuple[str, ...]:
    """Name the constraints and range ends that bind at a design.

    Parameters
    ----------
    problem, figures : InnerBounds, DesignFigures
    active : float
        Relative distance within which they bind.

    Returns
    -------
    tuple of str
    """
    values = {
        **{name: getattr(figures, of) / bound for name, (of, bound) in problem.bounds.items()},
        "omega_S lower": problem.omega_S[0] / figures.omega_S,
        "omega_S upper": figures.omega_S / problem.omega_S[1],
        "omega_T lower": problem.omega_T[0] / figures.omega_T,
        "omega_T upper": figures.omega_T / problem.omega_T[1],
    }
    return tuple(name for name, ratio in values.items() if ratio >= 1.0 - active)


def shortfall(problem: InnerBounds, rows: Sequence[DesignFigures]) -> str:
    """Describe how near the certified designs came, and in which constraint, from every synthesis
    tried.

    What was not found may exist all the same: these are the controllers of one synthesis with its
    weights' frequencies in a box, and no others.
    """
    certified = [row for row in rows if row.certified]
    if not certified:
        reasons = sorted({row.outcome.value for row in rows})
        return "no synthesis was certified: " + "; ".join(reasons)
    nearest = min(certified, key=lambda row: _violation(problem, row))
    kept, least, elsewhere = [], [], []
    for name, (attribute, bound) in problem.bounds.items():
        value = float(getattr(nearest, attribute))
        best = float(np.fmin.reduce([getattr(row, attribute) for row in certified]))  # no NaN
        if value <= bound:
            kept.append(f"{name} = {bound:g} is kept there with {value:.4g}")
        elif best <= bound:
            elsewhere.append(name)
        else:
            least.append(f"the least {LABELS[name]} of all is {missed_by(best, bound)}")
    if elsewhere:
        least.append(f"others keep {' or '.join(elsewhere)}, but not all bounds at once")
    missed = " and ".join(missed_bounds(problem, nearest))
    words = f"of {len(certified)} certified controllers the nearest has {missed}"
    return "; ".join([words, *kept, *least])


def missed_bounds(problem: InnerBounds, figures: DesignFigures) -> list[str]:
    """Report which bounds a design misses, and by how much.

    Parameters
    ----------
    problem, figures : InnerBounds, DesignFigures

    Returns
    -------
    list of str
        Empty where it keeps them all.
    """
    return [
        f"{LABELS[name]} {missed_by(value, bound)} where {name} = {bound:g} is required"
        for name, (of, bound) in problem.bounds.items()
        if (value := float(getattr(figures, of))) > bound
    ]


def missed_by(value: float, bound: float) -> str:
    """Write a value beyond a bound with as many digits as distinguish them, and the excess.

    Parameters
    ----------
    value, bound : float

    Returns
    -------
    str

    Examples
    --------
    >>> missed_by(2.0004, 2.0)
    '2.0004 (+0.02 %)'
    """
    digits = 4
    while digits < 17 and float(f"{value:.{digits}g}") == float(f"{bound:.{digits}g}"):
        digits += 1
    return f"{value:.{digits}g} ({100.0 * (value / bound - 1.0):+.2g} %)"
