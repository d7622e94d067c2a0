"""A good combination of listed values by exchanges, before branch and bound.

A combination z gives every list one of its values; θ(z) has these, and all else as at an optimum
between the values. From the combination nearest to that optimum,

    z <- z'  where  J(θ(z')) < J(θ(z)),   z' an exchange of z with λ(θ(z')) <= 0,

until no exchange lowers J or the time is up. An exchange moves one list to a value beside its own;
where none of these keeps λ (a number of places is given) it moves two lists at once. J is true: the
inner problem is solved at every z', nearest first, a batch at a time; the best z' of the first
batch that lowers J is taken. Branch and bound then begins with a design that is judged, and cuts
with it if it is verified.

Source: exchange neighbourhoods of facility location (Cornuejols, Nemhauser and Wolsey, 1990).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import casadi as ca
import numpy as np

from ccd_casadi.inner_problem.objective import (
    ConstraintOptions,
    constraint_shares,
    constraint_sizes,
    objective_of,
)
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.time_budget import ends_early, stage

Values = dict[str, float]  # a combination z, by name
Ranked = tuple[tuple[float, float], Values]  # J, the violation that decides where J is infinite, z


@dataclass(frozen=True)
class ExchangeOptions:
    """Numbers of the search by exchanges.

    Attributes
    ----------
    share : float
        Of the budget, after which no further exchange is tried.
    batch : int
        Exchanges that are evaluated at once, by any number of workers: the best of them is taken.
    undecided : int
        Lists of which two values are tried in the combination nearest to a θ.
    """

    share: float = 0.4
    batch: int = 8
    undecided: int = 12


def nearest_combination(
    problem: CoDesignProblem,
    theta: Mapping[str, float],
    options: ExchangeOptions = ExchangeOptions(),
) -> Values:
    """The combination of listed values near a θ that keeps the constraints, with the least change
    of these too: of places that are to be chosen in part."""
    near = {name: sorted(values, key=lambda v: abs(v - theta[name]))[:2]
            for name, values in problem.listed}  # fmt: skip

    def undecided(name: str) -> float:
        first, *second = (abs(value - theta[name]) for value in near[name])
        return -second[0] / max(first, 1e-300) if second else -np.inf

    both = set(sorted(near, key=undecided, reverse=True)[: options.undecided])
    rows = product(*(near[name] if name in both else near[name][:1] for name in near))
    width = np.subtract(problem.upper, problem.lower)

    def shares(one: Mapping[str, float]) -> Array:
        return constraint_shares(problem, np.array([one[name] for name in problem.names]))

    here = shares(theta)

    def away(one: Mapping[str, float]) -> tuple[float, float]:
        there = shares(one)
        moved = [abs(one[name] - theta[name]) for name in problem.names] / width
        return float(there.max(initial=0.0)), float(
            moved.sum() + len(near) * abs(there - here).sum()
        )

    best = min((dict(theta) | dict(zip(near, row, strict=True)) for row in rows), key=away)
    return {name: best[name] for name in near}


def best_exchange(
    sampler: Sampler,
    listed: Mapping[str, Sequence[float]],
    theta: Mapping[str, float],
    begin: Values,
    options: ExchangeOptions = ExchangeOptions(),
) -> tuple[Values, int]:
    """Lower J by exchanges of listed values.

    Parameters
    ----------
    sampler : Sampler
        Of the problem with its listed parameters as ranges.
    listed : dict
        The values of each list, ascending, by name.
    theta : dict
        Every parameter by name, SI; those that are listed are replaced.
    begin : dict
        The first combination, by name.
    options : ExchangeOptions

    Returns
    -------
    dict, int
        The best combination that was found, and how many were evaluated.
    """
    problem, keeps = sampler.problem, _keeps_constraints(sampler.problem)
    size = options.batch
    tried = {tuple(begin.values())}
    count = 0

    def points(some: Sequence[Values]) -> Array:
        return np.array([[z.get(name, theta[name]) for name in problem.names] for z in some])

    def evaluated(some: Sequence[Values]) -> list[Ranked]:
        nonlocal count
        samples = sampler.values(points(some), "exchanging listed values")
        found = [((objective_of(problem, sample), sample.violation), z)
                 for sample, z in zip(samples, some, strict=True) if sample.searched]  # fmt: skip
        count += len(found)
        return found

    def allowed(some: list[Values]) -> list[Values]:
        return [z for z, kept in zip(some, keeps(points(some)), strict=True) if kept]

    def nearest_first(some: list[Values]) -> list[Values]:
        here = np.array([theta[name] for name in problem.names])
        width = np.subtract(problem.upper, problem.lower)
        away = (np.abs(points(some) - here) / width).sum(axis=1)
        return [some[i] for i in np.argsort(away, kind="stable")]

    def lower_than(best: Ranked) -> Ranked | None:
        exchanges = _exchanges(listed, best[1], allowed)
        fresh = [z for z in exchanges if tuple(z.values()) not in tried]
        fresh = nearest_first(fresh) if fresh else []
        for i in range(0, len(fresh), size):
            if ends_early("listed exchange", len(fresh) - i):
                return None
            some = fresh[i : i + size]
            tried.update(tuple(z.values()) for z in some)
            least = min([best, *evaluated(some)], key=lambda ranked: ranked[0])
            if least is not best:
                return least
        return None

    with stage(options.share):
        found = evaluated([begin])
        best, lower = begin, found[0] if found else None
        while lower is not None:
            best, lower = lower[1], lower_than(lower)
    return best, count


def _keeps_constraints(problem: CoDesignProblem) -> Callable[[Array], Array]:
    """λ(θ) <= 0 of many θ (N, n) by one graph: a plant's own function takes milliseconds each."""
    plant, x = plant_of(problem), ca.MX.sym("theta", len(problem.names))
    shares = ca.MX(plant.hardware(x)[1]) / constraint_sizes(problem)
    evaluate = ca.Function("shares", [x], [shares])

    def keeps(points: Array) -> Array:
        if not shares.numel() or not points.size:
            return np.ones(len(points), bool)
        return np.asarray((evaluate(points.T).full() <= ConstraintOptions.met).all(axis=0))

    return keeps


def _exchanges(
    listed: Mapping[str, Sequence[float]],
    z: Values,
    allowed: Callable[[list[Values]], list[Values]],
) -> list[Values]:
    """List the exchanges within one list that keep the constraints; where there are none, those
    within two."""
    moves = [(name, value) for name in z for value in _beside(listed[name], z[name])]
    single = allowed([z | {name: value} for name, value in moves])
    return single or allowed([z | dict(two) for two in combinations(moves, 2)
                              if two[0][0] != two[1][0]])  # fmt: skip


def _beside(values: Sequence[float], value: float) -> list[float]:
    """The values of a list next to one of it."""
    i = min(range(len(values)), key=lambda j: abs(values[j] - value))
    return [values[j] for j in (i - 1, i + 1) if 0 <= j < len(values)]
