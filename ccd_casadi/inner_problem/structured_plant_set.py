"""What a problem with a fixed structure is made of: structure, channels, bounds, plants at a θ, and
the warm starts as starts there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from ccd_casadi.analysis.driven_plant import DrivenMechanics
from ccd_casadi.fixed_structure.bounds import Bounds, ChannelBounds
from ccd_casadi.fixed_structure.channel_structure import (
    ChannelStructure,
    channel_bounds,
    channel_plant,
    find_decoupling,
    given_decoupling,
    sensors_on_one_actuator,
)
from ccd_casadi.fixed_structure.design import in_problem_units, problem_for
from ccd_casadi.fixed_structure.multi_start import at_its_bandwidth
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.problem import (
    CoDesignProblem,
    plant_of,
    refuse_ports,
    scaled_plant,
    with_options,
    with_ports,
)
from ccd_casadi.inner_problem.searched_problem import state_of
from ccd_casadi.inner_problem.structured_problem import (
    ChannelProblem,
    StructuredProblem,
    of_sensor,
    structured_of,
    with_structured,
)
from ccd_casadi.lti.ports import BreakPoint
from ccd_casadi.lti.wiring import OwnPorts
from ccd_casadi.plants.plant import (
    Evaluate,
    FromExpressions,
    Mechanics,
    Plant,
    mechanics,
    nearby_model,
)
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array


def bounds_of(problem: CoDesignProblem) -> Bounds:
    """Collect the bounds that hold on every plant.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    Bounds
        In SI, with those of single channels.
    """
    structured, inner = structured_of(problem), problem.inner
    weighted = structured.weighted_level is not None
    return Bounds(
        S_max=inner.S_max,
        S_low=inner.S_low,
        omega_low=inner.omega_low,
        shape=structured.shape,
        shape_ends=structured.shape_ends,
        weighted_level=structured.weighted_level,
        weights=problem.weights if weighted else None,
        compliance_max=structured.compliance_max,
        channels=_channel_bounds(problem),
        error=_error_channel(problem),
    )


def break_points_of(problem: CoDesignProblem) -> tuple[BreakPoint, ...]:
    """Find where the loop of several sensors on one actuator is broken.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    tuple of BreakPoint
        Of the sensor whose error counts first; none of every other problem.
    """
    own = problem.controller
    several = isinstance(own, StructuredProblem) and own.bandwidth_of is not None
    return bounds_of(problem).places if several else ()


def _error_channel(problem: CoDesignProblem) -> int | None:
    """The number of the channel whose error counts, of several sensors on one actuator."""
    name = structured_of(problem).bandwidth_of
    if name is None:
        return None
    channels = structured_of(with_channels(problem)).channels
    return [channel.name for channel in channels].index(name)


def _channel_bounds(problem: CoDesignProblem) -> tuple[ChannelBounds, ...]:
    """The channels' own, where they are tighter than the whole's; none where none is."""
    structured = structured_of(problem)
    if structured.bandwidth_of is not None:
        sensors = structure_of(problem)
        assert isinstance(sensors, ChannelStructure)
        own_peaks = {c.name: c.S_max for c in structured.channels if c.S_max is not None}
        return sensors_on_one_actuator(sensors.decoupling, problem.inner.S_max, own_peaks)
    whole = {"S_max": problem.inner.S_max, "M_K": problem.weights.M_K}
    given = {}
    for channel in structured.channels:
        own = {key: getattr(channel, key) for key in whole}
        own = {key: value for key, value in own.items() if value and value < whole[key]}
        if channel.bandwidth_ratio > 1.0:
            own["bandwidth_ratio"] = channel.bandwidth_ratio
        if own:
            given[channel.name] = own
    structure = structure_of(problem) if given else None
    if not isinstance(structure, ChannelStructure):
        return ()
    return channel_bounds(structure.decoupling, given)


def structure_of(problem: CoDesignProblem) -> Structure | ChannelStructure:
    """Find the structure of the controller.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    Structure or ChannelStructure
        One structure for each channel of a plant with several outputs.
    """
    if plant_of(problem).outputs == 1:
        return structured_of(problem).structure
    channels = structured_of(with_channels(problem)).channels
    names, outputs, inputs = zip(
        *((channel.name, channel.outputs or (), channel.inputs or ()) for channel in channels),
        strict=True,
    )
    structures = tuple(channel.structure for channel in channels)
    owners = tuple(names.index(channel.like or channel.name) for channel in channels)
    return ChannelStructure(given_decoupling(names, outputs, inputs), structures, owners)


def with_channels(problem: CoDesignProblem) -> CoDesignProblem:
    """The problem with the directions of its channels, by the plant at its start, for every θ."""
    structured = structured_of(problem)
    known = {channel.name: channel for channel in structured.channels}
    given = [channel.outputs is not None for channel in structured.channels]
    if plant_of(problem).outputs == 1 or any(given):
        return problem
    if structured.bandwidth_of is not None:
        return with_structured(problem, channels=_of_sensors(problem))
    found = find_decoupling(scaled_plant(problem, problem.start))
    channels = []
    for i, name in enumerate(found.names):
        own = known.get(name, ChannelProblem(name, structured.structure))
        outputs, inputs = (tuple(map(float, M[:, i])) for M in (found.outputs, found.inputs))
        channels.append(replace(own, outputs=outputs, inputs=inputs))
    return with_structured(problem, channels=tuple(channels))


def _of_sensors(problem: CoDesignProblem) -> tuple[ChannelProblem, ...]:
    """A channel for each output, named "1", "2", ..., with what the case gives for it."""
    structured, count = structured_of(problem), plant_of(problem).outputs
    known = {channel.name: channel for channel in structured.channels}
    channels = []
    for i in range(count):
        name, rows = str(i + 1), np.eye(count)
        usual = of_sensor(structured.structure, name == structured.bandwidth_of)
        own = known.get(name, ChannelProblem(name, usual))
        channels.append(replace(own, outputs=tuple(map(float, rows[i])), inputs=(1.0,)))
    return tuple(channels)


def nearby(
    problem: CoDesignProblem, known: Sequence[Sequence[float]], here: Sequence[float]
) -> tuple[Evaluate, ...]:
    """Approximate the model with every option set from its values at some θ.

    Parameters
    ----------
    problem : CoDesignProblem
    known, here : sequence of sequences of float, sequence of float
        θ where the model is known; θ near which it is required.

    Returns
    -------
    tuple of callables
        As `plants.plant.nearby_model` gives them, one for each option set.
    """
    return tuple(nearby_model(plant_of(option), known, here) for option in _options(problem))


def _options(problem: CoDesignProblem) -> list[CoDesignProblem]:
    """The problem with every option set, with its ports where they are bounded."""
    given, (wide, _) = structured_of(problem).uncertainty.options, bounded_ports(problem)
    return [with_options(wide, options) for options in ((), *given)]


def bounded_ports(problem: CoDesignProblem) -> tuple[CoDesignProblem, OwnPorts | None]:
    """Give a problem's plant its ports where the compliance between them is bounded.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    wide : CoDesignProblem
        Of `with_ports`; the problem itself where its compliance has no bound or it has no ports.
    own : OwnPorts or None
        Which inputs and outputs of its plant are those of the problem's; None: all.
    """
    source, narrow = problem.source, plant_of(problem)
    if source.wide or structured_of(problem).compliance_max is None or not narrow.ports:
        return problem, None
    wide, counted = with_ports(problem), 0
    if "performance" in narrow.ports or source.wiring.sensor:
        counted = plant_of(wide).outputs - narrow.outputs
    return wide, OwnPorts(narrow.outputs, narrow.inputs, counted)


def require_bounded_ports(problem: CoDesignProblem) -> None:
    """Refuse a bound of the compliance between ports whose loop is of several outputs, or of
    several forces and several errors at once.

    Parameters
    ----------
    problem : CoDesignProblem

    Raises
    ------
    PlantError
        It is; singular values of the compliance cross where it has several.
    """
    whole, own = bounded_ports(problem)
    if own is None:
        return
    if own.outputs > 1 or own.inputs > 1:
        refuse_ports(problem, "inner.compliance_max of several sensors or actuators")
    if min(plant_of(whole).inputs - own.inputs, own.counted) > 1:
        refuse_ports(problem, "inner.compliance_max of several forces and several errors at once")


@dataclass(frozen=True)
class Ranged:
    """The plants of a problem at θ over the ranges of parameters that vary, for any process."""

    problem: CoDesignProblem
    theta: tuple[float, ...]

    @cached_property
    def wider(self) -> list[Plant]:
        """The plants of every option, over θ and what varies."""
        return [plant_of(with_ranges(option)) for option in _options(self.problem)]

    def __getstate__(self) -> dict[str, object]:
        return {"problem": self.problem, "theta": self.theta}

    def along(self, option: int, values: Array) -> Mechanics:
        """The matrices of an option at values of what varies."""
        return mechanics(self.wider[option], (*self.theta, *values.tolist()))

    def graph(self, option: int) -> ca.Function | None:
        """The same as a function, where the plant is one."""
        count = len(structured_of(self.problem).uncertainty.ranges)
        evaluate, x = self.wider[option].evaluate, ca.SX.sym("x", count)
        theta, driven, mass = self.theta, 0, 0.0
        if isinstance(evaluate, DrivenMechanics):
            driven, mass = evaluate.inputs, evaluate.mass(theta)
            theta, evaluate = evaluate.own(theta), evaluate.evaluate
        if not isinstance(evaluate, FromExpressions):
            return None
        M, D, K, B, C = evaluate.matrices.call([ca.vertcat(*theta, x)])[:5]
        M += mass * B[:, :driven] @ B[:, :driven].T
        if (own := bounded_ports(self.problem)[1]) is not None:
            B, C = B[:, : own.inputs], C[: own.outputs, :]
        return ca.Function("graph", [x], [M, D, K, B, C])


def uncertain_plant(
    problem: CoDesignProblem, theta: Sequence[float], known: Sequence[Mechanics] = ()
) -> UncertainPlant:
    """Make the model at θ with every option set, and the box of plants around it.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence of float
    known : sequence of Mechanics
        Matrices of every option set, in the place of the plants' own.

    Returns
    -------
    UncertainPlant
    """
    u, held = structured_of(problem).uncertainty, problem.source.held
    own = Ranged(problem, tuple(map(float, theta)))
    narrow = replace(problem, source=replace(problem.source, wide=False))
    return UncertainPlant(
        tuple(known) or tuple(mechanics(plant_of(option), theta) for option in _options(problem)),
        problem.weights.M_K, u.resonance_shift, u.mode_shift, u.damping, u.gain,
        tuple((name, low, held[name], high) for name, low, high in u.ranges),
        own.along, own.graph,
        problem.suspension.rigid_modes, bounded_ports(problem)[1], plant_of(narrow).inputs,
    )  # fmt: skip


def with_ranges(problem: CoDesignProblem) -> CoDesignProblem:
    """Append the parameters that vary to those of a problem.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    CoDesignProblem
        Its last parameters are the ranges of `[robust]`.
    """
    ranges = structured_of(problem).uncertainty.ranges
    if not ranges:
        return problem
    names, lower, upper = zip(*ranges, strict=True)
    source = problem.source
    own = {name: (value, unit) for name, value, unit in source.fixed}
    return replace(
        problem,
        source=replace(source, fixed=tuple(f for f in source.fixed if f[0] not in names)),
        names=(*problem.names, *names),
        units=(*problem.units, *(own[name][1] for name in names)),
        start=(*problem.start, *(own[name][0] for name in names)),
        lower=(*problem.lower, *lower),
        upper=(*problem.upper, *upper),
    )


def plants_of(problem: CoDesignProblem, theta: Sequence[float]) -> list[ScaledPlant]:
    """Make the plant set at θ.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence of float

    Returns
    -------
    list of ScaledPlant
        The problem's scenarios, or the corners of the box where it has none yet.
    """
    uncertain = uncertain_plant(problem, theta)
    return uncertain.plants(_points(problem, uncertain))


def plant_words_of(problem: CoDesignProblem, theta: Sequence[float]) -> list[str]:
    """Write how each plant of `plants_of` is off the model.

    Parameters
    ----------
    problem, theta : CoDesignProblem, sequence of float

    Returns
    -------
    list of str
    """
    uncertain = uncertain_plant(problem, theta)
    points = _points(problem, uncertain)
    return [_plant_words(uncertain.names, option, point) for option, point in points]


def _points(problem: CoDesignProblem, uncertain: UncertainPlant) -> list[tuple[int, Array]]:
    known = [(option, np.array(point)) for option, point in state_of(problem).scenarios]
    return known or uncertain.corners()


def _plant_words(names: Sequence[str], option: int, point: Array) -> str:
    parts = [f"[robust] plants {option}"] if option else []
    for name, value in zip(names, point.tolist(), strict=True):
        if name.startswith("theta."):
            parts.append(f"{name.removeprefix('theta.')} = {value:.4g}")
        elif name == "damping":
            parts += [f"damping x {value:g}"] if value != 1.0 else []
        elif value:
            parts.append(f"{name} {100.0 * value:+.3g} %")
    return ", ".join(parts) or "the model"


def warm_starts_at(
    problem: CoDesignProblem,
    structure: Structure | ChannelStructure,
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
) -> list[Array]:
    """Take the warm starts to the plants at a θ, as they are or moved, whichever is better there.

    Moved: frequencies with the first flexible mode, the gain as 1/|G| at the frequency that the
    crossover moves with; a notch stays on its resonance. Of several channels each is moved with the
    first mode that it sees.

    Parameters
    ----------
    problem, structure, bounds : CoDesignProblem, Structure or ChannelStructure, Bounds
    plants : sequence of ScaledPlant
        At the θ.

    Returns
    -------
    list of array (n,)
        κ in SI.
    """
    structured = structured_of(problem)
    if not state_of(problem).warm_starts:
        return []
    first = scaled_plant(problem, problem.start)
    warm_starts = [np.array(kappa) for kappa in state_of(problem).warm_starts]

    def nearer(
        own: Structure, before: ScaledPlant, set_of: list[ScaledPlant], kappa: Array, bounds: Bounds
    ) -> Array:
        found = problem_for(set_of, own, bounds, structured.sampling, structured.frequencies)
        both = [kappa, scaled_to_plant(own, before, set_of[0], kappa)]
        merits = [
            at_its_bandwidth(found, np.clip(in_problem_units(found, one), *found.box)).merit()
            for one in both
        ]
        return both[int(np.argmax(merits))]

    if isinstance(structure, Structure):
        return [nearer(structure, first, list(plants), kappa, bounds) for kappa in warm_starts]
    if bounds.error is not None:  # one sensor's loop alone says nothing of the whole
        return warm_starts
    warm = [kappa.copy() for kappa in warm_starts]
    for i in structure.free:
        own, place = structure.structures[i], structure.slices[i]
        before = channel_plant(first, structure.decoupling, i)
        set_of = [channel_plant(plant, structure.decoupling, i) for plant in plants]
        for kappa in warm:
            kappa[place] = nearer(own, before, set_of, kappa[place], bounds.of_channel(i))
    return warm


def scaled_to_plant(
    structure: Structure, first: ScaledPlant, here: ScaledPlant, kappa: Array
) -> Array:
    """κ in SI of a SISO plant for another one like it."""
    frequency = _first_mode(here) / _first_mode(first)
    crossover = 0.1 * first.omega_0
    gain = _size(first, crossover) / _size(here, frequency * crossover)
    return structure.in_units(kappa, frequency, gain)


def _first_mode(plant: ScaledPlant) -> float:
    """The lowest flexible frequency that the plant's states have, in rad/s; ω₀ if there is none."""
    flexible = plant.natural[plant.natural > 0.0]
    own = np.abs(np.linalg.eigvals(plant.A)) * plant.omega_0
    # below the lowest flexible frequency of all is the suspension
    light = own[own > 0.99 * flexible.min()] if len(flexible) else flexible
    return float(light.min()) if len(light) else plant.omega_0


def _size(plant: ScaledPlant, omega: float) -> float:
    """Compute ‖G(jω)‖ in m/N."""
    return float(np.linalg.norm(plant.plant_si().response(np.array([omega]))[0], 2))
