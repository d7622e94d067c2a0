"""ω_b*(θ) of a fixed structure: one reproducible function of θ with its envelope gradient.

A full race at one θ gives anchors, the distinct best controllers. ω_b*(θ) is the best of the climbs
from all anchors, and from nothing else: it depends neither on the order in which θ are asked for
nor on the number of workers. Where no anchor climbs to a certified design a race of a few seeded
starts is run at that θ, which is a function of θ too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.fixed_structure import (
    Bounds,
    Certificate,
    SectionsDesign,
    Structure,
    bandwidth_and_gradient,
    certify,
)
from ccd_casadi.fixed_structure.box_proof import Proof, prove
from ccd_casadi.fixed_structure.channel_design import synthesise
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.decoupling import find_decoupling, given_decoupling
from ccd_casadi.fixed_structure.design import SectionsOutcome
from ccd_casadi.fixed_structure.least_error import least_error
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import WITHIN, Excess, lattice, worst_plants
from ccd_casadi.inner_problem.problem import CoDesignProblem, PlantSource, plant_of, scaled_plant
from ccd_casadi.inner_problem.sections_problem import ChannelProblem, Member, SectionsProblem
from ccd_casadi.inner_problem.sections_warm import warm_starts
from ccd_casadi.plants.plant import mechanics
from ccd_casadi.plants.scaling import ScaledPlant, StateSpace
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.units import HZ

MOST_ANCHORS = 3
DISTINCT = 0.1  # relative: local optima further below the best are no anchors
ROUNDS = 6  # of a design on the set and a search for plants that are worse
AT_ONCE = 3  # plants added in a round
APART = 1e-4  # of the box: members that are closer are the same plant
FEW = 8  # starts of the race at a θ where no anchor ends certified
SLOWEST, FASTEST = 1e-3, 30.0  # of K's frequencies, over ω₀ and over the fastest pole at the start
CHECKED = 200  # plants that the judge looks at in the end
LOOSE = 2.0 * WITHIN  # relative: by how much they may pass a bound

Progress = Callable[[str], None]


def sections_of_problem(problem: CoDesignProblem) -> SectionsProblem:
    """The sections of a problem that has them."""
    assert problem.sections is not None
    return problem.sections


def bounds_of(problem: CoDesignProblem) -> Bounds:
    """The bounds on every plant, SI."""
    sections, inner = sections_of_problem(problem), problem.inner
    weighted = sections.weighted_level is not None
    return Bounds(
        S_max=inner.S_max,
        S_low=inner.S_low,
        omega_low=inner.omega_low,
        shape=sections.shape,
        weighted_level=sections.weighted_level,
        weights=problem.weights if weighted else None,
        compliance_max=sections.compliance_max,
    )


def structure_of(problem: CoDesignProblem) -> Structure | ChannelStructure:
    """The controller's structure: one, or one for each channel of a plant with several."""
    if plant_of(problem).outputs == 1:
        return sections_of_problem(problem).structure
    channels = sections_of_problem(with_channels(problem)).channels
    names, outputs, inputs = zip(
        *((channel.name, channel.outputs or (), channel.inputs or ()) for channel in channels),
        strict=True,
    )
    structures = tuple(channel.structure for channel in channels)
    owners = tuple(names.index(channel.like or channel.name) for channel in channels)
    return ChannelStructure(given_decoupling(names, outputs, inputs), structures, owners)


def with_channels(problem: CoDesignProblem) -> CoDesignProblem:
    """The problem with the directions of its channels, by the plant at its start, for every θ."""
    sections = sections_of_problem(problem)
    known = {channel.name: channel for channel in sections.channels}
    given = [channel.outputs is not None for channel in sections.channels]
    if plant_of(problem).outputs == 1 or any(given):
        return problem
    found = find_decoupling(scaled_plant(problem, problem.start))
    channels = []
    for i, name in enumerate(found.names):
        own = known.get(name, ChannelProblem(name, sections.structure))
        outputs, inputs = (tuple(map(float, M[:, i])) for M in (found.outputs, found.inputs))
        channels.append(replace(own, outputs=outputs, inputs=inputs))
    return _with(problem, channels=tuple(channels))


