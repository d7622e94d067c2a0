"""Values on a drive's grid: one after the other is put on its better neighbour, and the others make
up for it; then single steps as long as one of them helps."""

from dataclasses import dataclass

import numpy as np

from ccd_casadi.extensions.drives.cascade_search import Candidate, Search
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class RoundingOptions:
    """Numbers of the rounding.

    Attributes
    ----------
    steps : int
        Of the other values, for each neighbour.
    passes, hops : int, tuple of int
        Over all values by these numbers of steps, at most.
    fine : float
        A step that is this small relative to its value is rounded without a search.
    """

    steps: int = 6
    passes: int = 8
    hops: tuple[int, ...] = (-3, -1, 1, 3)
    fine: float = 1e-5


def on_the_grid(
    search: Search, candidate: Candidate, options: RoundingOptions = RoundingOptions()
) -> Candidate:
    """Put every value on the drive's grid.

    Parameters
    ----------
    search : Search
        Whose plants, bounds and frequencies count.
    candidate : Candidate
    options : RoundingOptions

    Returns
    -------
    Candidate
        ω_b and the largest excess on the search's grid, of values on the drive's.
    """
    settings = search.cascade.settings
    values, band = candidate.values.copy(), candidate.bandwidth
    coarse = np.array([setting.step / (value * setting.per_si)
                       for setting, value in zip(settings, values, strict=True)])  # fmt: skip
    fixed = np.zeros(len(values), bool)
    for i in np.argsort(-coarse).tolist():
        own, fixed[i] = settings[i], True
        near = {own.rounded(values[i], by) for by in (-1, 0, 1)}
        if coarse[i] < options.fine:
            near = {own.rounded(values[i])}
        search.refine(values)
        found = []
        for value in sorted(near):
            there = values.copy()
            there[i] = value
            if value > 0.0 and search.stable(there):
                found.append(search.climb(there, fixed, options.steps, band))
        if not found:
            break
        best = min(found, key=lambda one: _merit(search, one))
        values, band = best.values.copy(), best.bandwidth
    values = np.array([own.rounded(value) for own, value in zip(settings, values, strict=True)])
    return _by_steps(search, values, options)


def _by_steps(search: Search, values: Array, options: RoundingOptions) -> Candidate:
    """Single steps of single values, each kept if it helps and keeps the loops stable."""

    def of(values: Array) -> Candidate:
        return Candidate(values, *search.judged(values))

    here = of(values)
    for _ in range(options.passes):
        moved = False
        for i, own in enumerate(search.cascade.settings):
            for by in options.hops:
                there = here.values.copy()
                there[i] = own.rounded(there[i], by)
                if there[i] > 0.0 and there[i] != here.values[i]:
                    found = of(there)
                    if _merit(search, found) < _merit(search, here) and search.stable(there):
                        here, moved = found, True
        if not search.refine(here.values) and not moved:
            break
        here = of(here.values)
    return here


def _merit(search: Search, candidate: Candidate) -> float:
    over = max(candidate.excess, 0.0)
    return float(search.options.penalty * over - np.log(candidate.bandwidth))
