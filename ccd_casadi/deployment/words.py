"""A deployment's verdict in words: what is kept, by how much, and on which plant."""

from ccd_casadi.cases.run_folder import FinishedRun
from ccd_casadi.deployment.outcome import Deployment
from ccd_casadi.deployment.robust_set import place_words


def status_words(run: FinishedRun, found: Deployment) -> str:
    """`verified`, or not, and the reason beside it."""
    status = "verified" if found.passed else "not verified"
    return f"{status}  {reason_words(run, found)}".rstrip()


def reason_words(run: FinishedRun, found: Deployment) -> str:
    """Why it is not verified; where it is, what hold and delay have taken of S_max."""
    parts = []
    if found.unverified:
        parts.append(f"the run itself is not verified: {found.unverified}")
    if found.shortfalls:
        return "; ".join([*parts, found.shortfalls[0]])
    S_max, worst = run.problem.inner.S_max, found.worst
    over = 100.0 * (worst.figures.sensitivity_peak / S_max - 1.0)
    where = f" ({place_words(worst.at)})" if found.members else ""
    if over > 0.0:
        allowed = 100.0 * found.target.excess
        parts.append(
            f"within {allowed:.2g} % of S_max = {S_max:g}: hold and delay bring the peak of S "
            f"{over:.2f} % above it{where}"
        )
    return "; ".join(parts)