def uncertain_plant(problem: CoDesignProblem, theta: Sequence[float]) -> UncertainPlant:
    """The model at θ with every option set, and the box of what may differ from it."""
    u = sections_of_problem(problem).uncertainty
    systems = [mechanics(plant_of(problem), theta)]
    for options in u.options:
        systems.append(mechanics(plant_of(with_options(problem, options)), theta))
    return UncertainPlant(
        tuple(systems), problem.suspension, problem.weights.M_K, u.resonance_shift, u.mode_shift,
        u.damping, u.gain,
    )  # fmt: skip


def with_options(
    problem: CoDesignProblem, options: Sequence[tuple[str, object]]
) -> CoDesignProblem:
    """The problem with some options of its plant replaced."""
    merged = tuple(sorted((dict(problem.source.options) | dict(options)).items()))
    source: PlantSource = replace(problem.source, options=merged)
    return replace(problem, source=source)


def plants_of(problem: CoDesignProblem, theta: Sequence[float]) -> list[ScaledPlant]:
    """The plant set at θ: its members, or the corners of the box where none are known yet."""
    uncertain = uncertain_plant(problem, theta)
    return uncertain.plants(_points(problem, uncertain))


def _points(problem: CoDesignProblem, uncertain: UncertainPlant) -> list[tuple[int, Array]]:
    members = sections_of_problem(problem).members
    if not members:
        return uncertain.corners()
    return [(option, np.array(point)) for option, point in members]


@dataclass(frozen=True)
class SectionsValue:
    """ω_b*(θ) in rad/s with its gradient (NaN where no certified design was found), the design.

    Of a problem that minimises the RMS error, `error` in m is what the gradient is of, `bandwidth`
    that of the design. `syntheses`: climbs from anchors and races that it took.
    """

    theta: tuple[float, ...]
    bandwidth: float
    gradient: tuple[float, ...]
    design: SectionsDesign
    syntheses: int
    error: float = float("nan")

    @property
    def feasible(self) -> bool:
        """Whether the judge confirms a design at θ."""
        return self.design.certified


def sections_value(problem: CoDesignProblem, theta: Sequence[float]) -> SectionsValue:
    """The best certified design from the problem's anchors at θ, and the envelope gradient."""
    sections = sections_of_problem(problem)
    plants, bounds = plants_of(problem, theta), bounds_of(problem)
    initial = warm_starts(problem, structure_of(problem), plants, bounds)
    made: SectionsDesign | None = None
    spent = 0
    if initial:
        made = synthesise(
            plants, structure_of(problem), bounds, sampling=sections.sampling, seed=sections.seed,
            initial=initial, only_initial=True, frequencies=sections.frequencies,
        )  # fmt: skip
        spent += 1
    if made is None or not made.certified:
        made = synthesise(
            plants, structure_of(problem), bounds, sampling=sections.sampling, seed=sections.seed,
            starts=min(FEW, sections.starts), initial=initial, frequencies=sections.frequencies,
        )  # fmt: skip
        spent += 1
    return valued(problem, theta, plants, made, spent)


def valued(
    problem: CoDesignProblem,
    theta: Sequence[float],
    plants: Sequence[ScaledPlant],
    made: SectionsDesign,
    spent: int,
) -> SectionsValue:
    """A design of largest bandwidth as a value of ω_b*(θ), or as the start to the least error."""
    point = tuple(float(v) for v in theta)
    bandwidth, error, gradient = np.nan, np.nan, np.full(len(point), np.nan)
    if made.certified and sections_of_problem(problem).of_error:
        made, error, gradient = _least_error(problem, plants, made)
        bandwidth = made.bandwidth if made.certified else np.nan
    elif made.certified:
        sampling = sections_of_problem(problem).sampling
        bandwidth, gradient = bandwidth_and_gradient(plants, bounds_of(problem), made, sampling)
    slope = tuple(map(float, gradient))
    return SectionsValue(point, float(bandwidth), slope, made, spent, float(error))


def require_bandwidth(problem: CoDesignProblem, command: str) -> None:
    """Raise UserError where J counts the RMS error, for a command that knows ω_b alone."""
    if problem.sections is not None and problem.sections.of_error:
        words = f"{command} counts the bandwidth; solve and inner alone count the error"
        raise UserError(f'inner.minimise: is "rms_error", and {words}')


def too_slow(problem: CoDesignProblem, made: SectionsDesign) -> SectionsDesign:
    """The design, no longer a certified one where the least error asks for more bandwidth."""
    least = sections_of_problem(problem).bandwidth_least
    if made.bandwidth >= least:
        return made
    words = f"no controller was found above {made.bandwidth / HZ:.4g} Hz"
    words += f", inner.bandwidth_least_hz asks for {least / HZ:.4g} Hz"
    short = {"bandwidth_least_hz": least / made.bandwidth}
    return replace(made, outcome=SectionsOutcome.BOUND_NOT_MET, words=words, short=short)


