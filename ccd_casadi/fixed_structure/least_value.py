"""The least value of a figure of a fixed structure on a set of plants, within the bounds of the
bandwidth: the RMS error, or the time of a move.

    min ln v(κ)   s.t.  every bound of `figures` at a bandwidth of at least ω_min

By quadratic programmes in a trust region, from a controller that meets the bounds: the gradient
of ln v is exact, its curvature learnt from it, that of the bounds exact. The merit is
ln v + ρ max(0, max c); a step counts only where every loop stays stable. A little is paid for
bandwidth, so that ω_b is what the bounds leave free at this κ. At its end

    d ln v*/dθ = ∂ ln v/∂θ + Σ μ_j ∂c_j/∂θ        (envelope theorem)

but for that payment, `reward` dτ/dθ.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Protocol

import numpy as np

from ccd_casadi.budget.evaluation import COMPLEX_STEP, ErrorVariance
from ccd_casadi.budget.noise_process import run_matrix
from ccd_casadi.budget.sources import ErrorBudget
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.design import (
    DesignSearch,
    SectionsDesign,
    SectionsOutcome,
    in_problem_units,
    problem_for,
)
from ccd_casadi.fixed_structure.local_search import (
    Envelope,
    LocalSearchOptions,
    LoopModel,
    Optimality,
    Point,
    descend,
    envelope_of,
    optimality,
)
from ccd_casadi.fixed_structure.loop_problem import Assessment, LoopProblem
from ccd_casadi.fixed_structure.multi_start import at_its_bandwidth
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.optim.step import Iterate
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.process_pool import LentWorkers, Pool, Workers, results
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import HZ, number, spoken
from ccd_casadi.support.time_budget import ends_early


@dataclass(frozen=True)
class LeastValueOptions:
    """Numbers of the search for the least value."""

    reward: float = 1e-6  # of ln ω_b in ln v
    inside: float = 0.7  # of the ω_b that its bounds leave a given κ: from a bound a search crawls
    kept: float = 1.0 + 2e-6  # figure over bound that the search leaves
    at_once: int = 3  # descents: none of them knows where the others end
    slowest: float = 1e-3  # of ω₀: the least bandwidth that is searched


class Goal(Protocol):
    """A figure v > 0 of a controller on a set of plants that is made small, with derivatives.

    Attributes
    ----------
    at, to_theta, shown : method
        ln v and its gradient to κ (n,) in SI; ∂ ln v/∂θ (n_θ,) at fixed κ; v with its unit.
    """

    def at(self, kappa: Array, workers: Pool | None = None) -> tuple[float, Array]:
        """ln v at κ in SI, and its gradient; infinite where a loop is unstable.

        The plants may be spread over workers.
        """

    def to_theta(self, kappa: Array, workers: Pool | None = None) -> Array:
        """∂ ln v/∂θ at a fixed κ; as `at`."""

    def format_value(self, value: float) -> str:
        """v with its unit."""


@dataclass(frozen=True)
class RmsError:
    """The RMS error e of a controller on SISO plants, e² the mean of its variances.

    Derivatives are those of adjoint Lyapunov equations.

    Attributes
    ----------
    plants, structure : tuple of ScaledPlant, Structure
    budget : ErrorBudget
        The disturbances.
    hold : Sampling or None
        None: a continuous loop.
    """

    plants: tuple[ScaledPlant, ...]
    structure: Structure
    budget: ErrorBudget
    hold: Sampling | None

    @cached_property
    def variances(self) -> tuple[ErrorVariance, ...]:
        """The variance of every plant."""
        rest = self.budget, self.hold, self.structure.order
        return tuple(ErrorVariance(plant.plant_si(), *rest) for plant in self.plants)

    def at(self, kappa: Array, workers: Pool | None = None) -> tuple[float, Array]:
        """ln e (m) at κ in SI, and its gradient; infinite where a loop is unstable."""
        steps = 1j * COMPLEX_STEP * np.eye(len(kappa) + 1, len(kappa), -1)
        return self._of_mean(np.asarray(kappa, float) + steps, [()] * len(self.plants), workers)

    def to_theta(self, kappa: Array, workers: Pool | None = None) -> Array:
        """∂ ln e/∂θ at a fixed κ."""
        step = 1j * COMPLEX_STEP
        moved = [
            [StateSpace(G.A + step * dA, G.B + step * dB, G.C + step * dC, G.D)
             for dA, dB, dC in plant.changes_si()]
            for G, plant in ((plant.plant_si(), plant) for plant in self.plants)
        ]  # fmt: skip
        return self._of_mean(np.asarray(kappa, complex)[None], moved, workers)[1]

    def format_value(self, value: float) -> str:
        return spoken(f"{1e9 * value:.4g} nm RMS")

    def _of_mean(
        self, kappa: np.ndarray, moved: Sequence[Sequence[StateSpace]], workers: Pool | None = None
    ) -> tuple[float, Array]:
        """ln e and its gradient to the steps of κ after the first and to those of each plant."""
        parts = self.structure.state_spaces(kappa)
        M = run_matrix(parts, None if self.hold is None else self.hold.period)
        value, slopes = 0.0, np.zeros(len(kappa) - 1 + len(moved[0]))
        each = enumerate(zip(self.variances, moved, strict=True))
        tasks = {i: (variance, parts, M, own) for i, (variance, own) in each}
        of_plant = dict(results(workers, ErrorVariance.at, tasks))
        for i in tasks:  # in their order, whichever came first: sums of floats depend on it
            found = of_plant[i]
            if found is None:
                return np.inf, np.full(len(slopes), np.nan)
            value, slopes = value + found[0], slopes + found[1]
        return 0.5 * float(np.log(value / len(moved))), 0.5 * slopes / value


@dataclass(frozen=True)
class LeastValue:
    """A design with the least value v of a goal.

    Attributes
    ----------
    design : SectionsDesign
        Its multipliers are changes of ln v per ln of a bound; its residual is over ‖∇ ln v‖.
    value, first_value : float
        v over the set in SI, and that of the controller the search began with.
    steps : int
    envelope : Envelope or None
        dv*/dθ where the plants carry derivatives; None where the end is not stationary.
    """

    design: SectionsDesign
    value: float
    first_value: float
    steps: int
    envelope: Envelope | None


def least_value(
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
    design: SectionsDesign,
    goal: Goal,
    *,
    sampling: Sampling | None = None,
    least_bandwidth: float = 0.0,
    initial: Sequence[Array] = (),
    only_initial: bool = False,
    log: Log = silent,
    workers: Pool | None = None,
    ended: Mapping[int, "Ended"] | None = None,
    options: LeastValueOptions = LeastValueOptions(),
) -> LeastValue:
    """Search the least value of a goal within the bounds, from a certified design.

    Parameters
    ----------
    plants, bounds, sampling : sequence of ScaledPlant, Bounds, Sampling, optional
    design : SectionsDesign
        Certified, of one input and one output; its other local optima are starts too.
    goal : Goal
    least_bandwidth : float
        rad/s.
    initial, only_initial : sequence of array (n,), bool
        κ in SI of further starts, which come first; `only_initial`: the design is a start only
        where these lead to no certified design.
    log : callable
        Is given a line for each end.
    workers : Pool, optional
        With it descents are made `options.at_once`, however many its processes are.
    ended : mapping, optional
        Results of `first_descents` from `initial`, by number, where they are known.
    options : LeastValueOptions

    Returns
    -------
    LeastValue
        The best local optimum that the judge confirms, else the design that it began with.

    Raises
    ------
    ValueError
        The structure has several channels.
    """
    structure = design.structure
    if not isinstance(structure, Structure):
        raise ValueError("the least value is searched for one input and one output only")
    problem = problem_for(plants, structure, bounds, sampling, design.frequencies)
    near = workers if isinstance(workers, Workers) else None  # a cluster is too far for a plant
    search = DesignSearch(problem, plants, sampling, workers=near)
    w0 = problem.plants.omega_0
    floor = _floor(problem, least_bandwidth, options)
    descent = _Descent(problem, goal, options.reward, floor)
    own = (design.bandwidth, tuple(map(float, design.kappa)))
    others = [(o.bandwidth, o.kappa) for o in design.local_optima[1:] if o.kappa]
    first = float(np.exp(goal.at(design.kappa, near)[0]))
    best = LeastValue(design, first, first, 0, None)
    steps, known = 0, list[Array]()
    left = deque([*((np.inf, tuple(map(float, item))) for item in initial), own, *others])
    at_once = 1 if workers is None else options.at_once
    while left:
        begins: list[Array] = []
        while left and len(begins) < at_once:
            bandwidth, kappa = left[0]
            if only_initial and (bandwidth, kappa) == own:
                if begins:
                    break  # whether it counts depends on the end of those before
                if best.design is not design:
                    left.clear()
                    break
            left.popleft()
            if bandwidth < least_bandwidth:
                continue
            if np.isinf(bandwidth):
                begins.append(_begin(descent, kappa, options))
            else:
                begin = in_problem_units(problem, np.array(kappa))
                begins.append(np.append(begin, np.log(bandwidth / w0)))
        if best.design is not design and ends_early("least-value start", len(begins)):
            break
        if ended is not None and len(begins) == len(ended):
            ends, ended = dict(ended), None
        elif len(begins) == 1 and near is not None:
            ends = {0: _descend(descent, begins[0], known, near)}
        else:
            tasks = {i: (descent, x, tuple(known)) for i, x in enumerate(begins)}
            ends = dict(results(workers, _descend, tasks))
        for i in range(len(begins)):
            start, end, count = ends[i]
            if start is None or end is None or _is_known(known, start):
                continue
            steps += count
            new = not _is_known(known, end.x)
            known += [start, end.x]
            if not new:
                continue
            made, conditions = _judge(search, end, design, floor, options.kept)
            value = float(np.exp(end.value + options.reward * end.x[-1]))
            at = f"{goal.format_value(value)} at {number(made.bandwidth / HZ, 4)} Hz"
            log(f"{at}, {count} steps: {made.words}")
            if made.certified and value < best.value:
                direct = goal.to_theta(made.kappa, near)
                envelope = envelope_of(problem, end.x[:-1], conditions, direct)
                if envelope is not None:
                    envelope = envelope.times(value)
                best = replace(best, design=made, value=value, envelope=envelope)
    return replace(best, steps=steps)


def first_descents(
    plants: Sequence[ScaledPlant],
    structure: Structure,
    bounds: Bounds,
    goal: Goal,
    initial: Sequence[Array],
    *,
    sampling: Sampling | None = None,
    frequencies: tuple[float, float] | None = None,
    least_bandwidth: float = 0.0,
    options: LeastValueOptions = LeastValueOptions(),
) -> dict[int, Callable[[], "Ended"]]:
    """List the descents that `least_value` begins with, for workers that have time before it.

    Parameters
    ----------
    plants, structure, bounds, sampling, goal : as of `least_value`
    initial : sequence of array (n,)
        κ in SI of its first starts; those after `options.at_once` come later.
    frequencies : tuple of two floats, optional
        Bounds of K's roots, rad/s, as of its design.
    least_bandwidth : float
        rad/s.
    options : LeastValueOptions

    Returns
    -------
    dict of callable
        By number, each without arguments; their results are `ended` of `least_value`.
    """
    problem = problem_for(plants, structure, bounds, sampling, frequencies)
    floor = _floor(problem, least_bandwidth, options)
    descent = _Descent(problem, goal, options.reward, floor)
    begins = [_begin(descent, kappa, options) for kappa in initial[: options.at_once]]
    return {i: partial(_descend, descent, x, ()) for i, x in enumerate(begins)}


def _floor(problem: LoopProblem, least_bandwidth: float, options: LeastValueOptions) -> float:
    """ln of the least bandwidth over ω₀."""
    return float(np.log(max(least_bandwidth / problem.plants.omega_0, options.slowest)))


@dataclass(frozen=True)
class _Descent:
    """The data of a descent of a goal, for any process."""

    problem: LoopProblem
    goal: Goal
    reward: float
    floor: float

    def evaluate(self, kappa: Array, workers: Pool | None = None) -> tuple[float, Array]:
        """ln v and its gradient at κ in the problem's units."""
        units = self.problem.plants
        own = self.problem.structure.in_units(kappa, units.omega_0, units.force)
        return self.goal.at(own, workers)


