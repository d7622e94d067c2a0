"""J over θ, the controller and ω_b at once, on the plants of a set that hold it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ccd_casadi.fixed_structure.channel_structure import in_units_of
from ccd_casadi.fixed_structure.composite import on_plants
from ccd_casadi.fixed_structure.design import in_problem_units, problem_for
from ccd_casadi.fixed_structure.figures import HessianOptions, assess, hessians, to_theta
from ccd_casadi.fixed_structure.local_search import Point, all_rows, ascend
from ccd_casadi.fixed_structure.loop_problem import Assessment, Constraints, LoopProblem
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.objective import hardware_at
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.inner_problem.searched_problem import state_of
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.optim.step import Iterate, Rows, StepOptions, TrustRegionModel
from ccd_casadi.optim.trust_region import Radius, minimise
from ccd_casadi.plants.plant import Evaluate, Mechanics, hardware_cost, to_first_order
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class JointModelOptions:
    """Numbers of one search over θ, controller and ω_b on models of the plants."""

    penalty: float = (
        6.0  # a few times the sum of multipliers, or second-order violation counts less
    )
    steps: int = 60
    adapting_steps: int = 15  # of the controller alone, at the end
    first_radius: float = 0.05  # of κ and z, in shares of their ranges
    largest_radius: float = 0.5
    least_radius: float = 1e-7
    least_gain: float = 1e-7  # of w2 ω_b: a step that promises less is the last
    late_trials: int = 12  # with little gained by these the plants are evaluated anew
    late_share: float = 0.15  # of all that was gained: less is little
    settled: float = 3e-4  # of J: less is not worth another evaluation of the plants
    constraint_margin: float = 1e-8  # of λ's size: rounding of an elastic row must not break it
    least_slope: float = 1e-3  # of λ per box, over its size: less counts as this
    row_reach: float = 3.0  # radii of κ and τ by which a row that counts may be below its bound


@dataclass(frozen=True)
class JointPoint:
    """θ, κ (SI) and ω_b in rad/s, at which rows may exceed their bounds a little."""

    theta: tuple[float, ...]
    kappa: tuple[float, ...]
    bandwidth: float


@dataclass(frozen=True)
class Proposal:
    """The end of a search and by how much J falls there, on the plants as models know them."""

    end: JointPoint
    gain: float


def propose_step(
    problem: CoDesignProblem,
    models: Sequence[Evaluate],
    at: JointPoint,
    reach: float,
    least_gain: float | None = None,
    curved_plants: bool = False,
    options: JointModelOptions = JointModelOptions(),
) -> Proposal:
    """The end of one search around a place, on the plants of these models; see `JointModel`.

    With `least_gain` (of w2 ω_b) it goes on to there; without, it ends where it gains slowly."""
    model = JointModel(problem, models, at, reach, curved_plants, least_gain is None, options)
    start = model.beginning
    if start is None:
        return Proposal(at, 0.0)
    least = options.least_gain if least_gain is None else least_gain
    first = min(options.first_radius, reach)
    radius = Radius(first, options.least_radius, options.largest_radius)
    H = np.zeros((len(start.x), len(start.x)))
    end = minimise(
        model, start, H, radius, steps=options.steps, penalty=options.penalty, least_gain=least
    ).best
    gain = start.value - end.value + options.penalty * (start.violation - end.violation)
    return Proposal(model.place(end.x), model.unit * float(gain))


@dataclass(frozen=True, eq=False)
class JointLoops:
    """The loops of an iterate at κ (their units) and τ, with their assessment."""

    loops: LoopProblem
    kappa: Array
    tau: float
    found: Assessment

    @cached_property
    def rows(self) -> Constraints:
        """Peaks and the grid near them."""
        return all_rows(self.loops, self.kappa, self.tau, self.found)


class JointModel(TrustRegionModel[JointLoops]):
    """J over its `unit`, w2 ω_b in the middle, around a place; over x = (z, κ, τ), with the loops
    at x.

    Parameters
    ----------
    problem, models : CoDesignProblem, sequence of Evaluate
        J, and the plants by θ.
    place : JointPoint
        The middle.
    reach : float
        How far z may go from it, in shares of the box of θ.
    curved_plants : bool
        Whether the models' own curvature counts: only near an optimum, as a model may jump where a
        mode that it keeps meets another.
    ends_early : bool
        Whether a search ends where its last trials gain little: it counts the trials of one.
    """

    corrected = bending = True
    step_options = StepOptions(programmes=60, little=1e-3)  # they cost little beside a trial

    def __init__(
        self,
        problem: CoDesignProblem,
        models: Sequence[Evaluate],
        place: JointPoint,
        reach: float,
        curved_plants: bool = False,
        ends_early: bool = False,
        options: JointModelOptions = JointModelOptions(),
    ) -> None:
        self.curved_plants, self.ends_early, self.options = curved_plants, ends_early, options
        self.problem, self.models, self.middle = problem, models, np.array(place.theta)
        known = [(option, np.array(point)) for option, point in state_of(problem).scenarios]
        lower, upper = box(problem)
        self.lower, self.width = lower, upper - lower
        middle = (self.middle - lower) / self.width
        uncertain = self.uncertain(middle, self.known_mechanics(middle))
        self.scenarios = known or uncertain.corners()
        self.first = uncertain.plants(self.scenarios[:1])[0]
        self.unit = -problem.w2 * place.bandwidth
        loops = self.first_loops = self.loops(middle)
        # λ in units in which the penalty exceeds what breaking it saves of the hardware.
        own = hardware_at(problem, self.middle)
        saved = np.abs(own.cost_gradient).max(initial=0.0) / self.unit
        steep = np.maximum(np.abs(own.slopes).max(axis=1, initial=0.0), options.least_slope)
        self.weight = np.maximum(1.0, 2.0 * saved / (options.penalty * steep))
        self._merits: list[float] = []  # before every trial of a search
        self._beside: tuple[JointLoops, list[LoopProblem]] | None = None  # the last ones
        self.tau = float(np.log(place.bandwidth / loops.plants.omega_0))
        kappa = np.clip(in_problem_units(loops, np.array(place.kappa)), *loops.box)
        self.start = np.concatenate([middle, kappa, [self.tau]])
        low, high = np.maximum(middle - reach, 0.0), np.minimum(middle + reach, 1.0)
        self.low = np.concatenate([low, loops.box[0], [-np.inf]])
        self.high = np.concatenate([high, loops.box[1], [np.inf]])

    @cached_property
    def beginning(self) -> Iterate[JointLoops] | None:
        """The iterate in the middle."""
        return self.at(self.start)

    def place(self, x: Array) -> JointPoint:
        """Return the point of x: θ, κ in SI and ω_b."""
        z, scaled, tau = self.parts(x)
        loops = self.first_loops
        kappa = loops.structure.in_units(scaled, loops.plants.omega_0, loops.plants.force)
        theta = np.clip(self.theta(z), *box(self.problem))
        omega_b = float(np.exp(tau) * loops.plants.omega_0)
        return JointPoint(tuple(map(float, theta)), tuple(map(float, kappa)), omega_b)

    def adapt(self, steps: int | None = None) -> tuple[JointPoint, float]:
        """The middle after a few steps of the controller alone, and J there with the penalty of
        the violation that is left; infinite where a loop is unstable."""
        options, steps = self.options, self.options.adapting_steps if steps is None else steps
        z, kappa, tau = self.parts(self.start)
        found = assess(self.first_loops, kappa, tau)
        if not found.stable:
            return self.place(self.start), np.inf
        started = Point(kappa, tau, found)
        radius = options.first_radius
        point = ascend(self.first_loops, started, iterations=steps, radius=radius).point
        x = np.concatenate([z, point.kappa, [point.tau]])
        unmet = hardware_at(self.problem, self.middle).constraints * self.weight
        worth = np.exp(point.tau - self.tau)
        worth -= options.penalty * max(point.assessment.violation, float(unmet.max(initial=0.0)))
        cost = self.problem.w1 * hardware_cost(plant_of(self.problem), self.middle)
        return self.place(x), float(cost - self.unit * worth)

    def theta(self, z: Array) -> Array:
        """θ of its shares."""
        return np.asarray(self.lower + self.width * z)

    def parts(self, x: Array) -> tuple[Array, Array, float]:
        """z, κ and τ."""
        count = len(self.middle)
        return x[:count], x[count:-1], float(x[-1])

    def known_mechanics(self, z: Array) -> list[Mechanics]:
        """The plant and its options at z, as the models know them."""
        return [model(tuple(self.theta(z).tolist())) for model in self.models]

    def uncertain(self, z: Array, known: Sequence[Mechanics]) -> UncertainPlant:
        """The plant at z."""
        return uncertain_plant(self.problem, tuple(self.theta(z).tolist()), known)

    def plants(self, z: Array, known: Sequence[Mechanics]) -> list[ScaledPlant]:
        """Return the plants of the set at z, in the units of its first one in the middle."""
        share = self.width[:, None, None]
        return [
            in_units_of(one.with_slopes_times(share), self.first)
            for one in self.uncertain(z, known).plants(self.scenarios)
        ]  # fmt: skip

    def loops(self, z: Array) -> LoopProblem:
        """Return the loops with the plants at z."""
        structured = structured_of(self.problem)
        return problem_for(
            self.plants(z, self.known_mechanics(z)), structure_of(self.problem),
            bounds_of(self.problem), structured.sampling, structured.frequencies,
        )  # fmt: skip

    def loops_beside(self, here: Iterate[JointLoops]) -> list[LoopProblem]:
        """The loops a small step of each z away. A step that fails is followed by one from the same
        place: the last ones are kept."""
        if self._beside is None or self._beside[0] is not here.data:
            self._beside = here.data, self._loops_beside(here)
        return self._beside[1]

    def _loops_beside(self, here: Iterate[JointLoops]) -> list[LoopProblem]:
        z, sampling = self.parts(here.x)[0], structured_of(self.problem).sampling
        known, found = self.known_mechanics(z), []
        for step in HessianOptions.parameter_step * np.eye(len(z)):
            moved = (
                self.known_mechanics(z + step)
                if self.curved_plants
                else [to_first_order(one, self.width * step) for one in known]
            )
            found.append(on_plants(here.data.loops, self.plants(z + step, moved), sampling))
        return found

    def at(self, x: Array) -> Iterate[JointLoops] | None:
        """Evaluate x, provided that every loop is stable and masses are positive to first order."""
        x = np.clip(x, self.low, self.high)
        z, kappa, tau = self.parts(x)
        try:
            loops = self.loops(z)
        except np.linalg.LinAlgError:  # placed masses move so far that M + ∂M Δθ is indefinite
            return None
        found = assess(loops, kappa, tau)
        if not found.stable:
            return None
        own, worth = hardware_at(self.problem, self.theta(z)), float(np.exp(tau - self.tau))
        cost = self.problem.w1 * hardware_cost(plant_of(self.problem), self.theta(z))
        slope = np.concatenate([own.cost_gradient / self.unit, np.zeros(len(kappa)), [-worth]])
        unmet = (own.constraints + self.options.constraint_margin) * self.weight
        violation = max(found.violation, float(unmet.max(initial=0.0)))
        data = JointLoops(loops, kappa, tau, found)
        return Iterate(x, cost / self.unit - worth, slope, violation, data)

    def has_ended(self, here: Iterate[JointLoops], there: Iterate[Any]) -> bool:
        """Decide whether the last trials gain little of what all have gained."""
        if not self.ends_early or self.beginning is None:
            return False
        merits, options = self._merits, self.options
        merits.append(here.value + options.penalty * here.violation)
        gained, late = merits[0] - merits[-1], merits[-options.late_trials :][0] - merits[-1]
        enough = gained > options.settled * abs(self.beginning.value)
        return len(merits) > options.late_trials and enough and late < options.late_share * gained

    def rows(self, here: Iterate[JointLoops], radius: float) -> Rows:
        """Peaks, the grid near them, and λ."""
        z, kappa, tau = self.parts(here.x)
        loops, peaks = here.data.loops, here.data.found.peaks
        assert peaks is not None
        found, count = here.data.rows, len(z)
        steep = np.abs(found.to_kappa).sum(1) + np.abs(found.to_tau)
        kept = np.flatnonzero(
            found.value + self.options.row_reach * radius * np.maximum(steep, 1.0) > 0.0
        )
        found = found.only(kept)
        slopes = np.column_stack([to_theta(loops, kappa, found), found.to_kappa, found.to_tau])
        own = hardware_at(self.problem, self.theta(z))
        unmet = (own.constraints + self.options.constraint_margin) * self.weight
        of_z = np.pad(self.weight[:, None] * own.slopes, ((0, 0), (0, len(here.x) - count)))

        def second(index: np.ndarray) -> Array:
            chosen = found.only(index)
            try:
                beside = self.loops_beside(here)
            except np.linalg.LinAlgError:  # as in `at`: no curvature is known at the edge
                return np.zeros((len(chosen.value), len(here.x), len(here.x)))
            return hessians(loops, kappa, tau, chosen, beside)

        return Rows(
            np.concatenate([found.value, unmet]), np.vstack([slopes, of_z]),
            hessians=second, curved=int((kept < len(peaks.v)).sum()),
        )  # fmt: skip
