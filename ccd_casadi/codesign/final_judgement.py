"""The final judgement of a design: on plants as written, along its robust set, on closer models.

A resonance shift keeps the damping ratio of a plant whose damping is given by ratios, and the
matrix of one whose damping is a matrix: there a mode's ratio grows as its frequency falls. Which of
the two a stage keeps is not known.

Closer models are a finer mesh, or more modes (spill-over). Nothing is designed anew: the controller
is measured on each reference of the plant, and has to certify there at the γ that it was certified
at, or is reported as not robust to it. The plants as written are judged by our judge and by SLICOT.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product, zip_longest
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np

from ccd_casadi.codesign.survival import PEAK, LoopsOffModel, Survival, excess_of, highest, survival
from ccd_casadi.fixed_structure.certificate import SetCertificate, certify
from ccd_casadi.fixed_structure.judgement import Judgement, judgement_of
from ccd_casadi.fixed_structure.uncertainty import with_forces_of_model
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.inner_problem.problem import (
    CoDesignProblem,
    free_modal,
    plant_of,
    require_as_returned,
)
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.as_written import as_written
from ccd_casadi.plants.modal import NOMINAL, Perturbation
from ccd_casadi.plants.plant import Mechanics, mechanics
from ccd_casadi.plants.scaling import scale_at_ports, scale_plant
from ccd_casadi.support.process_pool import Pool, results
from ccd_casadi.support.terminal import Progress
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.second_engine import (
    NOT_COMPARED,
    EngineComparison,
    compare_engines,
    second_opinion,
)
from ccd_casadi.synthesis.synthesis import Design, DesignFigures, Outcome

if TYPE_CHECKING:
    from ccd_casadi.fixed_structure.design import SectionsDesign
    from ccd_casadi.lti.norms import BetweenSamples


def written_plants(
    problem: CoDesignProblem, theta: Sequence[float], shifts: int | None = None
) -> list[StateSpace]:
    """The model at θ and the plants of a mixed-sensitivity design's set, as they were written.

    Parameters
    ----------
    problem : CoDesignProblem
        With the plant and its set.
    theta : (n_θ,) sequence
        SI.
    shifts : int or None
        The number of shifts of its resonances; None: the set's own.

    Returns
    -------
    list of StateSpace
        The model first; SI, u in and y out.
    """
    require_as_returned(problem, theta)
    system, robust = mechanics(plant_of(problem), theta, derivatives=False), problem.robust
    places = () if robust is None else robust.perturbations(shifts)
    others = [off for off in places if off != NOMINAL]
    count = problem.suspension.rigid_modes
    return [
        as_written(system, shift=off.shift, damping=off.damping, rigid_modes=count)
        for off in (NOMINAL, *others)
    ]


def judge_on_model(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> Judgement:
    """A mixed-sensitivity design (e in, u out, SI) on the model at θ: S_max, S_low, stability.

    Its set is of the check that `robust` is.
    """
    model = written_plants(problem, theta)[:1]
    return judgement_of(certify(model, controller, kind_of(problem).bounds()), 1)


def second_on_weighted(
    problem: CoDesignProblem, theta: Sequence[float], design: Design
) -> EngineComparison:
    """Compare the judges of mixed sensitivity: the norm that γ was reached with on the plant of the
    design, and the largest ‖S‖∞ and ‖GS‖∞ of its set."""
    figures = design.figures
    opinions = [
        second_opinion(plant, design.controller, weights=weights)
        for plant, weights in zip_longest(written_plants(problem, theta), [design.weights])
    ]
    claims = {"S": figures.sensitivity_peak, "GS": figures.compliance}
    worst = {name: max(opinions, key=lambda one: one.norms.get(name, inf)) for name in claims}
    found = compare_engines([
        (opinions[0], {"weighted_loop": figures.certificate.norm}),
        *((worst[name], {name: claim}) for name, claim in claims.items()),
    ])  # fmt: skip
    return replace(found, loops=len(opinions))


def plants_of_set(problem: CoDesignProblem, theta: Sequence[float]) -> list[StateSpace]:
    """The plants at θ that the certificate of sections is of, as they were written, SI."""
    from ccd_casadi.inner_problem.searched_problem import state_of
    from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant

    uncertain, scenarios = uncertain_plant(problem, theta), state_of(problem).scenarios
    points = [(option, np.array(point)) for option, point in scenarios] or uncertain.corners()
    return uncertain.as_written(points)


def second_on_set(
    problem: CoDesignProblem, theta: Sequence[float], design: "SectionsDesign"
) -> EngineComparison:
    """Compare the judges of a fixed structure: ‖S‖∞, those of KS and T, and of GS for a continuous
    loop, on every plant of its certificate, as the loop runs."""
    judged, K = design.certificate, design.controller
    if judged is None or K is None:
        return NOT_COMPARED
    pairs = zip(plants_of_set(problem, theta), judged.plants, strict=True)
    wide = bool(problem.source.wiring or plant_of(problem).ports)
    alike = problem.sampling is None and not wide  # its GS and the second's
    of_GS, bounds = ("GS",) if alike else (), kind_of(problem).bounds()
    return compare_engines(
        (second_opinion(plant, K, problem.sampling, places=bounds.places),
         {"S": figures.S_peak} | {name: getattr(figures, name) for name in ("KS", "T", *of_GS)}
         | {f"S of {one.name}": one.S_peak for one in figures.channels if bounds.places})
        for plant, figures in pairs
    )  # fmt: skip


def between_on_set(
    problem: CoDesignProblem, theta: Sequence[float], design: "SectionsDesign"
) -> "BetweenSamples | None":
    """S between the samples of a design's loops, on the plants of its certificate; None of a
    continuous loop, and where a plant is known at the instants alone."""
    judged, K, sampling = design.certificate, design.controller, problem.sampling
    if judged is None or K is None or sampling is None:
        return None
    if not all(figures.stable for figures in judged.plants):
        return None
    from ccd_casadi.lti.norms import worst_between

    peaks = [figures.S_peak for figures in judged.plants]
    places = kind_of(problem).bounds().places
    return worst_between(plants_of_set(problem, theta), peaks, K, sampling, places)


KEPT = {
    "ratio": "a resonance shift keeps every mode's damping ratio",
    "matrix": "a resonance shift leaves the damping matrix alone: ratios grow as resonances fall",
}


@dataclass(frozen=True)
class RobustCheckOptions:
    """Numbers of the check of a robust set.

    Attributes
    ----------
    shifts : int
        Of the set at which the design is checked, at the least.
    exceeded : float
        Of a bound: what the other damping has to exceed it by to be reported.
    """

    shifts: int = 41
    exceeded: float = 0.01


@dataclass(frozen=True)
class RobustCheck:
    """The worst of the plants of a design's set that were checked: ‖S‖∞ there, infinite where
    the loop is unstable; `nominal` on the model."""

    nominal: float
    peak: float
    at: Perturbation
    plants: int
    passed: bool


@dataclass(frozen=True)
class OtherDamping:
    """Figures over bounds on the set's extreme plants, with the damping that it keeps ("ratio" or
    "matrix") and with the other; none where the loop is unstable on one of them."""

    kept: str
    own: Mapping[str, float]
    other: Mapping[str, float]

    @property
    def words(self) -> str:
        """What exceeds a bound by more than a hundredth with the other damping only, or nothing."""
        other = "matrix" if self.kept == "ratio" else "ratio"
        where = f"on the set with the damping {other} kept instead of the {self.kept}"
        if not self.own:
            return ""
        if not self.other:
            return f"a loop is unstable {where}"
        found = [
            f"{'S' if name == 'S_max' else name} by {100.0 * (share - 1.0):.2g} %"
            for name, share in self.other.items()
            if share - max(1.0, self.own[name]) > RobustCheckOptions().exceeded
        ]
        return f"bounds are exceeded {where}: {', '.join(found)}" if found else ""

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of result.json's `robust`."""
        return {
            "damping_kept": self.kept,
            "damping_words": "; ".join(part for part in (KEPT[self.kept], self.words) if part),
            "figures_over_bounds_other_damping": self.other,
        }