def _least_error(
    problem: CoDesignProblem, plants: Sequence[ScaledPlant], made: SectionsDesign
) -> tuple[SectionsDesign, float, Array]:
    """The design of least RMS error, that in m, and its gradient to θ."""
    sections, bounds = sections_of_problem(problem), bounds_of(problem)
    assert problem.budget is not None
    made = too_slow(problem, made)
    if not made.certified:
        return made, np.nan, np.full(len(problem.names), np.nan)
    started = _with(problem, anchors=sections.error_anchors)
    found = least_error(
        plants, bounds, made, problem.budget, sampling=sections.sampling,
        least_bandwidth=sections.bandwidth_least,
        initial=warm_starts(started, structure_of(problem), plants, bounds),
    )  # fmt: skip
    return found.design, found.error, found.gradient


def race(
    problem: CoDesignProblem,
    theta: Sequence[float],
    progress: Progress | None = None,
    workers: Pool | None = None,
    only_anchors: bool = False,
) -> SectionsDesign:
    """A full race at θ: the problem's starts, and its anchors beside them or alone."""
    sections = sections_of_problem(problem)
    return synthesise(
        plants_of(problem, theta), structure_of(problem), bounds_of(problem),
        sampling=sections.sampling, starts=sections.starts, seed=sections.seed,
        initial=[np.array(kappa) for kappa in sections.anchors], only_initial=only_anchors,
        frequencies=sections.frequencies, progress=progress, workers=workers,
    )  # fmt: skip


def with_range(problem: CoDesignProblem) -> CoDesignProblem:
    """The problem with its channels and the range of K's frequencies, by the plant at its start,
    alike at every θ.

    A range that moved with θ would move ω_b*(θ) where it binds, unseen by the envelope gradient.
    """
    problem = with_channels(problem)
    sections = sections_of_problem(problem)
    if sections.frequencies is not None:
        return problem
    plant = scaled_plant(problem, problem.start)
    poles = np.abs(np.linalg.eigvals(plant.A))
    fastest = FASTEST * max(1.0, float(poles.max())) * plant.omega_0
    slowest = SLOWEST * plant.omega_0
    if sections.sampling is not None:
        fastest = min(fastest, 2.0 / sections.sampling.period)
        slowest = min(slowest, 0.01 * fastest)
    return _with(problem, frequencies=(slowest, fastest))


def prepared(
    problem: CoDesignProblem,
    progress: Progress | None = None,
    workers: Pool | None = None,
    only_anchors: bool = False,
) -> tuple[CoDesignProblem, SectionsDesign]:
    """The problem with anchors and members: a full race at its start θ, worst plants added.

    With `only_anchors` the anchors that it has alone are where searches start. The design is the
    race's last; where it is not certified the problem has no anchors, and each θ is raced on its
    own. All of it is of the largest bandwidth, whatever the problem minimises.
    """
    asked = sections_of_problem(problem).minimise
    asked_for = with_range(_with(problem, minimise="bandwidth"))
    found, made = _prepared(asked_for, progress, workers, only_anchors)
    return _with(found, minimise=asked), made


def _prepared(
    problem: CoDesignProblem, progress: Progress | None, workers: Pool | None, only_anchors: bool
) -> tuple[CoDesignProblem, SectionsDesign]:
    uncertain = uncertain_plant(problem, problem.start)
    members = tuple((o, tuple(map(float, p))) for o, p in uncertain.corners())
    problem = _with(problem, members=members)
    made = race(problem, problem.start, progress, workers, only_anchors)
    if not made.certified:
        return problem, made
    anchors = _anchors(made)
    for turn in range(ROUNDS):
        found = worst_members(problem, problem.start, made, turn, progress)[1]
        if not found:
            break
        problem = _with(problem, members=(*sections_of_problem(problem).members, *found))
        problem = _with(problem, anchors=anchors)
        made = sections_value(problem, problem.start).design
        if not made.certified:
            return problem, made
        anchors = _anchors(made)
    return _with(problem, anchors=anchors), made


