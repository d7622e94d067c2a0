"""The multi-start searches of a co-design with a fixed structure, kept in the store of samples.

At the start such a search and one for worst plants give the problem its anchors and members; at
the end another asks whether they were good enough. A run that goes on from its store repeats
neither.
"""

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

from ccd_casadi.inner_problem.figure import BANDWIDTH
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_bandwidth import SectionsValue, sections_value, valued
from ccd_casadi.inner_problem.sections_plant_set import (
    plants_of,
    sections_of_problem,
    uncertain_plant,
)
from ccd_casadi.inner_problem.sections_problem import Member
from ccd_casadi.inner_problem.sections_search import least_from, prepared, race, with_range
from ccd_casadi.sampling.rows import problem_hash, sample_key
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Pool, Workers
from ccd_casadi.support.terminal import say


@dataclass(frozen=True)
class Seeds:
    """Anchors (κ in SI, rad/s) and members that the search at the start found; `words` why none."""

    anchors: tuple[tuple[float, ...], ...]
    members: tuple[Member, ...]
    error_anchors: tuple[tuple[float, ...], ...]
    words: str


def seeded_and_prepared(
    store: SampleStore,
    problem: CoDesignProblem,
    seed: int,
    quiet: bool,
    workers: Pool | None = None,
) -> tuple[CoDesignProblem, str]:
    """Anchors and members, from the store where an earlier run has found them.

    Second, in words, why there are no anchors; empty where there are.
    """
    own = replace(sections_of_problem(problem), seed=seed)
    problem = with_range(replace(problem, controller=own))
    owner = problem_hash({"seeds": problem.identity(), "inner": problem.inner_identity()})

    def found() -> Seeds:
        tell = teller("search at the start", quiet)
        anchored, made = prepared(problem, tell, workers)
        anchored, made = least_from(anchored, problem.start, made, tell)
        own, start = sections_of_problem(anchored), problem.start
        words = "" if made.certified else made.words
        alone = len(own.members) == len(uncertain_plant(problem, start).corners())
        if made.certified and alone and problem.figure is BANDWIDTH:
            # No plant was found worse: this is the search that an end at the start would ask for.
            value = valued(anchored, start, plants_of(anchored, start), made, 1)
            Sampler(anchored, store, Workers(1)).kept("race", start, SectionsValue, lambda: value)
        return Seeds(own.anchors, own.members, own.error_anchors, words)

    key = sample_key(owner, problem.start, 0.0, 0.0)
    seeds = store.kept(key, owner, problem.start, Seeds, found)
    sections = replace(
        sections_of_problem(problem), anchors=seeds.anchors, members=seeds.members,
        error_anchors=seeds.error_anchors,
    )  # fmt: skip
    return replace(problem, controller=sections), seeds.words


def raced_at(sampler: Sampler, theta: tuple[float, ...]) -> SectionsValue:
    """A multi-start search at θ with all its optima, counted; from the store if it is there."""
    problem = sampler.problem

    def raced() -> SectionsValue:
        made = race(problem, theta, teller("search at the end", sampler.quiet), sampler.workers)
        found = valued(problem, theta, plants_of(problem, theta), made, 1)
        return replace(found, design=replace(found.design, local_optima=made.local_optima))

    sampler.raced(sample_key(sampler.hash, theta, 0.0, 0.0))
    return sampler.kept("race", theta, SectionsValue, raced)


def value_at(sampler: Sampler, theta: tuple[float, ...]) -> SectionsValue:
    """The value at θ with its design and envelope, from the store where it was made before."""
    make = partial(sections_value, sampler.problem, theta)
    return sampler.kept("value", theta, SectionsValue, make)


def teller(label: str, quiet: bool) -> Callable[[str], None]:
    """Lines of progress on stderr."""

    def tell(words: str) -> None:
        if not quiet:
            with suppress(OSError, ValueError):  # a stream that fails ends the printing
                say(f"{label}: {words}", sys.stderr)

    return tell
