"""Parameters that are one of a few values: branch and bound, the most promising part first.

    min over z in lists, θ of J(θ, z)  >=  min over z in [least, largest], θ of J(θ, z)

A part has the listed parameters within ranges of their lists. Its bound is the least J that a
search finds with these taken as continuous. Where that is between two values of a list the part
falls into those up to the lower and those from the upper one; where all are on values that
combination is the best of the part. A search begins at the nearest optimum that is known. The first
combination whose bound is the least of all is the best one, and what is left is cut: bounds are
optima that were found, so what is cut is no better as far as those hold. A search that beats its
bound shows by how much bounds may be wrong: all others are lowered by twice as much, and searches
begin at what it has found.

Where true values are cheap, exchanges give a combination to begin with (`exchange`): its design is
judged before the first part is split, and cuts from there on if it is verified.

Source: Land and Doig, Econometrica 28 (1960).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.codesign.design_plants import order
from ccd_casadi.codesign.exchange import best_exchange, nearest_combination
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.sampling.inner_samples import with_all_spent
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.terminal import duration, remark
from ccd_casadi.support.text import plural
from ccd_casadi.support.time_budget import StageOptions, ends_early, stage

Lists = dict[str, tuple[float, ...]]
Search = Callable[[Sampler, Solution | None], Solution]
Judge = Callable[[Sampler, Solution], Solution]


@dataclass(frozen=True)
class BranchOptions:
    """Numbers of branch and bound over lists."""

    on_value: float = 1e-6  # of a range: this close to a value of its list an optimum is on it
    no_better: float = 1e-6  # of the terms of J: a bound that is lower by less is cut
    few: int = 4  # combinations up to which all are searched: bounds would save no search
    foreseen: float = 3600.0  # s: a longer time of searching every combination is not shown


@dataclass(frozen=True)
class Node:
    """A node that was searched: the values left of each list, status and J (inf: none was found),
    and the terms of J in words."""

    lists: Lists
    status: str
    objective: float
    words: str

    @property
    def whole(self) -> bool:
        """Whether each list has come down to one value."""
        return all(len(values) == 1 for values in self.lists.values())


@dataclass(frozen=True)
class _Part:
    """A part that is left to search: the values of each list, a bound of its J, and the θ where
    that was found, by name.

    `found`: of one combination that was searched, but not judged. `lost`: part of one where nothing
    was found, looked at where nothing else is left.
    """

    lists: Lists
    bound: float
    theta: Mapping[str, float]
    found: Solution | None = None
    lost: bool = False

    @property
    def count(self) -> int:
        """The number of its combinations."""
        return int(np.prod([len(values) for values in self.lists.values()]))


def restrict(problem: CoDesignProblem, lists: Mapping[str, tuple[float, ...]]) -> CoDesignProblem:
    """The problem with each list as a range, or with a fixed parameter where it has one value."""
    units, start = problem.parameter_units, dict(zip(problem.names, problem.start, strict=True))
    ends = zip(problem.names, problem.lower, problem.upper, strict=True)
    ranges = {name: lists.get(name, (low, high)) for name, low, high in ends}
    fixed = tuple((name, *one, units[name]) for name, one in ranges.items() if len(one) == 1)
    kept = [name for name, values in ranges.items() if len(values) > 1]
    lower, upper = ([ranges[name][end] for name in kept] for end in (0, -1))
    return replace(
        problem,
        source=replace(problem.source, fixed=(*problem.source.fixed, *fixed)),
        names=tuple(kept),
        units=tuple(units[name] for name in kept),
        lower=tuple(lower),
        upper=tuple(upper),
        start=tuple(np.clip([start[name] for name in kept], lower, upper).tolist()),
        listed=(),
    )


@dataclass
class _Branching:
    """Branch and bound on the way: parts that are left, nodes that were searched, solutions near
    which others begin, and the best of those that are judged."""

    sampler: Sampler
    between: Search
    at: Search
    judge: Judge | None
    options: BranchOptions
    left: list[_Part] = field(default_factory=list)
    nodes: dict[tuple[tuple[float, ...], ...], Node] = field(default_factory=dict)
    known: list[Solution] = field(default_factory=list)
    best: Solution | None = None
    exchanged: Lists = field(default_factory=dict)  # the combination that exchanges found
    tried: int = 0  # by exchanges
    judged: int = 0

    def __post_init__(self) -> None:
        problem = self.problem = self.sampler.problem
        ends = zip(problem.names, problem.lower, problem.upper, strict=True)
        self.width = {name: high - low for name, low, high in ends}
        self.left.append(_Part(dict(problem.listed), -np.inf, {}))
        self.count = self.left[0].count

    def take(self) -> _Part | None:
        """Take the most promising part; None where what is left is cut, or the time is up."""
        most = self.count // 2 if self.count > self.options.few else 0
        while self.left:
            part = min(self.left, key=lambda p: (p.lost, p.bound, p.count > 1,
                                                 self._distance(p.lists, p.theta)))  # fmt: skip
            least = self._least()
            if part.bound >= least or (part.lost and np.isfinite(least)):
                return None
            unknown = sum(p.count for p in self.left if p.found is None)
            if self.nodes and ends_early("listed combination", unknown):
                return None
            self.left.remove(part)
            if part.lists == self.exchanged and part.found is None:
                continue  # it was searched before the first part was split
            if part.count == 1 or sum(not node.whole for node in self.nodes.values()) < most:
                return part
            rows = product(*([(v,) for v in values] for values in part.lists.values()))
            self.left += [replace(part, lists=dict(zip(part.lists, row, strict=True)))
                          for row in rows]  # fmt: skip
        return None

    def _least(self) -> float:
        """J from which a part is cut: a design that is not verified cuts nothing."""
        if self.best is None or self.best.result["status"] != "verified":
            return np.inf
        same = _same(self.problem, self.best, self.options.no_better)
        return float(self.best.result["objective"] - same)

    def _distance(self, lists: Lists, theta: Mapping[str, float]) -> float:
        """Return the distance of a point from a part, in shares of the ranges."""
        ends = [(values[0], theta[name], values[-1], self.width[name])
                for name, values in lists.items() if name in theta]  # fmt: skip
        return sum(abs(float(np.clip(v, low, high)) - v) / size for low, v, high, size in ends)

    def search(self, part: _Part) -> tuple[Sampler, Solution]:
        """Search a part, or judge what was found in it, and add what is left of it."""
        own, whole = restrict(self.problem, part.lists), part.count == 1
        near = min(self.known, key=lambda item: self._distance(part.lists, _point(item)),
                   default=None)  # fmt: skip
        each = self.sampler.of(own, traced=whole)
        if self.judge is not None and part.found is not None:
            found, self.judged = self.judge(each, part.found), self.judged + 1
        else:
            found = (self.at if whole else self.between)(each, near)
        found = self._note(part.lists, found, own)
        J = found.result.get("objective", np.inf)
        self._loosen(part, found, J)
        if np.isfinite(J):
            self.known.append(found)
        self._branch(part, found, J)
        return each, found

    def _note(self, lists: Lists, found: Solution, own: CoDesignProblem) -> Solution:
        """Note the node of a solution; a solution without its problem is of `own`."""
        result = found.result
        words, J = _describe_terms(self.problem, result), result.get("objective", np.inf)
        self.nodes[tuple(lists.values())] = Node(lists, result["status"], J, words)
        return replace(found, problem=found.problem or own)

    def _loosen(self, part: _Part, found: Solution, J: float) -> None:
        """Lower the bounds of all others where this one was wrong, and forget where it is from."""
        gained = part.bound - J if found.result["status"] != "not_verified" else 0.0
        same = _same(self.problem, found, self.options.no_better)
        if gained > same:  # as little as that bound are other ends the least of their parts
            self.known.clear()
        if gained > same or (part.found and -gained > same):
            lower = 2.0 * max(gained, 0.0)
            self.left = [replace(one, bound=one.bound - lower, found=None) for one in self.left]

    def _branch(self, part: _Part, found: Solution, J: float) -> None:
        """Add what is left of a part that was searched, or compare its design with the best."""
        if part.count == 1:
            if self.judge is not None and part.found is None and np.isfinite(J):
                self.left.append(replace(part, bound=J, found=found))
            else:
                self.best = found if self.best is None else min(self.best, found, key=order)
        elif np.isfinite(J):
            theta = _point(found)
            children = _children(self.width, part.lists, theta, self.options.on_value)
            self.left += [_Part(child, J, theta) for child in children]
        else:
            self.left += [replace(part, lists=half, lost=True) for half in _halves(part.lists)]

    def exchange(self, between: Sampler, free: Solution) -> None:
        """Search the combination that exchanges find from an optimum between the values."""
        assert free.problem is not None
        of = between.of(free.problem) if self.judge else between  # with its warm starts
        theta = dict(zip(self.problem.names, self.problem.start, strict=True)) | _point(free)
        found, self.tried = best_exchange(
            of, dict(self.problem.listed), theta, nearest_combination(self.problem, theta)
        )
        self.exchanged = {name: (value,) for name, value in found.items()}
        own = restrict(self.problem, self.exchanged)
        first = self._note(self.exchanged, self.at(self.sampler.of(own), free), own)
        J = first.result.get("objective", np.inf)
        if np.isfinite(J):
            self.known.append(first)
        if self.judge is None:
            self.best = first
        elif np.isfinite(J):
            self.left.append(_Part(self.exchanged, J, _point(first), first))

    def end_early(self) -> Solution:
        """Find the design of one combination: of the best that was found, else the nearest to what
        was."""
        part = min((part for part in self.left if part.found), key=lambda p: p.bound, default=None)
        if part is not None and part.found is not None and self.judge is not None:
            own = restrict(self.problem, part.lists)
            return self._note(part.lists, self.judge(self.sampler.of(own), part.found), own)
        best = min(self.known, key=lambda one: one.result["objective"], default=None)
        theta = dict(zip(self.problem.names, self.problem.start, strict=True))
        near = nearest_combination(self.problem, theta if best is None else theta | _point(best))
        lists: Lists = {name: (value,) for name, value in near.items()}
        own = restrict(self.problem, lists)
        solution = self.at(self.sampler.of(own), best)
        if self.judge is not None and np.isfinite(solution.result.get("objective", np.inf)):
            started = replace(solution, problem=solution.problem or own)
            solution = self.judge(self.sampler.of(own), started)
        return self._note(lists, solution, own)


def best_of_lists(
    sampler: Sampler,
    between: Search,
    at: Search,
    judge: Judge | None = None,
    exchanges: bool = False,
    options: BranchOptions = BranchOptions(),
) -> Solution:
    """The best co-design with every listed parameter on a value of its list.

    `between` searches a part, `at` a combination, both near a solution that is given; with `judge`
    what `at` finds is only good for its J, and the best is judged from there. With `exchanges` the
    first combination is that of `best_exchange`.
    """
    began, problem = perf_counter(), sampler.problem
    way = _Branching(sampler, between, at, judge, options)
    while (part := way.take()) is not None:
        each, found = way.search(part)
        first = len(way.nodes) == 1 and part.count > 1
        if exchanges and first and np.isfinite(found.result.get("objective", np.inf)):
            way.exchange(each, found)
        remark(_progress(way.count, list(way.nodes.values()), way.left, began), sampler.quiet)
    best = way.best
    if best is None:  # the time was up
        with stage(StageOptions.ending):
            best = way.end_early()
    listed = _describe_lists(problem, best, [*way.nodes.values()], way.left, way.judged)
    result = with_all_spent(best.result, sampler.spent.by_purpose) | {
        "seconds": perf_counter() - began, "listed": listed | {"exchanged": way.tried},
    }  # fmt: skip
    words = _words(problem, result)
    notes = [*result.get("notes", ()), words]
    if result["status"] == "infeasible":
        result["reason"] = "; ".join(filter(None, (result["reason"], words)))
    return replace(best, result=result | {"notes": notes})


def _progress(count: int, nodes: Sequence[Node], left: Sequence[_Part], began: float) -> str:
    """Describe how far the search is, the bound on what is left, and how long searching it all
    takes, where a person may wait for that."""
    J = min((node.objective for node in nodes if node.whole), default=np.inf)
    best = f"best J {J:.6g}" if np.isfinite(J) else "no combination searched yet"
    rest = sum(part.count for part in left if part.found is None)
    bound = min((part.bound for part in left), default=np.inf)
    there = f" with J from {bound:.6g}" if np.isfinite(bound) else ""
    seconds = (perf_counter() - began) / len(nodes) * rest
    more = f", {duration(seconds)} at most" if seconds <= BranchOptions.foreseen else ""
    left_words = f"{rest} of {plural(count, 'combination')} left{there}{more}"
    return f"lists: {best}, {left_words if rest else 'none left'}"


def _point(solution: Solution) -> dict[str, float]:
    """θ of a solution and the values that were held, by name."""
    assert solution.problem is not None
    return solution.problem.source.held | solution.result["theta"]


def _same(problem: CoDesignProblem, solution: Solution, share: float) -> float:
    """Return the amount by which J may differ and count as the same: a share of its terms."""
    cost, J = (float(solution.result.get(key, 0.0)) for key in ("hardware_cost", "objective"))
    hardware = problem.w1 * cost
    return share * (abs(hardware) + abs(J - hardware)) if np.isfinite(J) else 0.0


def _children(
    width: Mapping[str, float], lists: Lists, theta: Mapping[str, float], on_value: float
) -> list[Lists]:
    """The parts of a part: on both sides of θ in the list whose values are furthest from it.

    Where all of θ is on values these are a part, and what is beside them are others.
    """
    several = [name for name, values in lists.items() if len(values) > 1]
    nearest = {name: min(lists[name], key=lambda v: abs(v - theta[name])) for name in several}
    away = {name: abs(nearest[name] - theta[name]) / width[name] for name in several}
    furthest = max(several, key=lambda item: (away[item], len(lists[item])))
    on_values = away[furthest] <= on_value
    held: Lists = {}
    parts: list[Lists] = []
    for name in several if on_values else [furthest]:
        middle = nearest[name] if on_values else theta[name]
        below = tuple(v for v in lists[name] if v < middle)
        above = tuple(v for v in lists[name] if v > middle)
        parts += [held | {name: side} for side in (below, above) if side]
        held = held | {name: (nearest[name],)}
    return [lists | part for part in (*parts, *([held] if on_values else []))]


def _halves(lists: Lists) -> list[Lists]:
    name = max(lists, key=lambda item: len(lists[item]))
    values = lists[name]
    middle = len(values) // 2
    return [lists | {name: values[middle:]}, lists | {name: values[:middle]}]


def _describe_lists(
    problem: CoDesignProblem, best: Solution, nodes: list[Node], left: list[_Part], judged: int
) -> dict[str, Any]:
    whole = sum(node.whole for node in nodes)
    free = np.inf if nodes[0].whole else nodes[0].objective
    J = best.result.get("objective", np.inf)
    assert best.problem is not None
    held = best.problem.source.held
    cut, lost = ([part for part in left if part.lost is item] for item in (False, True))
    return json_values({
        "values": dict(problem.listed),
        "chosen": {name: held[name] for name, _ in problem.listed},
        "combinations": int(np.prod([len(values) for _, values in problem.listed])),
        "solved": whole,
        "between": len(nodes) - whole,
        "judged": judged,
        "cut": sum(part.count for part in cut),
        "least_of_cut": min((part.bound for part in cut), default=None),
        "without_design": sum(part.count for part in lost),
        "free_objective": free,
        "objective_above_free": J - free,
        "nodes": nodes,
    })  # fmt: skip


def _describe_terms(problem: CoDesignProblem, result: Mapping[str, Any]) -> str:
    """Describe the terms of J: the bandwidth or the error, at the hardware cost."""
    if "hardware_cost" not in result:
        return ""
    v, value = problem.figure, f"{result['bandwidth_hz']:.4g} Hz"
    if result.get(f"{v.entry}_of_set") is not None and v is not BANDWIDTH:
        value = f"{v.words} {v.format_value(result[f'{v.entry}_of_set'])}"
    return f"{value} at {result['hardware_cost']:.4g} {problem.cost_unit}".strip()


def _words(problem: CoDesignProblem, result: Mapping[str, Any]) -> str:
    found = result["listed"]
    units = dict(zip(problem.names, problem.units, strict=True))
    named = ", ".join(
        f"{name} = {value:g} {units[name]}".strip() + f" (of {len(found['values'][name])} values)"
        for name, value in found["chosen"].items()
    )
    above, free = found["objective_above_free"], ""
    if above is not None:
        far = f"{above:.3g} above" if above > 0.0 else "no worse than"
        there, here = found["nodes"][0]["words"], _describe_terms(problem, result)
        figures = f" ({there} there, {here} here)" if there else ""
        free = f"; J is {far} the best with any value between them{figures}"
    counts = f"{found['solved']} of {plural(found['combinations'], 'combination')} searched"
    if found["exchanged"]:
        counts += f", {found['exchanged']} evaluated at the theta of the first of these parts"
    if found["between"]:
        counts += f", and {plural(found['between'], 'part')} with any value between them"
    if found["cut"] and found["least_of_cut"] is not None:
        counts += f", {found['cut']} excluded: with any value between, the best found in their"
        counts += f" parts is J {found['least_of_cut']:.6g} or more"
    if found["without_design"]:
        counts += f", {found['without_design']} in parts where no design was found"
    for one in found["nodes"]:
        single = all(len(values) == 1 for values in one["lists"].values())
        if single and one["status"] == "not_verified" and one["objective"] < result["objective"]:
            values = ", ".join(f"{name} = {value:g}" for name, (value,) in one["lists"].items())
            counts += f"; not verified with J {one['objective']:.6g}, which is less: {values}"
            counts += " (fix these values to see why)"
    return f"listed values: {named}{free}; {counts}"