def _anchors(made: SectionsDesign) -> tuple[tuple[float, ...], ...]:
    """The certified design's κ first, then those of the other local optima near it."""
    own = tuple(map(float, made.kappa))
    others = [
        optimum.kappa
        for optimum in made.local_optima
        if (1.0 - DISTINCT) * made.bandwidth <= optimum.bandwidth < (1.0 - 1e-3) * made.bandwidth
    ]
    return (own, *others)[:MOST_ANCHORS]


def joined(problem: CoDesignProblem, kappa: Array, members: Sequence[Member]) -> CoDesignProblem:
    """The problem with one more anchor, first, of what it minimises, and more members."""
    sections = sections_of_problem(problem)
    own = tuple(float(v) for v in kappa)
    name = "error_anchors" if sections.of_error else "anchors"
    known = getattr(sections, name)
    anchors = (own, *(a for a in known if a != own))[: MOST_ANCHORS + 1]
    problem = _with(problem, **{name: anchors})
    return _with(problem, members=(*sections.members, *members))


def _with(problem: CoDesignProblem, **changes: object) -> CoDesignProblem:
    return replace(problem, sections=replace(sections_of_problem(problem), **changes))  # type: ignore[arg-type]


def worst_members(
    problem: CoDesignProblem,
    theta: Sequence[float],
    made: SectionsDesign,
    turn: int = 0,
    progress: Progress | None = None,
) -> tuple[Excess, tuple[Member, ...]]:
    """The worst plant of the box for a design, and those to add: past a bound, each a new one."""
    sections, uncertain = sections_of_problem(problem), uncertain_plant(problem, theta)
    heads, count = worst_plants(
        uncertain, structure_of(problem), made.kappa, made.bandwidth, bounds_of(problem),
        sections.sampling, seed=sections.seed + turn,
    )  # fmt: skip
    if progress is not None:
        progress(f"worst of {count} plants: {np.expm1(heads[0].value):+.3%} of a bound")
    width = uncertain.box[1] - uncertain.box[0]
    known = list(sections.members)
    found: list[Member] = []
    for head in heads:
        near = [
            float(np.abs((head.point - np.array(point)) / width).max(initial=0.0))
            for option, point in (*known, *found)
            if option == head.option
        ]
        if head.value > WITHIN and (not near or min(near) > APART) and len(found) < AT_ONCE:
            found.append((head.option, tuple(map(float, head.point))))
    return heads[0], tuple(found)


def judged_widely(
    problem: CoDesignProblem,
    theta: Sequence[float],
    controller: StateSpace,
    worst: Excess,
    workers: Pool | None = None,
) -> tuple[Certificate, int]:
    """The independent judge on a lattice of the box and the worst plant; how many plants it saw.

    The bounds count as met within `LOOSE`, since the search stops at `WITHIN`.
    """
    sections, uncertain = sections_of_problem(problem), uncertain_plant(problem, theta)
    points = [*lattice(uncertain, CHECKED, sections.seed + 1000), (worst.option, worst.point)]
    if not uncertain.names:
        points = uncertain.corners()[: 1 + len(sections.uncertainty.options)]
    return _judged(problem, uncertain.plants(points), controller, workers), len(points)


def proof_of(problem: CoDesignProblem, theta: Sequence[float], made: SectionsDesign) -> Proof:
    """Branch and bound over the whole box of plants at θ."""
    sections = sections_of_problem(problem)
    return prove(
        uncertain_plant(problem, theta), made.structure, made.kappa, made.bandwidth,
        bounds_of(problem), sections.sampling,
    )  # fmt: skip


def judged_corners(
    problem: CoDesignProblem, theta: Sequence[float], controller: StateSpace
) -> Certificate:
    """The same on the model of every option and the corners of the box."""
    uncertain = uncertain_plant(problem, theta)
    return _judged(problem, uncertain.plants(uncertain.corners()), controller)


def _judged(
    problem: CoDesignProblem,
    plants: Sequence[ScaledPlant],
    controller: StateSpace,
    workers: Pool | None = None,
) -> Certificate:
    sections, bounds = sections_of_problem(problem), bounds_of(problem)
    loose = replace(
        bounds,
        S_max=bounds.S_max * (1.0 + LOOSE),
        S_low=bounds.S_low * (1.0 + LOOSE),
        weighted_level=_times(bounds.weighted_level),
        compliance_max=_times(bounds.compliance_max),
    )
    integrator = structure_of(problem).integrator
    return certify(
        plants, controller, loose, sections.sampling, integrator=integrator, workers=workers
    )


def _times(value: float | None) -> float | None:
    return None if value is None else value * (1.0 + LOOSE)
