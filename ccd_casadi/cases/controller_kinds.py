"""Kinds of inner problem in a case file: which keys go with which, and the structured problem."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from ccd_casadi.cases.checks import Fail
from ccd_casadi.cases.controller_tables import ChannelTable, ControllerTable
from ccd_casadi.cases.tables import BudgetTable, Case, InnerTable, WeightsTable
from ccd_casadi.fixed_structure.bounds import ShapeEnd
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem.controller_problem import BANDWIDTH, FIGURES, RMS_ERROR, Options
from ccd_casadi.inner_problem.structured_problem import (
    ChannelProblem,
    StructuredProblem,
    Uncertainty,
    of_sensor,
)
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.weights import Weights


@dataclass(frozen=True)
class KindOptions:
    """Defaults of a case that gives no number."""

    shape: float = 1.1  # bound of the shape of S with a fixed structure
    disturbance: float = 10.0  # w_d over M_K
    most_plants: int = 24  # option sets of the plant that a case may list


WITH_DISTURBANCE = "h_infinity_disturbance"
# Keys that only one kind reads, by table.
_OF_STRUCTURED = {
    "controller": tuple(f.name for f in fields(ControllerTable) if f.name != "structure"),
    "loop": ("rate_hz", "delay_us"),
    "robust": (
        "mode_shift",
        "gain",
        "plants",
        "share",
        "confidence",
        "distribution",
        "cost_per_percent",
        "half_width",
    ),
    "inner": ("shape", "shape_ends", "minimise", "bandwidth_least_hz"),
}
# What [controller.channel.NAME] bounds besides the whole loop.
_OF_CHANNELS = ("S_max", "M_K", "bandwidth_ratio")
_OF_H_INFINITY = {
    "robust": ("shifts", "design_at"),
    "inner": ("gamma_backoff", "sweep_points", "method"),
}


def idle_keys(data: Mapping[str, Any]) -> list[str]:
    """Required keys that have no effect on the kind of inner problem which a case's tables name."""
    given = data.get("controller")
    of_weights = (None, "h_infinity", WITH_DISTURBANCE)  # of another word itself is said first
    if not isinstance(given, Mapping) or given.get("structure") in of_weights:
        return []
    unweighted = given.get("weighted_level") is None
    tables = {"weights": WeightsTable, "inner": InnerTable}
    return [
        f"{name}.{item.name}" for name, table in tables.items() for item in fields(table)
        if item.metadata["idle"] is not None and (unweighted or item.name == "omega_S_hz")
    ]  # fmt: skip


def check_rate(tables: Mapping[str, Any], fail: Fail) -> None:
    """Raise where |S| is bounded at a frequency that the sampled loop does not have."""
    low, rate = tables["inner"].omega_low_hz, tables["loop"].rate_hz
    if rate is not None and not low < 0.5 * rate:
        words = f"is {low:g}, not below {0.5 * rate:g}, half of loop.rate_hz = {rate:g}"
        raise fail("inner.omega_low_hz", f"{words}; lower it, or raise loop.rate_hz")


