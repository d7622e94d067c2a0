"""The five lines of the verdict on a verified mixed-sensitivity design."""

from ccd_casadi.codesign.box_look import BoxLook
from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.verdict import (
    CloserModel,
    Verdict,
    certified,
    deployable,
    optimal,
    predicted,
    survives,
)
from ccd_casadi.codesign.verify import VerifiedDesign
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.support.units import HZ
from surrogates import Quality


def verdict_of(
    outcome: FormulationResult,
    verified: VerifiedDesign,
    problem: CoDesignProblem,
    tolerance: float,
    error: float,
    quality: tuple[Quality, ...] = (),
    look: BoxLook | None = None,
) -> Verdict:
    """The five lines on a verified design; `error` is that of its predicted bandwidth."""
    figures, robust = verified.design.figures, verified.robust
    solved = outcome.outer
    at = quality[0].at_point if quality else None
    return Verdict(
        certified=certified(
            certificate=figures.certified,
            constraints=verified.feasible,
            norm=figures.certificate.norm,
            norm_bound=figures.certificate.norm_bound,
            peak=figures.sensitivity_peak,
            bounds=problem.inner.bounds,
            compliance=figures.compliance,
        ),
        optimal=optimal(
            residual=verified.kkt.stationarity,
            second_order=verified.kkt.second_order,
            inner_gap=verified.inner_gap,
            tolerance=tolerance,
            starts=0 if solved is None else solved.starts,
            optima=0 if solved is None else len(solved.optima),
            look=look,
        ),
        predicted=predicted(
            error=error,
            tolerance=tolerance,
            left_out=None if at is None else abs(at[0]) / (figures.bandwidth / HZ),
            left_out_size=None if at is None else abs(at[0]),
            sigmas=None if at is None else at[1],
            extrapolates=quality[0].extrapolates if quality else (),
            surrogate=bool(outcome.surrogates),
        ),
        survives=survives(
            verified.survival,
            S_max=problem.inner.S_max,
            robust=None if robust is None else robust.passed,
            robust_words="" if robust is None else robust.words,
            other_damping="" if verified.damping is None else verified.damping.words,
            closer=tuple(
                CloserModel(
                    check.name,
                    check.figures.certificate.stable,
                    check.figures.sensitivity_peak,
                )
                for check in verified.references
            ),
        ),
        deployable=deployable(verified.survival),
    )
