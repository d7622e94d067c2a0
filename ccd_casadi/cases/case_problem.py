"""A case in SI: the co-design problem that the lower layers take."""

import math
from collections.abc import Mapping
from dataclasses import replace
from secrets import token_hex
from typing import Any

from ccd_casadi.cases.case import CaseError
from ccd_casadi.cases.controller_kinds import structured_problem, weights_of
from ccd_casadi.cases.controller_tables import DriveTable, filters_of, motion_problem
from ccd_casadi.cases.tables import BudgetTable, Case, InnerTable, PlacesTable, RobustTable
from ccd_casadi.inner_problem.controller_problem import (
    BANDWIDTH,
    MixedSensitivityProblem,
    Options,
    RobustSet,
)
from ccd_casadi.inner_problem.plant_source import PlantSource
from ccd_casadi.inner_problem.problem import (
    CoDesignProblem,
    plant_of,
    refuse_ports,
    scaled_plant,
    with_options,
)
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.inner_problem.sweep import InnerBounds
from ccd_casadi.lti.wiring import Wiring
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.plants.registry import model_named
from ccd_casadi.support.errors import PlantError, UserError
from ccd_casadi.support.options import one_line
from ccd_casadi.support.terminal import keep_quiet
from ccd_casadi.support.text import HZ
from ccd_casadi.support.user_code import GivenFunction, raised_words
from ccd_casadi.support.worker_process import one_blas_thread


def plain_case(case: Case) -> Case:
    """Leave out what `ccd drive` and `ccd tolerances` alone design: the plants remain.

    Parameters
    ----------
    case : Case

    Returns
    -------
    Case
        Without [drive], its bound of the compliance, and [robust] share.
    """
    case = replace(case, robust=replace(case.robust, share=None))
    if case.drive.name is None:
        return case
    inner = replace(case.inner, compliance_max=None)  # of the table's force, not the sensors'
    return replace(case, drive=DriveTable(), inner=inner)


@one_blas_thread
def problem_of(case: Case, *, at_a_sample: bool = False) -> CoDesignProblem:
    """The case in SI, with its plant, which is made once here.

    Parameters
    ----------
    case : Case
        As `load_case` gives it.
    at_a_sample : bool
        Whether it is enough that the plant is known at samples of θ.

    Returns
    -------
    CoDesignProblem
        What `solve`, `true_inner` and the like take.

    Raises
    ------
    CaseError
        The plant is not valid; a plant function is evaluated over the box.

    Examples
    --------
    >>> from ccd_casadi.cases.case import TWO_MASS, load_case
    >>> problem = problem_of(load_case(TWO_MASS))
    >>> problem.names, problem.w2, round(problem.inner.omega_low, 3)
    (('m1', 'm2'), -0.995, 6.283)
    """
    if case.drive.name is not None:
        words = "is designed by `ccd drive` alone; use that, or drop [drive] for free sections"
        raise CaseError(f"{case.path}: drive: {words}")
    if case.robust.share is not None:
        words = "is kept by `ccd tolerances` alone; use that, or drop share for the whole box"
        raise CaseError(f"{case.path}: robust.share: {words}")
    source, structured = _source(case), case.controller.structure == "sections"
    budget = None
    if case.budget != BudgetTable():  # few cases have one
        from ccd_casadi.cases.budget import error_budget

        budget = error_budget(case.budget)
    problem = CoDesignProblem(
        source=source,
        names=tuple(p.name for p in case.theta),
        units=tuple(p.unit for p in case.theta),
        lower=tuple(p.lower for p in case.theta),
        upper=tuple(p.upper for p in case.theta),
        start=tuple(p.start for p in case.theta),
        listed=tuple((p.name, p.values) for p in case.theta if p.values),
        w1=case.objective.w1,
        w2=case.objective.w2,
        cost_unit=case.objective.cost_unit,
        weights=weights_of(case.controller, case.weights, case.inner),
        inner=_inner_bounds(case.inner, structured),
        suspension=_suspension(case),
        method=case.inner.method,
        robust=None if structured else _robust(case.robust),
        controller=structured_problem(case, tuple(map(_options, case.robust.plants)))
        if structured
        else MixedSensitivityProblem(),
        budget=budget,
        spoken=(case.units.output, case.units.input),
    )
    try:
        problem = _with_known_plant(problem)
        model = model_named(case.plant.model)
        if model is None or not model.sound:
            _require_sound(problem, case.suspension.rigid_modes, at_a_sample)
    except UserError as error:
        raise CaseError(one_line(f"{case.path}: plant: {error}")) from error
    except Exception as error:
        if source.function is None:
            raise
        words = f"{source.function} raised {raised_words(error)}; correct it"
        raise CaseError(one_line(f"{case.path}: plant.function: {words}")) from error
    return problem


def _source(case: Case) -> PlantSource:
    """What the case's plant is made from."""
    file = function = given = positions = None
    if callable(case.plant.function):
        function, given = case.plant.name, GivenFunction(case.plant.function)
    elif case.plant.function is not None:
        name, function = case.plant.function.rsplit(":", 1)
        file = str((case.path.parent / name).resolve())
    if case.places != PlacesTable():
        from ccd_casadi.cases.budget import places_of

        positions = places_of(case.places)
    return PlantSource(
        case.plant.model,
        file,
        function,
        _options(case.plant.options),
        case.limits.plant_seconds,
        content=None if given is None else token_hex(),
        fixed=tuple((p.name, p.start, p.unit) for p in case.fixed),
        motion=motion_problem(case.move, case.motor, case.loop.rate_hz),
        places=positions,
        wiring=Wiring(filters_of(case.actuator), filters_of(case.sensor)),
        given=given,
    ).pin()


