"""A schedule judged at positions of its range, and what it leaves in its folder, with its page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_channels import loop_figures
from ccd_casadi.codesign.structured_entries import proof_dict, sections_controller
from ccd_casadi.deployment.realisation import literal, literals
from ccd_casadi.drawing import content as c
from ccd_casadi.drawing.svg import BLUE, GREY, ORANGE
from ccd_casadi.extensions.schedule.handover import (
    CrossingOptions,
    RateBound,
    RateTrial,
    controllers_of,
    handovers,
)
from ccd_casadi.extensions.schedule.segments import (
    Alone,
    DesignedPart,
    ScheduleOptions,
    Segment,
    refine,
    within,
)
from ccd_casadi.fixed_structure.judgement import judge_loops
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.lti.loop import Sampling, zoh
from ccd_casadi.lti.state_space import closed_loop
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.json_files import json_values
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.terminal import Log, silent
from ccd_casadi.support.text import HZ, plural, template

CODE = ("schedule.h", "schedule.c")


@dataclass(frozen=True)
class FrozenPosition:
    """A position at rest, with each part that may control there."""

    at: float
    failed: tuple[int, ...]  # parts, from 0, that exceed a bound on a plant of the set there
    bandwidth: float  # on the model there, the slowest of the parts, rad/s

    @property
    def passed(self) -> bool:
        """Every part that may control there keeps every bound."""
        return not self.failed


@dataclass(frozen=True)
class Schedule:
    """A schedule and what is known of it."""

    name: str  # of the parameter that is measured
    unit: str  # of it
    segments: tuple[Segment, ...]
    alone: tuple[Alone, ...]
    whole: float  # ω_b of one controller for all of the range, rad/s
    frozen: tuple[FrozenPosition, ...]
    rates: tuple[RateTrial, ...]
    bound: RateBound
    crossed: RateTrial  # the simulation at this bound

    @property
    def verified(self) -> bool:
        """Every part judged well and not refuted, every position too, and a rate allowed."""
        parts = all(one.passed for one in self.segments)
        return parts and all(one.passed for one in self.frozen) and self.allowed > 0.0

    @property
    def proven(self) -> int:
        """Parts on all of which every bound is proven."""
        return sum(segment.proof.proven for segment in self.segments)

    @property
    def allowed(self) -> float:
        """The highest rate of the simulation that is allowed; 0: none."""
        kept = [one.rate for one in self.rates if one.rise <= CrossingOptions().rise]
        return max(kept, default=0.0)

    @property
    def of_bound(self) -> str:
        """The rate at which V falls, what sets it, and what the simulation has there."""
        bound, unit = self.bound, self.unit or "–"
        if not bound.rate:
            return f"no rate is bounded: V does not fall in part {bound.part + 1}"
        at = f"part {bound.part + 1}" if bound.at is None else f"the handover at {bound.at:.4g}"
        words = (
            f"{bound.rate:.3g} {unit}/s by a Lyapunov function at {bound.positions} positions of "
            f"each part, not proven between; {at} sets it; turn back {max(bound.waits):.3g} s after"
            " a handover or later"
        )
        if np.isnan(self.crossed.rise):
            return f"{words}; too slow to simulate"
        return (
            f"{words}; simulated: largest motion {self.crossed.rise:.3g} times that at rest, "
            f"{self.crossed.left:.1g} of it left after the way back without a force"
        )

    @property
    def least_share(self) -> float:
        """The least share of ω_b over that of a position alone, of the positions of `alone`."""
        places = [one.at for one in self.frozen]
        found = np.interp([one.at for one in self.alone], places,
                          [one.bandwidth for one in self.frozen])  # fmt: skip
        return min(own / one.bandwidth if one.bandwidth else np.inf
                   for own, one in zip(found.tolist(), self.alone, strict=True))  # fmt: skip


def frozen_positions(
    problem: CoDesignProblem, theta: Sequence[float], name: str, parts: Sequence[DesignedPart],
    positions: Sequence[float],
) -> list[FrozenPosition]:  # fmt: skip
    """Judge every part where it may control, on the model and the corners of its set there."""
    sampling, bounds = structured_of(problem).sampling, bounds_of(problem)
    assert sampling is not None
    K, integrator = controllers_of(parts, sampling), structure_of(problem).integrator
    found, own = [], uncertain_plant(problem, theta)
    at = own.names.index(f"theta.{name}")
    corners = uncertain_plant(within(problem, name, positions[0], positions[0]), theta).corners()
    for p in positions:
        plants = own.as_written([(option, np.insert(one, at, p)) for option, one in corners])
        failed, bandwidth = [], np.inf
        for i, (one, coded) in enumerate(zip(parts, K, strict=True)):
            if not one.low <= p <= one.high:
                continue
            assert one.design.controller is not None
            judged = judge_loops(plants, one.design.controller, coded, bounds, sampling,
                                 one.design.bandwidth, integrator)  # fmt: skip
            loop = closed_loop(zoh(plants[0], sampling.period, sampling.delay), coded)
            bandwidth = min(bandwidth, loop_figures(loop, bounds.places).bandwidth)
            failed += [] if judged.passed else [i]
        found.append(FrozenPosition(p, tuple(failed), float(bandwidth)))
    return found


def keep_at_positions(
    problem: CoDesignProblem, theta: Sequence[float], name: str, parts: Sequence[DesignedPart],
    count: int, *, workers: Pool, log: Log = silent,
    options: ScheduleOptions = ScheduleOptions(),
) -> tuple[list[DesignedPart], list[FrozenPosition]]:  # fmt: skip
    """Judge the parts at positions; where one exceeds a bound, design it anew and judge at others.

    These are even over the range, `count` of them; after a new design those between. What is
    returned are the parts in the end, with their positions.
    """
    parts, places = list(parts), np.linspace(parts[0].low, parts[-1].high, count)
    for turn in range(options.refinements + 1):
        log(f"{count} positions are judged")
        found = frozen_positions(problem, theta, name, parts, places.tolist())
        late = {i for one in found for i in one.failed}
        if not late or turn == options.refinements:
            break
        for i in late:
            own = [one.at for one in found if i in one.failed]
            log(f"part {i + 1} is designed anew: it exceeds a bound at {len(own)} positions")
            parts[i] = refine(parts[i], theta, name, own, workers=workers, log=log)
        between = 0.5 * (places[1:] + places[:-1])
        places = np.concatenate([places[:1], between, places[-1:]])  # the ends are corners
    return parts, found


def entry(found: Schedule) -> dict[str, Any]:
    """The content of schedule.json: Hz where the name says so, else SI."""
    kept = sum(one.passed for one in found.frozen)
    return json_values({
        "status": "verified" if found.verified else "not_verified",
        "parameter": found.name, "unit": found.unit,
        "bandwidth_hz_of_one_controller": found.whole / HZ,
        "parts": [
            {"low": one.low, "high": one.high, "bandwidth_hz": one.design.bandwidth / HZ,
             "passed": one.passed, "judge": one.judgement.entry, "proof": proof_dict(one.proof),
             "controller": sections_controller(one.design, structured_of(one.problem).sampling)}
            for one in found.segments
        ],
        "alone": [{"at": one.at, "bandwidth_hz": one.bandwidth / HZ} for one in found.alone],
        "least_share_of_alone": found.least_share,
        "positions": len(found.frozen), "positions_kept": kept,
        "least_bandwidth_hz": min(one.bandwidth for one in found.frozen) / HZ,
        "proven_parts": found.proven,
        "rates": [vars(one) for one in found.rates], "allowed_rate": found.allowed,
        "rate_bound": vars(found.bound) | {"simulated": vars(found.crossed)},
    })  # fmt: skip


def summary(found: Schedule) -> list[str]:
    """The lines that the command prints."""
    kept = sum(one.passed for one in found.frozen)
    unit = f" {found.unit}".rstrip()
    rows = [
        ("one", f"controller for all of {found.name}: {found.whole / HZ:.4g} Hz"),
        *(("part", f"{found.name} = {one.low:.4g} to {one.high:.4g}{unit}: "
           f"{one.design.bandwidth / HZ:.4g} Hz, {one.proof.words}") for one in found.segments),
        *(("alone", f"at {one.at:.4g}{unit}: {one.bandwidth / HZ:.4g} Hz") for one in found.alone),
        ("share", f"at least {100.0 * found.least_share:.3g} % of what a position has alone"),
        ("judged", f"{kept} of {plural(len(found.frozen), 'position')} keep every bound"),
        ("proven", f"{found.proven} of {plural(len(found.segments), 'part')}"),
        ("rate", f"up to {found.allowed:.3g}{unit}/s: the largest motion rises by "
         f"{100.0 * (CrossingOptions().rise - 1.0):.3g} % at most (simulated, not proven)"
         if found.allowed else "none of the simulated rates keeps the loop quiet"),
        ("bound", found.of_bound),
    ]  # fmt: skip
    return [f"{name:14s}{words}" for name, words in rows]


def write_code(folder: Path, found: Schedule, sampling: Sampling) -> None:
    """Write schedule.h and schedule.c."""
    K = controllers_of(found.segments, sampling)

    def join(parts: Sequence[Array]) -> str:
        return literals(np.concatenate([part.ravel() for part in parts]), 4)

    values: Mapping[str, Any] = {
        "name": found.name, "unit": found.unit or "its unit", "parts": len(K),
        "status": "verified" if found.verified else "NOT verified",
        "period": literal(sampling.period), "rate": f"{sampling.rate_hz:.10g}",
        "delay": f"{sampling.delay:.10g}", "allowed": f"{found.allowed:.3g}",
        "bound": f"{found.bound.rate:.3g}", "wait": f"{max(found.bound.waits):.3g}",
        "n": len(K[0].A), "p": K[0].B.shape[1], "m": len(K[0].C),
        "low": literals(np.array([one.low for one in found.segments]), 4),
        "high": literals(np.array([one.high for one in found.segments]), 4),
        **{part: join([getattr(one, part) for one in K]) for part in "ABCD"},
        "T": literals(handovers(K), 4),
    }  # fmt: skip
    for name in CODE:
        text = template(f"extensions/schedule/templates/{name}").render(values)
        (folder / name).write_text(text, "utf-8")


def schedule_page(title: str, found: Schedule) -> c.Page:
    """Make the page report.html."""
    kept = sum(one.passed for one in found.frozen)
    lead = (
        f"{len(found.segments)} controllers of the same sections, one for each part of "
        f"{found.name}: at least {100.0 * found.least_share:.3g} % of the bandwidth that a "
        f"position has alone. One controller for all of it has {found.whole / HZ:.4g} Hz."
    )
    meta = (
        f"{kept} of {len(found.frozen)} positions keep every bound; {found.proven} of "
        f"{len(found.segments)} parts are proven"
    )
    head = c.Head(
        f"Schedule of {title}", "good" if found.verified else "bad",
        "verified" if found.verified else "not verified", "", meta, lead,
    )  # fmt: skip
    unit = found.unit or "–"
    rows = tuple(
        (f"{one.low:.4g} to {one.high:.4g}", one.design.bandwidth / HZ, one.proof.words)
        for one in found.segments
    )
    table = c.Table((f"{found.name} ({unit})", "bandwidth on its whole set (Hz)", "proof"), rows)
    return c.Page(head, (
        c.Chapter("Bandwidth over the range", (_bandwidths(found, unit),)),
        c.Chapter("The parts", (table,)),
        c.Chapter("On the way", (_rates(found, unit),)),
    ), index="")  # fmt: skip


def _bandwidths(found: Schedule, unit: str) -> c.Figure:
    at = np.array([one.at for one in found.frozen])
    alone = np.array([[one.at, one.bandwidth / HZ] for one in found.alone])
    panel = c.Panel(
        f"{found.name} ({unit})", "bandwidth (Hz)",
        (c.Curve(at, np.array([one.bandwidth / HZ for one in found.frozen]), "the schedule", BLUE),
         c.Curve(at, np.full(len(at), found.whole / HZ), "one controller, on its whole set", GREY),
         c.Curve(alone[:, 0], alone[:, 1], "each position alone", ORANGE, line="", marker="o")),
        levels=tuple(c.Level(one.low, "", vertical=True) for one in found.segments[1:]),
    )  # fmt: skip
    words = (
        "On the model at each position; where parts overlap, of the slower one. Lines: where a "
        "part begins."
    )
    return c.Figure(c.Lines(((panel,),), "Bandwidth", (3.4,)), words)


def _rates(found: Schedule, unit: str) -> c.Figure:
    shown = [one for one in found.rates if np.isfinite(one.rise)]
    panel = c.Panel(
        f"rate of {found.name} ({unit}/s)", "largest motion, over that at rest (–)",
        (c.Curve(np.array([one.rate for one in shown]), np.array([one.rise for one in shown]),
                 marker="o"),),
        levels=(c.Level(CrossingOptions().rise, "allowed"),
                *([c.Level(found.bound.rate, "bound", vertical=True)] if found.bound.rate else [])),
        log_x=True,
    )  # fmt: skip
    words = (
        f"{found.name} moves to and fro at a constant rate under a random force; simulated, not "
        f"proven. Forces of that motion itself are not in it. Allowed rate: {found.of_bound}."
    )
    return c.Figure(c.Lines(((panel,),), "Rates", (2.8,)), words)
