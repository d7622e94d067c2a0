"""A small case of every kind of inner problem: of contract and golden values."""

from dataclasses import replace

from ccd_casadi.budget.sources import ErrorBudget, ErrorSource, ShapedSpectrum, SourceKind
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import StructuredProblem, Uncertainty
from ccd_casadi.lti.loop import Sampling
from oracles.helpers import HZ, problem

PID = StructuredProblem(
    structure=Structure(biquads=0),
    weighted_level=8.426,
    uncertainty=Uncertainty(resonance_shift=0.03),
    starts=4,
)
CABLES = ErrorBudget((
    ErrorSource("cables", SourceKind.FORCE, ShapedSpectrum(1e-2, (), ((20.0,),))),
    ErrorSource("encoder", SourceKind.SENSOR_NOISE, ShapedSpectrum(2.5e-21)),
))  # fmt: skip
SLOW = 8.0 * HZ


def quick(sections: StructuredProblem = PID) -> CoDesignProblem:
    """Case study 1 with a PID, feasible for most searches."""
    case = problem(controller=sections, start=(60.0, 60.0))
    return replace(case, inner=replace(case.inner, S_low=0.2))


def least(sampling: Sampling | None = None, **changes: object) -> CoDesignProblem:
    """The same for the least RMS error."""
    sections = replace(
        PID, uncertainty=Uncertainty(), starts=2, sampling=sampling, minimise="rms_error",
        bandwidth_least=SLOW,
    )  # fmt: skip
    case = replace(quick(replace(sections, **changes)), budget=CABLES)  # type: ignore[arg-type]
    return replace(case, w1=0.01, w2=1e6, lower=(58.0, 58.0), upper=(62.0, 62.0))


def kinds() -> dict[str, CoDesignProblem]:
    """Case study 1 around (60, 60) kg; sections with a PID from two starts."""
    small = {"lower": (58.0, 58.0), "upper": (62.0, 62.0), "start": (60.0, 60.0)}
    mixed = problem(**small)
    sections = quick(replace(PID, uncertainty=Uncertainty(), starts=2))
    return {
        "mixed": mixed,
        "disturbance": replace(mixed, weights=replace(mixed.weights, disturbance=2e8)),
        "sections": replace(sections, **small),
        "error": least(),
    }
