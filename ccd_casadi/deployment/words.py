"""A deployment's verdict in words: what is kept, by how much, and on which plant."""

from math import isfinite
from typing import Any

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.codesign.verdict import State, VerdictLine
from ccd_casadi.deployment.discretise import Conversion
from ccd_casadi.deployment.outcome import Deployment
from ccd_casadi.deployment.robust_set import place_words
from ccd_casadi.inner_problem.kinds import kind_of
from ccd_casadi.robust.sampled import SampledFigures
from ccd_casadi.support.units import HZ


def status_words(run: FinishedRun, found: Deployment) -> str:
    """`verified`, or not, and the reason beside it."""
    return f"{short_status(run, found)}  {reason_words(run, found)}".rstrip()


def short_status(run: FinishedRun, found: Deployment) -> str:
    """`verified` without more where every bound is kept as the case gives it."""
    if not found.passed:
        return "not verified"
    if _over(run, found) > 0.0:
        return f"verified to {100.0 * found.target.excess:.2g} % of S_max"
    return "verified"


def deployed_line(run: FinishedRun, found: Deployment) -> VerdictLine:
    """`deployable` of the run's verdict."""
    K = found.sampled
    at = f"at {found.rate_hz:.6g} Hz with a delay of {1e6 * found.delay:.4g} us"
    figures = {
        "rate_hz": found.rate_hz,
        "delay": found.delay,
        "needed_hz": found.needed_hz,
        "order": len(found.realisation.system.A),
        "stable": found.stable,
        "bandwidth_hz": K.bandwidth / HZ,
        "sensitivity_peak": found.worst.figures.sensitivity_peak,
        "worst_bandwidth_hz": found.worst.figures.bandwidth / HZ,
        "plants": 1 + len(found.members),
        "judge": None if found.judge is None else found.judge.entry,
    }
    if found.shortfalls:
        return VerdictLine(State.FAILED, f"{at}: {found.shortfalls[0]}", figures)
    kept = f"{at}: {_loop_words(K)}"
    if found.members:
        kept = f"{at}: on the model {_loop_words(K)}"
        worst = found.worst
        if worst.figures is not K:
            where = place_words(worst.at)
            kept += f"; on the plant with the largest peak ({where}) {_loop_words(worst.figures)}"
    reason = reason_words(run, found)
    if reason:
        return VerdictLine(State.WARNED, f"{kept}; {reason}", figures)
    return VerdictLine(State.PASSED, kept, figures)


def _loop_words(found: SampledFigures) -> str:
    """Of one plant."""
    return f"bandwidth {found.bandwidth / HZ:.4g} Hz, peak of S {found.sensitivity_peak:.5g}"


def order_words(run: FinishedRun, found: Deployment) -> str:
    """`4 of 6 states (7 synthesised), and 1 of the lead filter`."""
    orders = [item.chosen.order for item in found.orders]
    if kind_of(run.problem).as_designed:
        return f"{' + '.join(map(str, orders))} states, as designed"
    words = " + ".join(
        f"{order} of {item.rows[0].order}" for order, item in zip(orders, found.orders, strict=True)
    )
    more = len(found.realisation.system.A) - found.order
    lead = f", and {more} of the lead filter" if found.conversion is Conversion.LEAD else ""
    return f"{words} states ({len(run.controller.A)} synthesised){lead}"


def figure_rows(run: FinishedRun, found: Deployment) -> list[tuple[str, str, str]]:
    """Bandwidth and peak of S of every loop on the way: name, value and remark."""
    loops: list[tuple[str, Any]] = [("Full", run.figures), ("Reduced", found.reduced_figures)]
    if kind_of(run.problem).as_designed:
        loops = [("Continuous", run.figures)]
    rows = []
    for name, figures in (*loops, ("Sampled", found.sampled)):
        if figures is not None and isfinite(figures.bandwidth):
            change = 100.0 * (figures.bandwidth / run.figures.bandwidth - 1.0)
            peak = against(figures.sensitivity_peak, run.problem.inner.S_max)
            words = f"peak {figures.sensitivity_peak:.6g} ({peak})"
            if figures is not run.figures:
                words += f", bandwidth {round(change, 2) + 0.0:+.2f} %"
            rows.append((name, f"{figures.bandwidth / HZ:.6g} Hz", words))
    return rows


def against(peak: float, S_max: float) -> str:
    """`3.10 % above S_max`."""
    over = round(100.0 * (peak / S_max - 1.0), 2)
    return f"{abs(over):.2f} % {'above' if over > 0.0 else 'below'} S_max" if over else "S_max"


def _over(run: FinishedRun, found: Deployment) -> float:
    """How far the largest peak exceeds S_max, in %."""
    peak = found.worst.figures.sensitivity_peak
    return 100.0 * (peak / run.problem.inner.S_max - 1.0)


def reason_words(run: FinishedRun, found: Deployment) -> str:
    """Why it is not verified; where it is, what hold and delay have taken of S_max."""
    own = f"the run itself is not verified: {found.unverified}"
    parts = [own] if found.unverified else []
    if found.shortfalls:
        return "; ".join([*parts, found.shortfalls[0]])
    S_max, over = run.problem.inner.S_max, _over(run, found)
    where = f" ({place_words(found.worst.at)})" if found.members else ""
    if over > 0.0:
        allowed = 100.0 * found.target.excess
        parts.append(
            f"hold and delay bring the peak of S {over:.2f} % above S_max = {S_max:g}{where}; "
            f"{allowed:.2g} % is allowed for a deployment"
        )
    return "; ".join(parts)
