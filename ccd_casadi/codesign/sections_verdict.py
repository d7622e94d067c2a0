"""The five lines of the verdict on a controller of fixed structure; see `verdict`."""

import math
from collections.abc import Sequence

from ccd_casadi.codesign.kkt import Kink
from ccd_casadi.codesign.sections_run import VerifiedSections
from ccd_casadi.codesign.verdict import Line, State, Verdict, margin_figures, predicted, survives
from ccd_casadi.inner_problem.sections_plant_set import sections_of_problem
from ccd_casadi.support.units import HZ, counted
from surrogates import Quality

# Of ∇J: the envelope gradient of a controller that is itself optimal to 1e-3 is right to 2e-3.
KKT_LEVEL = 1e-2


def sections_verdict(
    verified: VerifiedSections,
    *,
    constraints: bool,
    error: float,
    tolerance: float,
    surrogate: bool,
    quality: Sequence[Quality] = (),
) -> Verdict:
    """`constraints`: λ(θ) <= 0; `error`: of the predicted bandwidth or RMS error, relative.

    `surrogate`: whether one predicted it, `quality` what that says of itself.
    """
    return Verdict(
        certified=_certified(verified, constraints),
        optimal=_optimal(verified, tolerance),
        predicted=_predicted(verified, error, tolerance, surrogate, quality),
        survives=_survives(verified),
        deployable=_deployable(verified),
    )


def _certified(verified: VerifiedSections, constraints: bool) -> Line:
    made = verified.design
    figures = {} if made.certificate is None else {"figures_over_bounds": made.certificate.worst}
    if not made.certified:
        return Line(State.FAILED, made.words, figures)
    if not constraints:
        return Line(State.FAILED, "certified, but a constraint on theta is not met", figures)
    count = 0 if made.certificate is None else len(made.certificate.plants)
    where = "the model" if count == 1 else f"the {count} plants"
    words = f"stable and within every bound on {where} that it was designed on"
    return Line(State.PASSED, words, figures)


def _optimal(verified: VerifiedSections, tolerance: float) -> Line:
    residual, gap = verified.kkt.stationarity, verified.race_gap
    found = [value / HZ for value, _ in verified.raced.optima]
    figures = {
        "kkt_residual": residual,
        "kkt_level": KKT_LEVEL,
        "inner_gap": gap,
        "local_optima_hz": found,
    }
    raced = ", ".join(f"{value:.2f}" for value in found)
    known = f"a full race at this theta ended at {raced} Hz; gap not known"
    if _of_error(verified):
        known = (
            f"from a full race at this theta the least error is {1e9 * verified.raced.error:.4g} "
            f"nm RMS, {1e9 * verified.value:.4g} here; gap not known"
        )
    if gap > tolerance:
        more = f"{100.0 * gap:.2g} % more bandwidth"
        if _of_error(verified):
            more = f"{1e9 * verified.raced.error:.4g} instead of {1e9 * verified.value:.4g} nm RMS"
        words = f"a race found a controller with {more} at this theta"
        return Line(State.FAILED, words, figures)
    if not math.isfinite(residual):
        off = verified.design.kkt_residual
        words = f"no gradient over theta, since the search over the controller ended {off:.1e} from"
        words += f" its optimum: a limit of ours; {known}"
        return Line(State.WARNED, words, figures)
    if residual > KKT_LEVEL:
        words = f"not optimal: KKT residual {residual:.1e} over theta, above {KKT_LEVEL:g}"
        return Line(State.FAILED, f"{words}; {known}", figures)
    kink = verified.kkt.kink
    if kink is None:
        return Line(State.PASSED, f"KKT residual {residual:.1e} over theta; {known}", figures)
    figures |= {"kkt_residual_one_gradient": kink.one_gradient, "slopes": kink.slopes}
    if kink.least_slope < -KKT_LEVEL:
        words = f"not optimal: J has a kink and falls on a side of it ({_sides(kink)})"
        return Line(State.FAILED, f"{words}; {known}", figures)
    words = (
        f"first-order optimal at a kink of J: KKT residual {residual:.1e} over theta and the "
        f"controller together, {kink.one_gradient:.2g} with one side's gradient alone; true J "
        f"{_sides(kink)}; {known}"
    )
    asked = all(math.isfinite(slope) for pair in kink.slopes for slope in pair)
    return Line(State.PASSED if asked else State.WARNED, words, figures)