def judge_survival(
    problem: CoDesignProblem, loops: LoopsOffModel, design: "DesignFigures | SectionsDesign"
) -> tuple[Survival | None, RobustCheck | None]:
    """Find what a certified loop survives and whether its set is kept, without contradicting each
    other.

    The ranges are evaluated at the ends of the set and where it is worst too, and the set at all
    places of the ranges.

    Parameters
    ----------
    problem : CoDesignProblem
        With S_max and the set.
    loops : LoopsOffModel
        Of the design's controller.
    design : DesignFigures or SectionsDesign
        The design as its certificate has it.

    Returns
    -------
    survival : Survival or None
        None where the design is not certified.
    check : RobustCheck or None
        None where mixed sensitivity has no set.
    """
    check = check_robust(problem, loops)
    if not design.certified:
        return None, check
    marks = [abs(end) for end in kind_of(problem).common_shifts()]
    if check is not None and check.at.damping == 1.0:
        marks.append(abs(check.at.shift))
    inner, slack = problem.inner, kind_of(problem).slack
    peak = getattr(design, "sensitivity_peak", np.nan)
    if not isinstance(design, DesignFigures) and design.certificate is not None:
        peak = max(plant.S_peak for plant in design.certificate.plants)
    # What the first engine finds above S_max fails its own line; only the second is judged here.
    slack = float(np.fmax(1.0, peak / inner.S_max)) * (1.0 + slack) - 1.0
    found = survival(
        loops, S_max=inner.S_max, bandwidth=design.bandwidth, omega_low=inner.omega_low,
        slack=slack, marks=marks, held=kind_of(problem).common_shifts(),
    )  # fmt: skip
    return found, check_robust(problem, loops)


