"""Parameters that are one of a few values: branch and bound over whole co-designs.

    min over z in lists, θ of J(θ, z)  >=  min over z in [least, largest], θ of J(θ, z)

A node has the listed parameters within ranges of their lists. Its bound is the co-design with these
taken as continuous; where an optimum is between two values of a list the node falls into those up
to the lower and those from the upper one. What is left with one value of each is a co-design at
these values. A node is cut where its bound is no better than the best design so far: bounds are
optima that were found, best of so many starts, so what is cut is no better as far as those hold.

Source: Land and Doig, Econometrica 28 (1960).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.codesign.design_plants import order
from ccd_casadi.codesign.solution import Solution
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.spent import spent_entry, was_moved

Lists = dict[str, tuple[float, ...]]
AT = 1e-6  # of a range: this close to a value of its list an optimum is on it
NO_BETTER = 1e-6  # relative: a bound that is lower by less is cut


@dataclass(frozen=True)
class Node:
    """What was solved: the values left of each list, status and J (inf: none was found)."""

    lists: Lists
    status: str
    objective: float

    @property
    def whole(self) -> bool:
        """Whether each list has come down to one value."""
        return all(len(values) == 1 for values in self.lists.values())


def restricted(problem: CoDesignProblem, lists: Mapping[str, tuple[float, ...]]) -> CoDesignProblem:
    """The problem with each list as a range, or with a fixed parameter where it has one value."""
    kept = [i for i, name in enumerate(problem.names) if len(lists.get(name, ())) != 1]
    fixed = tuple(
        (name, lists[name][0], problem.units[i])
        for i, name in enumerate(problem.names)
        if i not in kept
    )
    lower = [lists.get(problem.names[i], (problem.lower[i],))[0] for i in kept]
    upper = [lists.get(problem.names[i], (problem.upper[i],))[-1] for i in kept]
    return replace(
        problem,
        source=replace(problem.source, fixed=(*problem.source.fixed, *fixed)),
        names=tuple(problem.names[i] for i in kept),
        units=tuple(problem.units[i] for i in kept),
        lower=tuple(lower),
        upper=tuple(upper),
        start=tuple(
            float(np.clip(problem.start[i], low, high))
            for i, low, high in zip(kept, lower, upper, strict=True)
        ),
        listed=(),
    )


def best_of_lists(sampler: Sampler, solve: Callable[[Sampler], Solution]) -> Solution:
    """The best co-design with every listed parameter on a value of its list; `solve` does one.

    `listed` in the result: what was solved, what cut, and how far J is above that of the root.
    """
    began, problem = perf_counter(), sampler.problem
    open_: list[tuple[Lists, float]] = [(dict(problem.listed), -np.inf)]
    nodes: list[Node] = []
    best: Solution | None = None
    cut = 0
    while open_:
        lists, bound = open_.pop()
        if bound >= _least(best):
            cut += 1
            continue
        own = restricted(problem, lists)
        found = solve(sampler.of(own))
        found = replace(found, problem=found.problem or own)
        node = Node(lists, found.result["status"], found.result.get("objective", np.inf))
        nodes.append(node)
        if node.whole:
            best = found if best is None else min(best, found, key=order)
        elif node.objective < _least(best):
            theta = found.result["theta"]
            open_ += [(child, node.objective) for child in _children(problem, lists, theta)]
        elif np.isinf(_least(best)):  # none was found between the values: on them may be one
            open_ += [(child, -np.inf) for child in _halves(lists)]
        else:
            cut += 1
    assert best is not None
    result = best.result | {
        "seconds": perf_counter() - began,
        **spent_entry(sampler.spent.by_purpose, was_moved(best.result)),
        "listed": _listed(problem, best, nodes, cut),
    }
    words = _words(problem, result)
    notes = [*result.get("notes", ()), words]
    if result["status"] == "infeasible":
        result["reason"] = "; ".join(filter(None, (result["reason"], words)))
    return replace(best, result=result | {"notes": notes})


def _least(best: Solution | None) -> float:
    """The J from which on a node is cut: a design that is not verified cuts nothing."""
    if best is None or best.result["status"] != "verified":
        return np.inf
    J = float(best.result["objective"])
    return J - NO_BETTER * abs(J)


def _children(problem: CoDesignProblem, lists: Lists, theta: Mapping[str, float]) -> list[Lists]:
    """The parts of a node, the one to go on with last.

    The list whose optimum is furthest from its values is split there. Where all are on values these
    come first, then the rest on both sides of one of them.
    """
    width = {name: high - low for name, low, high in
             zip(problem.names, problem.lower, problem.upper, strict=True)}  # fmt: skip
    several = [name for name, values in lists.items() if len(values) > 1]
    nearest = {name: min(lists[name], key=lambda v: abs(v - theta[name])) for name in several}
    away = {name: abs(nearest[name] - theta[name]) / width[name] for name in several}
    name = max(several, key=lambda item: (away[item], len(lists[item])))
    value, on_values = nearest[name], away[name] <= AT
    middle = value if on_values else theta[name]
    low = tuple(v for v in lists[name] if v < middle)
    high = tuple(v for v in lists[name] if v > middle)
    parts: list[Lists] = [{name: part} for part in ((low, high) if value in high else (high, low))]
    if on_values:
        if len(several) > 1:
            parts.append({name: (value,)})
        parts.append({item: (nearest[item],) for item in several})
    return [lists | part for part in parts if all(part.values())]


def _halves(lists: Lists) -> list[Lists]:
    name = max(lists, key=lambda item: len(lists[item]))
    values = lists[name]
    middle = len(values) // 2
    return [lists | {name: values[middle:]}, lists | {name: values[:middle]}]


def _listed(
    problem: CoDesignProblem, best: Solution, nodes: list[Node], cut: int
) -> dict[str, Any]:
    root = nodes[0].objective
    J = best.result.get("objective", np.inf)
    found = bool(np.isfinite(J)) and bool(np.isfinite(root))
    assert best.problem is not None
    held = best.problem.source.held
    return {
        "values": {name: list(values) for name, values in problem.listed},
        "chosen": {name: held[name] for name, _ in problem.listed},
        "combinations": int(np.prod([len(values) for _, values in problem.listed])),
        "solved": len(nodes),
        "cut": cut,
        "free_objective": root if np.isfinite(root) else None,
        "above_free": (J - root) / abs(root) if found and root else None,
        "nodes": [
            {
                "lists": {name: list(values) for name, values in node.lists.items()},
                "status": node.status,
                "objective": node.objective if np.isfinite(node.objective) else None,
            }
            for node in nodes
        ],
    }


def _words(problem: CoDesignProblem, result: Mapping[str, Any]) -> str:
    found = result["listed"]
    units = dict(zip(problem.names, problem.units, strict=True))
    named = ", ".join(
        f"{name} = {value:g} {units[name]}".strip() + f" of {len(found['values'][name])}"
        for name, value in found["chosen"].items()
    )
    above = found["above_free"]
    free = ""
    if above is not None:
        far = f"{100 * above:.2g} % above" if above > NO_BETTER else "no worse than"
        free = f"; J is {far} that with all values between them allowed"
    counts = f"{found['solved']} co-designs for {found['combinations']} combinations"
    cut = f", {found['cut']} branches cut by optima that are best of their starts"
    return f"listed values: {named}{free}; {counts}{cut if found['cut'] else ''}"
