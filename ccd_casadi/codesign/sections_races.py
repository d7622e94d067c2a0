"""The races of a co-design with a controller of fixed structure, kept in the store of samples.

At the start a race and a search for worst plants give the problem its anchors and members; at the
end another asks whether they were good enough. A run that goes on from its store races neither
again.
"""

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from math import isfinite

from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.sections_bandwidth import prepared, race, valued, with_range
from ccd_casadi.inner_problem.sections_error import least_from
from ccd_casadi.inner_problem.sections_plant_set import plants_of, sections_of_problem
from ccd_casadi.sampling.keys import problem_hash, sample_key
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import Pool


@dataclass(frozen=True)
class Raced:
    """What a full race at the final θ found; κ in SI, rad/s; optima as (rad/s, count).

    `value` is what J counts: that bandwidth, or the least RMS error (m) from there, and κ that of
    its controller.
    """

    certified: bool
    bandwidth: float
    kappa: tuple[float, ...]
    optima: tuple[tuple[float, int], ...]
    value: float


def _seeded(problem: CoDesignProblem, seed: int) -> CoDesignProblem:
    return with_range(replace(problem, controller=replace(sections_of_problem(problem), seed=seed)))


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
    problem = _seeded(problem, seed)
    key = sample_key(problem_hash(problem.identity()), problem.start, 0.0, 0.0)
    stored = store.get_result(key)
    if stored is None:
        tell = teller("race at the start", quiet)
        found, made = prepared(problem, tell, workers)
        found, made = least_from(found, problem.start, made, tell)
        sections = sections_of_problem(found)
        stored = {
            "anchors": [list(a) for a in sections.anchors],
            "members": [[option, list(point)] for option, point in sections.members],
            "words": "" if made.certified else made.words,
            "error_anchors": [list(a) for a in sections.error_anchors],
        }
        owner = problem_hash({"race": problem_hash(problem.identity())})
        store.put_unit([], (key, owner, problem.start, stored), None)
    try:
        anchors = tuple(tuple(map(float, a)) for a in stored["anchors"])
        members = tuple((int(o), tuple(map(float, p))) for o, p in stored["members"])
        words = str(stored["words"])
        slower = tuple(tuple(map(float, a)) for a in stored.get("error_anchors", ()))
    except (KeyError, TypeError, ValueError) as error:
        raise store.damaged() from error
    sections = replace(
        sections_of_problem(problem), anchors=anchors, members=members, error_anchors=slower
    )
    return replace(problem, controller=sections), words


def raced_at(sampler: Sampler, theta: tuple[float, ...]) -> Raced:
    """A full race at θ, from the store where it was run before; counted."""
    problem, store = sampler.problem, sampler.store
    owner = problem_hash({"race": sampler.hash})
    key = sample_key(owner, theta, 0.0, 0.0)
    sampler.raced(key)
    stored = store.get_result(key)
    if stored is None:
        made = race(problem, theta, teller("race at the end", sampler.quiet), sampler.workers)
        found = valued(problem, theta, plants_of(problem, theta), made, 1)
        made = replace(found.design, local_optima=made.local_optima)
        stored = {
            "error": found.error if isfinite(found.error) else None,
            "certified": made.certified,
            "bandwidth": float(made.bandwidth) if made.certified else 0.0,
            "kappa": [float(v) for v in made.kappa] if made.certified else [],
            "optima": [[item.bandwidth, item.count] for item in made.local_optima],
        }
        store.put_unit([], (key, owner, theta, stored), None)
    try:
        optima = tuple((float(value), int(count)) for value, count in stored["optima"])
        kappa = tuple(map(float, stored["kappa"]))
        certified, bandwidth = bool(stored["certified"]), float(stored["bandwidth"])
        value = bandwidth if stored.get("error") is None else float(stored["error"])
        return Raced(certified, bandwidth, kappa, optima, value)
    except (KeyError, TypeError, ValueError) as error:
        raise store.damaged() from error


def teller(label: str, quiet: bool) -> Callable[[str], None]:
    """Lines of progress on stderr."""

    def tell(words: str) -> None:
        if not quiet:
            with suppress(OSError, ValueError):  # a stream that fails ends the printing
                print(f"{label}: {words}", file=sys.stderr, flush=True)

    return tell
