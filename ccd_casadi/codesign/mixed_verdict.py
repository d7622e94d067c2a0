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
from ccd_casadi.codesign.verify import RobustCheck, VerifiedDesign
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
            robust_words=_robust_words(robust),
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


def _robust_words(check: RobustCheck | None) -> str:
    if check is None:
        return ""
    at = f"at {100 * check.at.shift:+.2g} %, damping x {check.at.damping:.3g}"
    if not check.worst.certificate.stable:
        return f"unstable within its own robust set, {at}"
    peak = f"peak of S {check.worst.sensitivity_peak:.4g} {at}"
    if check.passed:
        return f"its own robust set is kept ({check.plants} plants, worst {peak})"
    return f"its own robust set is not kept: {peak}"