def _inner_bounds(inner: InnerTable, structured: bool) -> InnerBounds:
    """The bounds and ranges of [inner], rad/s."""
    return InnerBounds(
        S_max=inner.S_max,
        S_low=inner.S_low,
        omega_low=HZ * inner.omega_low_hz,
        omega_S=(HZ * inner.omega_S_hz[0], HZ * inner.omega_S_hz[1]),
        omega_T=(HZ * inner.omega_T_hz[0], HZ * inner.omega_T_hz[1]),
        gamma_backoff=inner.gamma_backoff,
        sweep_points=inner.sweep_points,
        # a fixed structure bounds it on every plant of its set
        compliance_max=None if structured else inner.compliance_max,
    )


def _with_known_plant(problem: CoDesignProblem) -> CoDesignProblem:
    """Check the plant against controller, ports and move, and complete what it decides."""
    others = problem.controller.plant_options
    plants = [plant_of(with_options(problem, options)) for options in ((), *others)]
    problem.controller.require_plants(plants)
    if math.isnan(problem.weights.M_K):
        problem = _with_a_scale(problem)
    _require_ports_known(problem)
    if (motion := problem.source.motion) is not None:
        from ccd_casadi.inner_problem.structured_bandwidth import require_motion
        from ccd_casadi.inner_problem.structured_plant_set import break_points_of

        if places := break_points_of(problem):  # the one whose error counts moves
            motion = replace(motion, output=places[0].output)
            problem = replace(problem, source=replace(problem.source, motion=motion))
        require_motion(problem)
    return problem


def _require_sound(problem: CoDesignProblem, rigid_modes: int | None, at_a_sample: bool) -> None:
    """Raise PlantError where the diagnosis of the plant finds an error."""
    from ccd_casadi.cases.diagnosis import diagnose
    from ccd_casadi.cases.findings import Severity, Topic

    with keep_quiet(True):
        found = diagnose(problem, rigid_modes)[1]
    for finding in found:
        of_a_sample = at_a_sample and finding.topic is Topic.BETWEEN
        if finding.severity is Severity.ERROR and not of_a_sample:
            raise PlantError(finding.words)


def _require_ports_known(problem: CoDesignProblem) -> None:
    """Raise PlantError where a plant with a disturbance or a performance meets what knows none."""
    own, source = problem.controller, problem.source
    sections = own if isinstance(own, StructuredProblem) else None
    if sections is None:
        refuse_ports(problem, 'full order, but to controller.structure = "sections" alone')
    elif sections.figure is not BANDWIDTH:
        timed = sections.minimise == "move_time"
        what, table = ("time", "[move]") if timed else ("error", "[budget]")
        remedy = (
            f'give minimise = "bandwidth", which reports the {what} of {table} with them, or let '
            f"the plant function not return them: the least {what} is then of the sensor's error "
            "alone, and no page shows it elsewhere"
        )
        refuse_ports(problem, f'inner.minimise = "{sections.minimise}"', remedy)
    elif sections.compliance_max is not None:
        from ccd_casadi.inner_problem.structured_plant_set import require_bounded_ports

        require_bounded_ports(problem)
    if source.places:
        refuse_ports(problem, "[places]")


def _suspension(case: Case) -> Suspension:
    """A default suspension lies a decade below the lowest frequency that a bound names: nearer to
    the bandwidth, what is synthesised on it is unstable or slow on the free bodies."""
    table, softest = case.suspension, Suspension()
    frequency = table.frequency_hz
    if frequency is None:
        frequency = min(softest.frequency_hz, 0.1 * case.inner.omega_low_hz)
    return Suspension(frequency, table.damping_ratio, table.rigid_modes, table.undamped)


def _with_a_scale(problem: CoDesignProblem) -> CoDesignProblem:
    """The problem with an M_K that bounds nothing: loops are computed in units of it."""
    from ccd_casadi.cases.findings import suitable_effort

    unit = replace(problem, weights=replace(problem.weights, M_K=1.0))
    M_K = suitable_effort(unit, scaled_plant(unit, unit.start))
    return replace(problem, weights=replace(problem.weights, M_K=M_K))


def _options(of: Mapping[str, Any]) -> Options:
    """The options of a plant, in an order of their own, as values that never change."""
    return tuple(sorted((key, _freeze(value)) for key, value in of.items()))


def _robust(table: RobustTable) -> RobustSet | None:
    """The set of plants that [robust] names; None where it names no other than the model."""
    shift = table.resonance_shift
    if shift == 0.0 and not table.damping:
        return None
    ends = {"auto": None if shift else 0.0, "low": -shift, "nominal": 0.0, "high": shift}
    design = ends[table.design_at]
    return RobustSet(shift, table.shifts if shift else 1, table.damping, design)


def _freeze(value: Any) -> Any:
    return tuple(map(_freeze, value)) if isinstance(value, list) else value
