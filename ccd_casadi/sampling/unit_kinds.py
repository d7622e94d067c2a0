"""The units of every kind of inner problem."""

from collections.abc import Callable

from ccd_casadi.inner_problem.controller_problem import ControllerProblem, MixedSensitivityProblem
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.sampling.units import InnerUnits, MixedUnits, Unit
from ccd_casadi.support.process_pool import Pool


def _structured() -> InnerUnits:
    """Imported where a problem has such a controller."""
    from ccd_casadi.sampling.structured_units import StructuredUnits

    return StructuredUnits()


# One entry for each class of `CoDesignProblem.controller`; another kind adds its own.
UNITS: dict[type[ControllerProblem], Callable[[], InnerUnits]] = {
    MixedSensitivityProblem: MixedUnits,
    StructuredProblem: _structured,
}


def units_of(problem: CoDesignProblem) -> InnerUnits:
    """Find the units of a problem's kind.

    Parameters
    ----------
    problem : CoDesignProblem

    Returns
    -------
    InnerUnits
    """
    return UNITS[type(problem.controller)]()


def inner_unit(
    task: tuple[CoDesignProblem, str, str, tuple[float, ...]], workers: Pool | None = None
) -> tuple[str, Unit]:
    """Solve the inner problem at one θ; every design becomes a row.

    Parameters
    ----------
    task : tuple
        The problem, its hash, the key of the unit, and θ (SI).
    workers : Pool, optional
        Those that have nothing else to do.

    Returns
    -------
    key, unit : str, Unit
    """
    problem, problem_key, key, theta = task
    return key, units_of(problem).solve(problem, problem_key, key, theta, workers)