def _sides(kink: Kink) -> str:
    """What true values beside a kink say, in words."""
    if not kink.slopes:
        return "was not asked beside it: bounds alone hold theta"
    found = [slope for pair in kink.slopes for slope in pair]
    known = sum(map(math.isfinite, found))
    if not known:
        return "is not known beside it"
    if len(found) == 2 and known == 2:
        words = f"grows by {found[0]:.2g} and {found[1]:.2g} of its gradient on the two sides"
        return f"{words} of the one direction that is left"
    return (
        f"grows by at least {kink.least_slope:.2g} of its gradient on {known} of {len(found)} "
        f"sides of {len(kink.slopes)} directions"
    )


def _of_error(verified: VerifiedSections) -> bool:
    return sections_of_problem(verified.problem).of_error


def _predicted(
    verified: VerifiedSections,
    error: float,
    tolerance: float,
    surrogate: bool,
    quality: Sequence[Quality],
) -> Line:
    at = quality[0].at_point if quality else None
    of, value = ("bandwidth", "Hz"), verified.value / HZ
    if _of_error(verified):
        of, value = ("RMS error", "nm"), 1e9 * verified.value
    return predicted(
        error=error,
        tolerance=tolerance,
        left_out=None if at is None else abs(at[0]) / value,
        left_out_size=None if at is None else abs(at[0]),
        sigmas=None if at is None else at[1],
        extrapolates=quality[0].extrapolates if quality else (),
        surrogate=surrogate,
        of=of,
    )


def _survives(verified: VerifiedSections) -> Line:
    wide, excess, proof = verified.wide, math.expm1(verified.worst.value), verified.proof
    figures = {
        "plants": verified.checked,
        "worst_excess": excess,
        "proof": proof.outcome.name.lower(),
        "proven": proof.levels,
    }
    where = f"{counted(verified.checked, 'plant')} of the box that [robust] names"
    words = f"within every bound on {where}, the worst searched {100.0 * excess:+.2g} % of a bound"
    robust: bool | None = verified.kept
    if not wide.passed:
        words = f"on {where}: {wide.words}"
    elif proof.refuted:
        words = f"within every bound on {where}, but {proof.words}"
    elif verified.checked <= 1:
        robust, words = None, "[robust] names no plant but the model"
    elif robust:
        words = f"{words}; {proof.words}"
    else:
        words = f"within every bound on {where}, but not all along its common resonance shift"
    line = survives(
        verified.survival,
        S_max=verified.problem.inner.S_max,
        robust=robust,
        robust_words=words,
        other_damping="" if verified.damping is None else verified.damping.words,
        figures=figures,
    )
    state = State.WARNED if robust is None and line.state is State.PASSED else line.state
    return Line(state, line.words, line.figures)


def _deployable(verified: VerifiedSections) -> Line:
    sampling = sections_of_problem(verified.problem).sampling
    if sampling is None:
        words = "designed as if continuous: run deploy, or give rate_hz and delay_us in [loop]"
        return Line(State.UNKNOWN, words, margin_figures(verified.survival))
    words = (
        f"designed and judged at {sampling.rate_hz:g} Hz with {sampling.delay_us:g} us, hold and "
        "delay exact at the instants; run deploy for the code"
    )
    figures = {"rate_hz": sampling.rate_hz, "delay_us": sampling.delay_us}
    figures |= margin_figures(verified.survival)
    return Line(State.PASSED, words, figures)
