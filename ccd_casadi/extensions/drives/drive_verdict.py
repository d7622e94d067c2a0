"""A drive's design under the keys of result.json: verdict, margins and status as solve has them.

Margins are of the loop broken at one place, L = 1/S - 1, on the model and on the corners of its
set. Of two rates S is the part that has the frequency of a sine (`two_rates`), the modulus margin
counts the rest as well.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ccd_casadi.analysis.loop_figures import loop_entry
from ccd_casadi.codesign.final_judgement import judge_survival
from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.structured_entries import box_findings
from ccd_casadi.codesign.survival import Survival, loops_of
from ccd_casadi.codesign.verdict import (
    Check,
    OwnSet,
    State,
    VerdictOptions,
    between_finding,
    survives,
)
from ccd_casadi.extensions.drives.drive_case import DriveProblem, meets_constraints
from ccd_casadi.extensions.drives.drive_design import DriveDesign
from ccd_casadi.extensions.drives.two_rates import LiftedLoop, lift, place_name
from ccd_casadi.fixed_structure.certificate import SetCertificate
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.lti.loop import Loop, zoh
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.closed_loop import classical_margins


def verdict_entry(problem: DriveProblem, design: DriveDesign) -> dict[str, Any]:
    """Judge a design as `ccd solve` judges sections: it is verified where no line fails.

    Gives `status`, `reason`, `verdict`, `margins` of every place, and margins and steps as
    result.json has them, of a stable loop.
    """
    own, stable = design.cascade, all(one.stable for one in design.certificate.plants)
    figures: dict[str, Any] = {}
    certified, ranges = _certify(problem, design), None
    if stable:
        figures = _margins(problem, design)
    if stable and own.slower == 1:
        K, places = design.controller, problem.bounds.places
        plants = problem.uncertain.as_written(problem.uncertain.corners())
        loops = [Loop(plant, K, problem.sampling, places) for plant in plants]
        peak = max(1.0 / one["modulus_margin"] for one in figures["margins"])
        figures = loop_entry(loops, design.bandwidth, peak) | figures
        if certified.state is State.PASSED:
            ranges = _survival(problem, design)
    lines = certified, _survives(problem, design, ranges), _deployable(problem, design, ranges)
    lost = [f"{line.name}: {line.words}" for line in lines if line.state is State.FAILED]
    return {
        "status": "not_verified" if lost else "verified",
        "reason": f"failed: {'; '.join(lost)}" if lost else "",
        "verdict": {line.name: line.entry for line in lines},
        **figures,
    }


def lift_loops(problem: DriveProblem, design: DriveDesign) -> list[LiftedLoop]:
    """The loops on the model and on the corners of the set."""
    rate = problem.sampling.period, problem.sampling.delay
    plants = problem.uncertain.as_written(problem.uncertain.corners())
    return [lift(design.cascade, design.values, zoh(plant, *rate)) for plant in plants]


def _margins(problem: DriveProblem, design: DriveDesign) -> dict[str, Any]:
    """The least of these plants at every place, and of all places."""
    loops, rows = lift_loops(problem, design), list[dict[str, Any]]()
    for place in loops[0].places:
        each, peak = [], 0.0
        for loop in loops:
            omega = loop.grid(0.05 * problem.bounds.omega_low)
            if place == design.cascade.position:  # above it a slower position is aliased
                omega = omega[omega < np.pi / (loop.slower * loop.period)]

            def opened(w: Array, loop: LiftedLoop = loop, place: int | None = place) -> np.ndarray:
                return 1.0 / loop.fundamental(place, w.ravel()).reshape(w.shape) - 1.0

            each.append(classical_margins(opened, omega))
            peak = max(peak, float(loop.sensitivity(place, omega).max()))
        rows.append({
            "place": place_name(problem.bounds, place),
            "crossover_hz": each[0].crossover / HZ,
            "phase_margin_deg": min(one.phase_deg for one in each),
            "gain_up": min(one.gain_up for one in each),
            "gain_down": max(one.gain_down for one in each),
            "gain_margin": min(min(one.gain_up, 1.0 / max(one.gain_down, 1e-300)) for one in each),
            "delay_margin_us": 1e6 * min(one.delay for one in each),
            "modulus_margin": 1.0 / peak,
        })  # fmt: skip
    least = ("phase_margin_deg", "gain_margin", "delay_margin_us", "modulus_margin")
    return {"margins": rows, **{key: min(row[key] for row in rows) for key in least}}


def _certify(problem: DriveProblem, design: DriveDesign) -> Check:
    judged, own = design.certificate, design.cascade
    line = partial(Check, "certified", figures={"figures_over_bounds": judged.worst})
    if design.rise > own.filter_gain:
        words = f"filters raise their gain to {design.rise:.4g}, above filter_gain"
        return line(State.FAILED, (Reason.JUDGED(words=words),))
    if not judged.passed:
        return line(State.FAILED, (Reason.JUDGED(words=_worst_words(judged)),))
    if not meets_constraints(problem.problem, problem.theta):
        return line(State.FAILED, (Reason.CONSTRAINT_NOT_MET(),))
    return line(State.PASSED, (Reason.JUDGED(words=judged.words),))


def _worst_words(judged: SetCertificate) -> str:
    """Describe the bound that is exceeded most, by the judge."""
    name, share = max(judged.worst.items(), key=lambda one: one[1], default=("", 0.0))
    return f"exceeds {name} by {100.0 * (share - 1.0):.2g} %" if share > 1.0 else judged.words


def _survival(problem: DriveProblem, design: DriveDesign) -> Survival | None:
    """The ranges of a certified loop off its model."""
    loops = loops_of(problem.problem, problem.theta, design.controller)
    # a drive's design has what is read of one of sections
    return judge_survival(problem.problem, loops, design)[0]  # type: ignore[arg-type]


def _survives(problem: DriveProblem, design: DriveDesign, ranges: Survival | None) -> Check:
    held = kind_of(problem.problem).common_shifts()
    judged = replace(design.certificate, words=_worst_words(design.certificate))
    known = box_findings(
        judged, len(judged.plants), design.proof, design.worst, design.drawn,
        along=ranges is None or ranges.within(*held),
    )  # fmt: skip
    if judged.passed and design.cascade.slower > 1:  # nothing off the set is tried
        figures = known["figures"] | {"set": known["own"].value, "set_shift": list(held)}
        states = {OwnSet.BROKEN: State.FAILED, OwnSet.NONE: State.WARNED}
        state = states.get(known["own"], State.UNKNOWN)
        return Check("survives", state, tuple(known["own_findings"]), figures)
    known["figures"] |= {"set_shift": list(held)}
    return survives(ranges, S_max=problem.bounds.S_max, **known)


def _deployable(problem: DriveProblem, design: DriveDesign, ranges: Survival | None) -> Check:
    rate, between = problem.sampling, design.between
    figures = {"rate_hz": rate.rate_hz, "delay_us": rate.delay_us}
    words = f"judged at {rate.rate_hz:g} Hz with a delay of {rate.delay_us:g} us, "
    words += "hold and delay exact; cascade.c is its code"
    line = partial(Check, "deployable", figures=figures)
    if not design.certificate.passed or (ranges and ranges.contradiction):
        return line(State.UNKNOWN, (Reason.JUDGED(words="the loop is not certified"),))
    if between is None:
        words = f"S between its samples is not judged; {words}"
        return line(State.WARNED, (Reason.JUDGED(words=words),))
    options = VerdictOptions()
    above, finding = between_finding(between, problem.bounds.S_max, options.between_excess)
    state = State.WARNED if above else State.PASSED
    return line(state, (Reason.JUDGED(words=words), finding))