def check_robust(problem: CoDesignProblem, loops: LoopsOffModel) -> RobustCheck | None:
    """The loop all along a mixed-sensitivity design's set; None where it has none."""
    if problem.robust is None:
        return None
    robust, level = problem.robust, problem.inner.S_max * (1.0 + PEAK)
    factors = sorted({1.0, *robust.damping})
    places = _places(loops, robust.shift, robust.shifts)
    for factor in factors:

        def excess(shift: float, factor: float = factor) -> float:
            return excess_of(loops.at(Perturbation(shift, factor)), level)

        values = [excess(place) for place in places]
        for i in range(len(places) - 2):
            highest(excess, places[i : i + 3], values[i : i + 3])
    seen = {
        off: loop.peak if loop.stable else inf
        for off, loop in loops.known.items()
        if abs(off.shift) <= robust.shift and off.damping in factors
    }
    at = max(seen, key=lambda off: seen[off])
    model = loops.at(Perturbation())
    return RobustCheck(
        model.peak if model.stable else inf, seen[at], at, len(seen), seen[at] <= level
    )


def _places(loops: LoopsOffModel, reach: float, shifts: int) -> list[float]:
    """List the places from end to end of a set, its own shifts among them."""
    places = [-reach]
    while places[-1] < reach:
        step = min(loops.step(places[-1]), 2.0 * reach / (RobustCheckOptions().shifts - 1))
        places.append(min(places[-1] + step, reach))
    return sorted({*places, *np.linspace(-reach, reach, shifts).tolist(), 0.0})


def other_damping(problem: CoDesignProblem, loops: LoopsOffModel) -> OtherDamping | None:
    """None where the set shifts no resonance."""
    kind = kind_of(problem)
    low, high = kind.common_shifts()
    if not high > low or loops.plant.states is not None:
        return None
    factors, gains = kind.other_factors()
    bounds = kind.bounds()
    places = [Perturbation(s, d) for s, d in product((low, high), sorted({1.0, *factors}))]

    def judged(of: LoopsOffModel) -> SetCertificate:
        plants = []
        for place, gain in product(places, sorted(set(gains))):
            own = of.own
            inputs = None if own is None else own.inputs
            modal = (of.at_ports or of).modal(place).scale_input(gain, inputs)
            plant = (scale_plant(modal, problem.weights.M_K, bare=True) if own is None
                     else scale_at_ports(modal, problem.weights.M_K, own))  # fmt: skip
            at_u = inputs in (None, modal.B.shape[1])
            plants.append(with_forces_of_model(plant, gain) if at_u else plant)
        return certify(plants, of.controller, bounds, of.sampling)

    kept = "matrix" if loops.given else "ratio"
    return OtherDamping(kept, judged(loops).worst, judged(loops.other).worst)


@dataclass(frozen=True)
class ReferenceCheck:
    """One reference: whether the design is certified there again, why not, and its figures."""

    name: str
    outcome: Outcome
    figures: DesignFigures

    @property
    def certified(self) -> bool:
        """Certified on the reference at the design's own γ."""
        return self.outcome is Outcome.CERTIFIED


def check_references(
    problem: CoDesignProblem,
    theta: Sequence[float],
    design: Design,
    workers: Pool | None = None,
    quiet: bool = True,
) -> tuple[ReferenceCheck, ...]:
    """The design's controller on every reference of the problem's plant at θ."""
    names = tuple(plant_of(problem).references)
    tasks = {name: (problem, tuple(theta), design, name) for name in names}
    bar = Progress(len(tasks), "closer models", quiet=quiet)
    checks = dict(bar.over(results(workers, _check, tasks)))
    return tuple(checks[name] for name in names)


def _check(
    problem: CoDesignProblem, theta: tuple[float, ...], design: Design, name: str
) -> ReferenceCheck:
    return check_on(problem, plant_of(problem).references[name](theta), design, name)


def check_on(
    problem: CoDesignProblem, system: Mechanics, design: Design, name: str
) -> ReferenceCheck:
    """The design's controller on one plant, given by its matrices."""
    closer = scale_plant(free_modal(problem, system), problem.weights.M_K)
    at = partial(measure, closer, design.controller, design.weights,
                 omega_low=problem.inner.omega_low)  # fmt: skip
    figures = at(gamma=design.figures.certificate.norm_bound)
    outcome = figures.outcome
    return ReferenceCheck(name, outcome, figures if figures.certified else at())