def check_kind(tables: Mapping[str, Any], fail: Fail) -> None:
    """Raise where a key is given that has no effect on the chosen kind of inner problem."""
    controller, loop = tables["controller"], tables["loop"]
    structured = controller.structure == "sections"
    other, remedy = (
        (_OF_H_INFINITY, 'has no effect on controller.structure = "sections"; drop it')
        if structured
        else (_OF_STRUCTURED, 'has an effect with controller.structure = "sections" only; drop it, '
              "or choose that structure")
    )  # fmt: skip
    if controller.structure != WITH_DISTURBANCE and tables["weights"].disturbance is not None:
        words = f'has an effect with controller.structure = "{WITH_DISTURBANCE}" only; drop it, '
        raise fail("weights.disturbance", words + "or choose that structure")
    w2, v = tables["objective"].w2, FIGURES[tables["inner"].minimise]
    of_error = v is not BANDWIDTH
    if w2 == 0.0 or (w2 > 0.0 and not (structured and of_error)):
        remedy_of_w2 = "give a negative number: J must reward bandwidth"
        if structured and of_error:
            remedy_of_w2 = f"give a positive number: J counts the {v.words} in {v.si_unit}"
        raise fail("objective.w2", f"is {w2!r}; {remedy_of_w2}")
    for name, keys in other.items():
        table = tables[name]
        for item in fields(table):
            if item.name in keys and getattr(table, item.name) != item.default:
                raise fail(f"{name}.{item.name}", remedy)
    if not structured:
        return
    inner, budget = tables["inner"], tables["budget"]
    if v is RMS_ERROR and budget == BudgetTable():
        words = 'is "rms_error", and no spectrum says what moves the stage; add [budget.force]'
        raise fail("inner.minimise", f"{words} or another")
    if inner.bandwidth_least_hz is not None and not of_error:
        words = 'has no effect with inner.minimise = "bandwidth"; drop it'
        raise fail("inner.bandwidth_least_hz", words)
    if loop.delay_us and loop.rate_hz is None:
        words = "a delay needs a sampled loop, whose poles decide its stability; give loop.rate_hz"
        raise fail("loop.delay_us", words)
    check_rate(tables, fail)
    if controller.biquads == 0 and controller.least_damping:
        words = "has no effect with biquads = 0; drop it"
        raise fail("controller.least_damping", words)
    if controller.roll_off == 0 and controller.weighted_level is not None:
        words = "is 0: KS would not fall, and weighted_level holds at no frequency; give 1 or more"
        raise fail("controller.roll_off", words)
    if controller.bandwidth_of is not None:
        _check_sensors(tables, fail)
    directed = [own.outputs is not None for _, own in controller.channel]
    if any(directed) and not all(directed):
        words = "gives outputs, another channel none; give them for every channel or for none"
        raise fail(f"controller.channel.{controller.channel[directed.index(True)][0]}", words)
    for name, own in controller.channel:
        if own.inputs is not None and own.outputs is None:
            raise fail(f"controller.channel.{name}.inputs", "has no outputs beside it; add them")
        if own.like is not None:
            others = dict(controller.channel)
            if own.like == name or own.like not in others or others[own.like].like is not None:
                words = f"is {own.like!r}; name a channel with a table and parameters of its own"
                raise fail(f"controller.channel.{name}.like", words)
            for key in (*(item.name for item in fields(Structure)), *_OF_CHANNELS):
                if getattr(own, key) != getattr(ChannelTable, key, None):
                    raise fail(f"controller.channel.{name}.{key}", "is given by like; drop it")
        for key, where in (("S_max", "inner"), ("M_K", "weights")):
            required, whole = getattr(own, key), getattr(tables[where], key)
            if required is not None and required > whole:
                words = (
                    f"is {required:g}, above {where}.{key} = {whole:g}, which the whole loop keeps"
                )
                remedy = f"give less, or raise {where}.{key} to that of the loosest channel"
                raise fail(f"controller.channel.{name}.{key}", f"{words}; {remedy}")
        if own.M_K is not None and controller.weighted_level is None:
            words = "has an effect on a bounded KS only; give controller.weighted_level, or drop it"
            raise fail(f"controller.channel.{name}.M_K", words)
    if len(tables["robust"].plants) > (most := KindOptions.most_plants):
        raise fail("robust.plants", f"names more than {most} plants; name the extreme ones")


def _check_sensors(tables: Mapping[str, Any], fail: Fail) -> None:
    """Raise where several sensors on one actuator cannot be designed as the case says."""
    controller, inner = tables["controller"], tables["inner"]
    if inner.minimise != BANDWIDTH.key:
        words = "with several sensors on one actuator the bandwidth alone is known; drop it"
        raise fail("inner.minimise", words)
    for name, own in controller.channel:
        where = f"controller.channel.{name}"
        if own.integrator and name != controller.bandwidth_of:
            words = "is true: two integrators on one actuator drift against each other; leave it to"
            raise fail(f"{where}.integrator", f"{words} channel {controller.bandwidth_of}")
        for key in ("inputs", "like", "bandwidth_ratio"):
            if getattr(own, key) != getattr(ChannelTable, key):
                words = "has no effect where all channels drive one actuator; drop it"
                raise fail(f"{where}.{key}", words)


