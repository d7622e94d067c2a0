"""Sections of an end taken out and put back where its multipliers promise most.

A zero and a pole that cancel do nothing, wherever they are: a local optimum in which a pair
cancels is one of a simpler structure, and may be left by the same pair at another frequency x.
There the pole of a cancelling pair has, with the multipliers μ of the end,

    dτ/dκ_p = -Σ μ_j ∂c_j/∂κ_p,

which is far from zero at some x unless the pair is of no use at all. A biquad is taken out too
where it does something: a climb that begins without it may end better.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ccd_casadi.fixed_structure.figures import constraints
from ccd_casadi.fixed_structure.local_search import Point
from ccd_casadi.fixed_structure.loop_problem import Problem
from ccd_casadi.fixed_structure.optimality import Optimality, optimality
from ccd_casadi.fixed_structure.structure import Kind
from ccd_casadi.support.arrays import Array

CANCELS = 0.5  # ln of a zero over a pole: nearer ones are taken out
PLACES = 24  # frequencies of the box that are tried
DAMPINGS = (0.05, 0.2, 0.8)  # of biquads, where the structure allows them
STEP = 0.3  # ln: how far a pole may move; a lightly damped one no further than its half width


def reinserted(problem: Problem, ends: Sequence[Point]) -> Array:
    """(N, n) controllers like those at the ends, each with one section that cancels."""
    found = [kappa for end in ends for kappa in _of_one(problem, end)]
    return np.clip(np.reshape(found, (-1, len(problem.box[0]))), *problem.box)


def _of_one(problem: Problem, end: Point) -> list[Array]:
    names, kinds, kappa = problem.structure.names, problem.structure.kinds, end.kappa
    if Kind.FREQUENCY not in kinds:
        return []
    # Of an end outside its bounds those count that it misses most.
    peaks, over = end.assessment.peaks, end.assessment.violation
    assert peaks is not None
    shifted = replace(end.assessment, peaks=replace(peaks, value=peaks.value - over))
    known = optimality(problem, replace(end, assessment=shifted))
    low, high = problem.box[:, kinds.index(Kind.FREQUENCY)]
    places = np.linspace(low, high, PLACES)
    zeros = [i for i, name in enumerate(names) if name.endswith((" zero", "integrator"))]
    poles = [i for i, name in enumerate(names) if name.endswith((" pole", "roll-off real"))]
    pairs = [(abs(kappa[z] - kappa[p]), z, p) for z in zeros for p in poles]
    found: list[Array] = []
    if pairs and min(pairs)[0] < CANCELS:
        _, z, p = min(pairs)
        tried = np.tile(kappa, (PLACES, 1))
        tried[:, z] = tried[:, p] = places
        if names[z] == "integrator":  # k ω_i stays
            tried[:, 0] += kappa[z] - places
        found.append(_best(problem, end, known, tried, [p], np.full((PLACES, 1), STEP)))
    for i in range(1, problem.structure.biquads + 1):
        z = names.index(f"biquad {i} zeros")
        least = np.exp(problem.box[0, z + 1])
        dampings = np.log(np.unique(np.maximum(DAMPINGS, least)))
        tried = np.tile(kappa, (PLACES * len(dampings), 1))
        tried[:, z] = tried[:, z + 2] = np.repeat(places, len(dampings))
        tried[:, z + 1] = tried[:, z + 3] = np.tile(dampings, PLACES)
        steps = np.column_stack([np.minimum(np.exp(tried[:, z + 1]), STEP),
                                 np.full(len(tried), STEP)])  # fmt: skip
        found.append(_best(problem, end, known, tried, [z + 2, z + 3], steps))
    return found


def _best(
    problem: Problem, end: Point, known: Optimality, tried: Array, poles: list[int], steps: Array
) -> Array:
    """The one of `tried` (N, n) whose `poles`, moved by `steps`, promise most."""
    mu = known.multipliers[: len(known.kinds)]
    slopes = [mu @ constraints(problem, kappa, end.tau, known.active).to_kappa[:, poles]
              for kappa in tried]  # fmt: skip
    return tried[np.argmax((np.abs(slopes) * steps).sum(axis=1))]
