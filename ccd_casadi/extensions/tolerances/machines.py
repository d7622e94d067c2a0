"""Machines drawn from the distributions of their tolerances, and the certificate of their share.

A tolerance is "uniform" on its range, or "normal": each end of the range is `sigmas` standard
deviations from the model, on that side, and what is beyond is cut off. So the median is the model's
value wherever it lies in the range. The factor of damping is normal in its logarithm. Options of
the plant are alike often. Single modes are drawn independently of each other.

The certificate judges fresh draws that no search has seen: one count of a number of draws that is
fixed before, one-sided (Clopper and Pearson 1934). The share holds at its confidence where that
bound is at least the share. A machine whose evaluation raises or gives no number counts as failing.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from math import ceil, log, log1p
from typing import Any

import numpy as np
from scipy.special import bdtr, bdtrc, ndtr, ndtri

from ccd_casadi.analysis.yield_bound import yield_bound
from ccd_casadi.cases.tables import RobustTable
from ccd_casadi.codesign.reasons import Reason
from ccd_casadi.codesign.verdict import Check, State
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import Pool, results

Machine = tuple[int, Array]  # option, point of the box


@dataclass(frozen=True)
class MachineOptions:
    """Numbers of the draws."""

    sigmas: float = 3.0  # standard deviations from the model to an end of the range
    enough: float = 3.0  # fresh draws, over the least number that shows the share where none fails
    reliable: float = 0.999  # probability that the certificate accepts what a search ends with
    confirming: int = 6  # rounds of the certificate's draws that accept a design, at least
    most: int = 64  # the same at most
    attempts: int = 8  # designs of a search that such rounds may judge


def tolerance_of(name: str) -> str:
    """The tolerance of a parameter of the box; "mode_shift 3" has that of all, "mode_shift"."""
    return name.split(" ")[0]


def draw_machines(
    uncertain: UncertainPlant,
    distribution: Mapping[str, str],
    rng: np.random.Generator,
    number: int,
    options: MachineOptions = MachineOptions(),
) -> list[Machine]:
    """Draw options and points (n,) of the box; uniform where a tolerance has no distribution.

    From u, uniform on [0, 1], z = Φ⁻¹(c + u(1 - 2c))/sigmas, c = Φ(-sigmas), is normal and cut off
    at ±1, the ends of the range. It scales the distance from the model to the end on its side; of
    the factor of damping, its logarithm.
    """
    option = rng.integers(len(uncertain.options), size=number).tolist()
    u = rng.random((number, len(uncertain.names)))
    points, cut = np.empty_like(u), ndtr(-options.sigmas)
    ends = zip(uncertain.names, *uncertain.box, uncertain.nominal, strict=True)
    for k, (name, low, high, model) in enumerate(ends):
        if distribution.get(tolerance_of(name), "uniform") == "uniform":
            points[:, k] = low + u[:, k] * (high - low)
            continue
        z = ndtri(cut + u[:, k] * (1.0 - 2.0 * cut)) / options.sigmas
        if name == "damping":
            points[:, k] = model * np.where(z < 0.0, (low / model) ** -z, (high / model) ** z)
        else:
            points[:, k] = model + np.where(z < 0.0, z * (model - low), z * (high - model))
    return list(zip(option, points, strict=True))


@dataclass(frozen=True)
class Trial:
    """The test that accepts a design: `rounds` times the certificate's number of fresh draws, of
    which at most `allowed` fail in all."""

    rounds: int
    allowed: int


@dataclass(frozen=True)
class Plan:
    """The plan of draws that decide on a share at a confidence, and the test that accepts a design
    before."""

    share: float
    confidence: float
    options: MachineOptions = MachineOptions()

    @cached_property
    def draws(self) -> int:
        """Fresh draws of the certificate."""
        return ceil(self.options.enough * log1p(-self.confidence) / log(self.share))

    def bound_share(self, failed: int) -> float:
        """The share of all machines that is shown to keep the bounds if `failed` draws do not."""
        return yield_bound(self.draws - failed, self.draws, self.confidence)

    @cached_property
    def allowed(self) -> int:
        """The most of the certificate's draws that may fail."""
        return next(m for m in count() if self.bound_share(m + 1) < self.share)

    @cached_property
    def trial(self) -> Trial:
        """The test that accepts a design: at most c failures in r fresh rounds of n = `draws` each.

        Of a design of which a share q fails, whatever q is,

            accepted            A(q) = P(Bin(r n, q) <= c)
            then refused        B(q) = P(Bin(n, q) > allowed), by draws independent of these
            both                A(q) B(q) <= s = max over q of A B
            any of `attempts`   at most attempts s <= 1 - reliable, by the sum

        c is the largest that keeps this, for the least r from `confirming` on that has one; the
        largest A B is taken over a grid of q about 1 - share. Failures are counted anew for each
        design: no design is accepted by draws that made it.
        """
        q = np.minimum((1.0 - self.share) * np.geomspace(1e-3, 1e2, 2000), 1.0)
        refused = self.options.attempts * bdtrc(self.allowed, self.draws, q)
        for rounds in range(self.options.confirming, self.options.most + 1):
            risk = [float((bdtr(c, rounds * self.draws, q) * refused).max())
                    for c in range(self.allowed * rounds)]  # fmt: skip
            good = sum(each <= 1.0 - self.options.reliable for each in risk)
            if good:
                return Trial(rounds, good - 1)
        words = "has no count of draws that accepts a design; give a share of 0.8 to 0.9999"
        at = f"robust.share: {self.share!r} at a confidence of {self.confidence:g}"
        raise UserError(f"{at} {words}, and a confidence of 0.5 to 0.999")


