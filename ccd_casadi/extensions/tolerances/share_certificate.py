"""The certificate of a share of machines: fresh draws that no search has seen, by the judge.

One count of a number of draws that is fixed before, one-sided (Clopper and Pearson 1934): the
share holds at its confidence where that bound is at least the share. A machine whose evaluation
raises or gives no number counts as failing.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ccd_casadi.cases.tables import RobustTable
from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.verdict import Check, State
from ccd_casadi.extensions.tolerances.machines import Machine, Plan, drawn
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.support.process_pool import Pool, results


@dataclass(frozen=True)
class ShareCertificateOptions:
    """Numbers of the certificate.

    Attributes
    ----------
    batch : int
        Machines that are judged at once.
    seed : int
        Beside the run's: no search draws with it.
    """

    batch: int = 250
    seed: int = 5000


@dataclass(frozen=True)
class ShareCertificate:
    """How many fresh machines keep every bound.

    Attributes
    ----------
    plan : Plan
        The share, its confidence, and the number of draws.
    failed : int
        Of these.
    not_evaluated : int
        Of those that failed: where the evaluation raised.
    """

    plan: Plan
    failed: int
    not_evaluated: int = 0

    @property
    def least(self) -> float:
        """The share that is shown, at the confidence."""
        return self.plan.shown(self.failed)

    @property
    def passed(self) -> bool:
        """Whether it is the share that is required."""
        return self.least >= self.plan.share

    @property
    def line(self) -> Check:
        """Of the verdict. It says nothing of the whole box."""
        plan, state = self.plan, State.PASSED if self.passed else State.FAILED
        claim = RobustTable(share=plan.share, confidence=plan.confidence).share_words
        shown = (Reason.SHARE_SHOWN if self.passed else Reason.SHARE_NOT_SHOWN)(claim=claim)
        found = (shown, Reason.SHARE_LEAST(), Reason.MAY_FAIL(), Reason.BOX_NOT_JUDGED())
        return Check("survives", state, found, self.entry)

    @property
    def entry(self) -> dict[str, Any]:
        """Figures for tolerances.json."""
        plan = self.plan
        return {
            "share": plan.share, "confidence": plan.confidence, "draws": plan.draws,
            "failed": self.failed, "not_evaluated": self.not_evaluated, "allowed": plan.allowed,
            "least": self.least,
        }  # fmt: skip


Judge = Callable[[list[Machine]], list[bool]]


def judged(judge: Judge, machines: list[Machine]) -> tuple[int, int]:
    """Count failing machines, and how many of these could not be evaluated."""
    try:
        return sum(not kept for kept in judge(machines)), 0
    except Exception:  # a plant function may raise anything: each by itself, to find which
        if len(machines) == 1:
            return 1, 1
    each = [judged(judge, [one]) for one in machines]
    return sum(failed for failed, _ in each), sum(lost for _, lost in each)


def certified_share(
    on_box: DesignOnBox, plan: Plan, distribution: Mapping[str, str], seed: int,
    workers: Pool | None = None, options: ShareCertificateOptions = ShareCertificateOptions(),
) -> ShareCertificate:  # fmt: skip
    """Judge a design on fresh draws.

    Parameters
    ----------
    on_box : DesignOnBox
        The design at its θ.
    plan, distribution : Plan, mapping
        How many draws, and of what.
    seed : int
        Of the run.
    workers : Pool, optional
        The result is the same for any number.
    options : ShareCertificateOptions

    Returns
    -------
    ShareCertificate
    """
    rng = np.random.default_rng((seed, options.seed))
    fresh = drawn(on_box.uncertain, distribution, rng, plan.draws)
    size = options.batch
    tasks = {i: (on_box.kept, fresh[i : i + size]) for i in range(0, len(fresh), size)}
    counts = dict(results(workers, judged, tasks)).values()
    return ShareCertificate(plan, *(sum(each) for each in zip(*counts, strict=True)))
