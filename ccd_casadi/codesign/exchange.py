"""A good combination of listed values by exchanges, before branch and bound.

From the combination that is nearest to an optimum between the values, at the θ of that optimum,

    z <- z'  where  J(θ, z') < J(θ, z),   z' from the exchanges of z that keep λ(θ, z') <= 0,

until no exchange lowers J or the time is up. An exchange moves one list to a value beside its own;
where none of these keeps λ (a number of places is given) two lists move at once. J is true: the
inner problem is solved at every z', many at once. Branch and bound then begins with a design that
is judged, and cuts with it if it is verified.

Source: exchange neighbourhoods of facility location (Cornuejols, Nemhauser and Wolsey, 1990).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np

from ccd_casadi.inner_problem.objective import ConstraintOptions, constraint_sizes, objective_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.sampling.inner_samples import InnerSample
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.time_budget import ends_early, stage

Values = dict[str, float]


@dataclass(frozen=True)
class ExchangeOptions:
    """Numbers of the search by exchanges.

    Attributes
    ----------
    share : float
        Of the budget, after which no further exchange is tried.
    batch : int
        Exchanges that are evaluated at once, per process: the best of them is taken.
    """

    share: float = 0.4
    batch: int = 4


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
    size, count = options.batch * sampler.workers.count, 0

    def evaluated(some: Sequence[Values]) -> list[tuple[tuple[float, float], Values]]:
        nonlocal count
        points = np.array([_point(problem, theta, one) for one in some])
        found = sampler.values(points, "exchanging listed values")
        ranked = [(_rank(problem, sample), one) for sample, one in zip(found, some, strict=True)
                  if sample.searched]  # fmt: skip
        count += len(ranked)
        return ranked

    def allowed(some: Iterable[Values]) -> list[Values]:
        rows = list(some)
        points = np.array([_point(problem, theta, one) for one in rows])
        return [one for one, kept in zip(rows, keeps(points), strict=True) if kept] if rows else []

    tried = {tuple(begin.values())}
    with stage(options.share):
        best = min(evaluated([begin]), key=lambda pair: pair[0], default=None)
        going = best is not None
        while going and best is not None:
            going = False
            fresh = [one for one in _exchanges(listed, best[1], allowed)
                     if tuple(one.values()) not in tried]  # fmt: skip
            fresh.sort(key=lambda one: _away(problem, theta, one))
            for i in range(0, len(fresh), size):
                if ends_early("listed exchange", len(fresh) - i):
                    break
                some = fresh[i : i + size]
                tried |= {tuple(one.values()) for one in some}
                least = min([best, *evaluated(some)], key=lambda pair: pair[0])
                if least is not best:
                    best, going = least, True
                    break
    return (begin if best is None else best[1]), count


def _rank(problem: CoDesignProblem, sample: InnerSample) -> tuple[float, float]:
    """J, and of two without a design by how much they fall short."""
    return objective_of(problem, sample), sample.violation


def _point(problem: CoDesignProblem, theta: Mapping[str, float], one: Values) -> Array:
    return np.array([one.get(name, theta[name]) for name in problem.names])


def _away(problem: CoDesignProblem, theta: Mapping[str, float], one: Values) -> float:
    """How far a combination is from the optimum between the values, in shares of the ranges."""
    here = np.array([theta[name] for name in problem.names])
    width = np.subtract(problem.upper, problem.lower)
    return float((np.abs(_point(problem, theta, one) - here) / width).sum())


def _keeps_constraints(problem: CoDesignProblem) -> Callable[[Array], Array]:
    """λ(θ) <= 0 of many θ (N, n) by one graph: a plant's own function takes milliseconds each."""
    plant, x = plant_of(problem), ca.MX.sym("theta", len(problem.names))
    shares = ca.MX(plant.hardware(x)[1]) / constraint_sizes(problem)
    evaluate = ca.Function("shares", [x], [shares])

    def keeps(points: Array) -> Array:
        if not shares.numel():
            return np.ones(len(points), bool)
        return np.asarray((evaluate(points.T).full() <= ConstraintOptions.met).all(axis=0))

    return keeps


def _exchanges(
    listed: Mapping[str, Sequence[float]],
    one: Values,
    allowed: Callable[[Iterable[Values]], list[Values]],
) -> list[Values]:
    """Those of one list that keep the constraints; else those of two."""
    moves = [(name, value) for name in one for value in _beside(listed[name], one[name])]
    pairs = ((a, b) for a, b in combinations(moves, 2) if a[0] != b[0])
    return allowed(one | {name: value} for name, value in moves) or allowed(
        one | dict(pair) for pair in pairs
    )


def _beside(values: Sequence[float], value: float) -> list[float]:
    """The values of a list next to one of it."""
    i = min(range(len(values)), key=lambda j: abs(values[j] - value))
    return [values[j] for j in (i - 1, i + 1) if 0 <= j < len(values)]