@dataclass(frozen=True)
class ShareCertificateOptions:
    """Numbers of the certificate."""

    batch: int = 250  # machines that are judged at once
    seed: int = 5000  # beside the run's: no search draws with it


@dataclass(frozen=True)
class ShareCertificate:
    """The share of fresh machines that keep every bound."""

    plan: Plan  # the share, its confidence, and the number of draws
    failed: int  # of these
    not_evaluated: int = 0  # of those that failed: where the evaluation raised

    @property
    def least(self) -> float:
        """The share of all machines that is shown, at the confidence."""
        return self.plan.bound_share(self.failed)

    @property
    def passed(self) -> bool:
        """Whether the share that is shown is at least that which is required."""
        return self.least >= self.plan.share

    @property
    def line(self) -> Check:
        """The line of the verdict. It says nothing of the whole box."""
        plan, state = self.plan, State.PASSED if self.passed else State.FAILED
        claim = RobustTable(share=plan.share, confidence=plan.confidence).share_words
        shown = (Reason.SHARE_SHOWN if self.passed else Reason.SHARE_NOT_SHOWN)(claim=claim)
        found = (shown, Reason.SHARE_LEAST(), Reason.MAY_FAIL(), Reason.BOX_NOT_JUDGED())
        return Check("survives", state, found, self.entry)

    @property
    def entry(self) -> dict[str, Any]:
        """The figures for tolerances.json."""
        plan = self.plan
        return {
            "share": plan.share, "confidence": plan.confidence, "draws": plan.draws,
            "failed": self.failed, "not_evaluated": self.not_evaluated, "allowed": plan.allowed,
            "least": self.least,
        }  # fmt: skip


Judge = Callable[[list[Machine]], list[bool]]  # which machines keep every bound


def count_failures(judge: Judge, machines: list[Machine]) -> tuple[int, int]:
    """Count failing machines, and how many of these could not be evaluated."""
    try:
        return sum(not kept for kept in judge(machines)), 0
    except Exception:  # a plant function may raise anything: each by itself, to find which
        if len(machines) == 1:
            return 1, 1
    each = [count_failures(judge, [one]) for one in machines]
    return sum(failed for failed, _ in each), sum(lost for _, lost in each)


def certified_share(
    on_box: DesignOnBox, plan: Plan, distribution: Mapping[str, str], seed: int,
    workers: Pool | None = None, options: ShareCertificateOptions = ShareCertificateOptions(),
) -> ShareCertificate:  # fmt: skip
    """Judge a design at its θ on fresh draws; the result is the same for any number of workers."""
    rng = np.random.default_rng((seed, options.seed))
    fresh = draw_machines(on_box.uncertain, distribution, rng, plan.draws)
    size = options.batch
    tasks = {i: (on_box.find_kept, fresh[i : i + size]) for i in range(0, len(fresh), size)}
    counts = dict(results(workers, count_failures, tasks)).values()
    return ShareCertificate(plan, *(sum(each) for each in zip(*counts, strict=True)))