def with_structure(case: Case, structure: str) -> Case:
    """Replace the kind of controller of a case; keys without effect on it get their defaults.

    Parameters
    ----------
    case : Case
    structure : str
        As `controller.structure`.

    Returns
    -------
    Case
    """
    other = _OF_H_INFINITY if structure == "sections" else _OF_STRUCTURED
    tables: dict[str, Any] = {"controller": replace(case.controller, structure=structure)}
    for name, keys in other.items():
        table = tables.get(name, getattr(case, name))
        unset = {item.name: item.default for item in fields(table) if item.name in keys}
        tables[name] = replace(table, **unset)
    if structure != WITH_DISTURBANCE:
        tables["weights"] = replace(case.weights, disturbance=None)
    return replace(case, **tables)


def structure_of(controller: ControllerTable) -> Structure:
    """The structure that [controller] names."""
    return Structure(**{item.name: getattr(controller, item.name) for item in fields(Structure)})


def weights_of(controller: ControllerTable, weights: WeightsTable, inner: InnerTable) -> Weights:
    """The weights, in SI, with ω_S and ω_T at the lower ends of their ranges."""
    values: dict[str, Any] = vars(weights) | {
        "omega_K": HZ * weights.omega_K_hz,
        "omega_S": HZ * inner.omega_S_hz[0],
        "omega_T": HZ * inner.omega_T_hz[0],
    }
    if controller.structure != WITH_DISTURBANCE:
        values["disturbance"] = 0.0
    elif weights.disturbance is None:
        values["disturbance"] = KindOptions.disturbance * weights.M_K
    del values["omega_K_hz"]
    return Weights(**values)


def structured_problem(case: Case, options: tuple[Options, ...]) -> StructuredProblem:
    """The problem of a fixed structure; `options` of the plant's further sets."""
    controller, loop, robust, inner = case.controller, case.loop, case.robust, case.inner
    return StructuredProblem(
        structure=structure_of(controller),
        shape=KindOptions.shape if inner.shape is None else inner.shape,
        shape_ends=ShapeEnd(inner.shape_ends),
        weighted_level=controller.weighted_level,
        compliance_max=inner.compliance_max,
        sampling=None if loop.rate_hz is None else Sampling(loop.rate_hz, loop.delay_us),
        uncertainty=Uncertainty(
            robust.resonance_shift,
            robust.mode_shift,
            (min(1.0, *robust.damping, 1.0), max(1.0, *robust.damping, 1.0)),
            robust.gain,
            options,
            tuple((p.name, p.lower, p.upper) for p in case.fixed if p.varies),
        ),
        starts=controller.starts,
        minimise=inner.minimise,
        bandwidth_least=HZ * (inner.bandwidth_least_hz or 0.0),
        channels=_channels(controller),
        bandwidth_of=controller.bandwidth_of,
    )


def _channels(controller: ControllerTable) -> tuple[ChannelProblem, ...]:
    """The channels that the case names, each with its structure."""
    usual, found, given = structure_of(controller), [], dict(controller.channel)
    keys = [item.name for item in fields(Structure)]
    for name, own in controller.channel:
        whose = own if own.like is None else given[own.like]
        values = {key: getattr(whose, key) for key in keys if getattr(whose, key) is not None}
        structure = replace(usual, **values)
        inputs = own.outputs if own.inputs is None else own.inputs
        if controller.bandwidth_of is not None:
            inputs = None if own.outputs is None else (1.0,)
            structure = of_sensor(structure, name == controller.bandwidth_of)
        bounds = {key: getattr(whose, key) for key in _OF_CHANNELS}
        found.append(ChannelProblem(name, structure, own.outputs, inputs, own.like, **bounds))
    return tuple(found)