def _begin(descent: _Descent, kappa: Sequence[float] | Array, options: LeastValueOptions) -> Array:
    """The start (n + 1,) with a controller: inside its bounds, at less than its bandwidth."""
    begin = in_problem_units(descent.problem, np.asarray(kappa))
    tau = at_its_bandwidth(descent.problem, begin).tau
    return np.append(begin, max(tau + float(np.log(options.inside)), descent.floor))


# The start as it is, the end, and how many loops were assessed; None of a start that is no use.
Ended = tuple[Array | None, Iterate[Assessment] | None, int]


def _descend(
    descent: _Descent, x: Array, known: Sequence[Array], workers: Pool | None = None
) -> Ended:
    """Descend from x until steps no longer help, or end at what is known: the start as it is, the
    end, and how many loops were assessed; none of a start that is known or not stable."""
    scaled = partial(
        descent.evaluate, workers=workers or LentWorkers()
    )  # the others may have ended
    model = LoopModel(descent.problem, scaled, descent.reward, descent.floor)
    model.known = list(known)
    start = model.at(x)
    if start is None or model.is_known(start.x):
        return None, None, 0
    first_hessian = np.diag(np.append(np.ones(len(x) - 1), 0.0))
    end, count = descend(model, start, first_hessian, descent.problem.margin)
    return start.x, end, count


def _is_known(known: Sequence[Array], x: Array) -> bool:
    return any(np.abs(x - other).max() <= LocalSearchOptions.merged for other in known)


def _judge(
    search: DesignSearch, end: Iterate[Assessment], design: SectionsDesign, floor: float,
    kept: float,
) -> tuple[SectionsDesign, Optimality]:  # fmt: skip
    """The end as a design, certified by the judge, and its conditions of optimality."""
    inside, tau = end.x[:-1], float(end.x[-1])
    kappa, controller, judged = search.judge(inside)
    found = optimality(search.problem, Point(inside, tau, end.data), -end.gradient, floor)
    least = float(np.exp(floor)) * search.problem.plants.omega_0
    good = judged.passed and judged.bandwidth >= least / kept
    made = replace(
        design,
        outcome=SectionsOutcome.CERTIFIED if good else SectionsOutcome.NOT_CERTIFIED,
        words=judged.words,
        kappa=kappa,
        controller=controller,
        bandwidth=judged.bandwidth,
        certificate=judged,
        multipliers=found.by_kind(),
        at_box=found.ends,
        kkt_residual=found.residual,
        short={},
    )
    return made, found
