"""Parts of a stroke, each with its own controller of the same sections.

A case with a parameter p that `varies` has one controller for all of [p_low, p_high]. Here the
range is halved where that costs more than a share of the bandwidth that a position has alone:

    [p_low, p_high] -> [p_low, m + d], [m - d, p_high],    m the middle, d a share of the width

Parts overlap by 2 d, in which either controller is proven: the handover has a hysteresis, and lies
where both are valid. A part's search also begins at the controller of what it was halved from,
which keeps every bound on it: no part is slower than what it comes from.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure.box_proof import Proof
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.judgement import Judgement, judgement_of
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.searched_problem import state_of, with_state
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_problem import (
    StructuredProblem,
    structured_of,
    with_structured,
)
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.inner_problem.structured_search import prepare_search, search_starts, with_range
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import plural


@dataclass(frozen=True)
class ScheduleOptions:
    """Numbers of a schedule."""

    share: float = 0.9  # of the bandwidth that a position has alone, which its part has at least
    most: int = 8  # parts at most
    overlap: float = 0.05  # d, over the width of the part that is halved
    positions: int = 5  # at which a controller for it alone is searched, evenly over the range
    refinements: int = 3  # times that positions at which a part exceeds a bound join its design
    boxes: int = 4_000_000  # enclosures of the proof of a part at most: some two minutes


@dataclass(frozen=True)
class DesignedPart:
    """A part of the range with the controller that was found for it."""

    low: float  # of p, SI
    high: float  # of p, SI
    problem: CoDesignProblem  # with p in [low, high], and with what the search found
    design: SectionsDesign


@dataclass(frozen=True)
class Segment(DesignedPart):
    """A part that was judged."""

    judgement: Judgement  # on plants of the part
    proof: Proof  # on all of the part

    @property
    def passed(self) -> bool:
        """Judged well and not refuted."""
        return bool(self.judgement.passed) and not self.proof.refuted


@dataclass(frozen=True)
class Alone:
    """A position by itself: ω_b of its own best controller, rad/s; 0: none was found."""

    at: float
    bandwidth: float


def scheduled_name(problem: CoDesignProblem, name: str | None) -> str:
    """The parameter that a schedule is over: left out, the only one that varies.

    Raises a UserError where none varies, where several do and none is named, and for a controller
    of another kind.
    """
    if not isinstance(problem.controller, StructuredProblem):
        raise UserError('schedule: needs controller.structure = "sections"')
    names = [own for own, *_ in structured_of(problem).uncertainty.ranges]
    if not names:
        raise UserError("schedule: no parameter varies; give one `varies = true`")
    if name is None and len(names) > 1:
        raise UserError(f"schedule: {', '.join(names)} vary; say which is measured, with --by NAME")
    if name is not None and name not in names:
        raise UserError(f"--by {name}: does not vary; known are {', '.join(names)}")
    return name or names[0]


def within(problem: CoDesignProblem, name: str, low: float, high: float) -> CoDesignProblem:
    """The problem on a part of the range; with low = high that position alone."""
    u, middle = structured_of(problem).uncertainty, 0.5 * (low + high)
    ranges = tuple(
        (own, low, high) if own == name else (own, least, most) for own, least, most in u.ranges
        if own != name or low < high
    )  # fmt: skip
    fixed = tuple((own, middle if own == name else value, unit)
                  for own, value, unit in problem.source.fixed)  # fmt: skip
    found = replace(problem, source=replace(problem.source, fixed=fixed))
    found = with_structured(found, uncertainty=replace(u, ranges=ranges))
    return with_state(found, warm_starts=(), scenarios=())


Search = Callable[[float, float, SectionsDesign | None], DesignedPart]


def design_part(
    problem: CoDesignProblem, theta: Sequence[float], warm: SectionsDesign | None = None,
    log: Log = silent, workers: Pool | None = None,
) -> tuple[CoDesignProblem, SectionsDesign]:  # fmt: skip
    """The largest bandwidth on a part, from many starts, and from a controller that keeps it."""
    own = replace(problem, start=tuple(theta))
    if warm is not None:
        own = with_state(own, warm_starts=(tuple(map(float, warm.kappa)),))
    own, made, _ = prepare_search(own, log, workers)
    if warm is not None and not made.bandwidth >= warm.bandwidth:
        own, made = problem, warm  # which keeps every bound on the part, too
    return own, made


def segments_of(
    problem: CoDesignProblem, theta: Sequence[float], name: str, *,
    workers: Pool, log: Log = silent,
    options: ScheduleOptions = ScheduleOptions(),
) -> tuple[list[DesignedPart], list[Alone], float]:  # fmt: skip
    """Halve the range until every part has its share of what its positions have alone.

    Returns the parts, ascending; the positions alone; and ω_b of one controller for the whole
    range, rad/s. Where none keeps every bound on it, it is a UserError.
    """
    problem = with_range(replace(problem, start=tuple(theta)))  # one range of K for every part
    low, high = next((a, b) for own, a, b in structured_of(problem).uncertainty.ranges
                     if own == name)  # fmt: skip

    def search(a: float, b: float, warm: SectionsDesign | None = None) -> DesignedPart:
        return DesignedPart(
            a, b, *design_part(within(problem, name, a, b), theta, warm, log, workers)
        )

    alone = []
    for i, at in enumerate(np.linspace(low, high, options.positions).tolist(), 1):
        log(f"position {i} of {options.positions} alone, {name} = {at:.4g}")
        made = search(at, at).design
        alone.append(Alone(at, made.bandwidth if made.certified else 0.0))
    log("one controller for the whole range")
    whole = search(low, high)
    if not whole.design.certified:
        words = f"no controller for the whole range to begin with: {whole.design.words}"
        raise UserError(f"schedule: {words}")
    return halve(whole, alone, search, log, options), alone, whole.design.bandwidth


def halve(
    whole: DesignedPart, alone: Sequence[Alone], search: Search, log: Log = silent,
    options: ScheduleOptions = ScheduleOptions(),
) -> list[DesignedPart]:  # fmt: skip
    """Halve the part with the least share, until each has the required one, or there are enough.

    `search` designs for (low, high, a design that keeps every bound there); ascending.
    """
    parts = [whole]
    while len(parts) < options.most:
        slowest = min(parts, key=lambda part: share_of(part, alone))
        if share_of(slowest, alone) >= options.share:
            break
        parts.remove(slowest)
        a, b = slowest.low, slowest.high
        middle, d = 0.5 * (a + b), options.overlap * (b - a)
        for low, high in ((a, middle + d), (middle - d, b)):
            share = 100.0 * share_of(slowest, alone)
            log(f"part {low:.4g} to {high:.4g}: {share:.3g} % of what its positions have alone")
            parts.append(search(low, high, slowest.design))
    return sorted(parts, key=lambda part: part.low)


def share_of(part: DesignedPart, alone: Sequence[Alone]) -> float:
    """The least ω_b over that of a position alone, of the positions in a part; of a part between
    two of them, of these."""
    inside = [one for one in alone if part.low <= one.at <= part.high]
    if not inside:
        middle = 0.5 * (part.low + part.high)
        inside = sorted(alone, key=lambda one: abs(one.at - middle))[:2]
    return min(part.design.bandwidth / one.bandwidth if one.bandwidth else np.inf
               for one in inside)  # fmt: skip


def refine(
    part: DesignedPart, theta: Sequence[float], name: str, positions: Sequence[float], *,
    workers: Pool, log: Log = silent,
) -> DesignedPart:  # fmt: skip
    """Design a part anew from its own controller, with the plants at some positions in its set.

    The same is returned where no controller keeps the wider set.
    """
    own = uncertain_plant(part.problem, theta)
    row = np.arange(len(own.names)) == own.names.index(f"theta.{name}")
    more = [(option, tuple(np.where(row, p, corner).tolist()))
            for p in positions for option, corner in own.corners()]  # fmt: skip
    known = state_of(part.problem).scenarios
    problem = with_state(
        part.problem, scenarios=tuple(dict.fromkeys((*known, *more))),
        warm_starts=(tuple(map(float, part.design.kappa)),),
    )  # fmt: skip
    made = search_starts(problem, theta, log, workers, True)
    return replace(part, problem=problem, design=made) if made.certified else part


def judge_parts(
    parts: Sequence[DesignedPart], theta: Sequence[float], *, workers: Pool, log: Log = silent,
    options: ScheduleOptions = ScheduleOptions(),
) -> list[Segment]:  # fmt: skip
    """Judge and prove every part; the proofs, which take longest, are spread over the workers."""
    log(f"judge and proof of {plural(len(parts), 'part')}")
    on_boxes = [DesignOnBox(part.problem, tuple(theta), part.design) for part in parts]
    tasks = {i: (one, None, options.boxes) for i, one in enumerate(on_boxes)}
    proofs, found = dict(results(workers, DesignOnBox.proof, tasks)), []
    for i, (part, on_box) in enumerate(zip(parts, on_boxes, strict=True)):
        judgement = judgement_of(*on_box.on_lattice(on_box.worst(workers=workers)[0], workers))
        found.append(Segment(**vars(part), judgement=judgement, proof=proofs[i]))
    return found
