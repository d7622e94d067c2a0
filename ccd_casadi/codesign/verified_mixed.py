"""A verified design with a mixed-sensitivity controller: its figures, checks and lines."""

from dataclasses import dataclass
from math import inf, isfinite
from typing import Any, ClassVar

from ccd_casadi.codesign.final_judgement import ReferenceCheck, RobustCheck
from ccd_casadi.codesign.reasons import Finding, Reason
from ccd_casadi.codesign.result_entries import mixed_dict
from ccd_casadi.codesign.verdict import Check, OwnSet, State
from ccd_casadi.codesign.verified import Verified
from ccd_casadi.inner_problem.objective import binding
from ccd_casadi.inner_problem.sweep import active_constraints
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.synthesis import Design


def set_findings(robust: RobustCheck) -> dict[str, Any]:
    """Arguments of `survives` for a set that was searched along its shift.

    Parameters
    ----------
    robust : RobustCheck
        The worst of the set.

    Returns
    -------
    dict
        `own` and `own_findings`.
    """
    own = OwnSet.KEPT if robust.passed else OwnSet.BROKEN
    why = Reason.SET_KEPT if robust.passed else Reason.SET_NOT_KEPT
    why = Reason.SET_UNSTABLE if robust.peak == inf else why
    at = {"shift": robust.at.shift, "damping": robust.at.damping}
    return {"own": own, "own_findings": (why(plants=robust.plants, peak=robust.peak, **at),)}


@dataclass(frozen=True, kw_only=True)
class VerifiedDesign(Verified):
    """The design of a run with its controller and every true figure.

    Attributes
    ----------
    x : (n_θ + 2,) array
        (θ, ln ω_S, ln ω_T), SI.
    design : Design
        Made anew, not from a store.
    references : tuple of ReferenceCheck
        On closer models of the plant.
    robust : RobustCheck or None
        All along the case's own set.
    """

    x: Array
    design: Design
    references: tuple[ReferenceCheck, ...] = ()
    robust: RobustCheck | None = None

    kkt_level: ClassVar[float] = 1e-4  # the polish reaches 1e-6

    @property
    def certified(self) -> bool:
        return self.design.figures.certified and bool(self.judgement.passed)

    @property
    def bandwidth(self) -> float:
        return self.design.figures.bandwidth

    @property
    def point(self) -> Array:
        return self.x

    @property
    def active(self) -> tuple[str, ...]:
        problem = self.problem
        ends = {f"{name} {end}" for name in problem.names for end in ("lower", "upper")}
        inner = active_constraints(problem.inner, self.design.figures)
        return (*filter(ends.__contains__, self.kkt.active), *inner, *binding(problem, self.theta))

    def figures(self) -> dict[str, Any]:
        return mixed_dict(self.problem, self.theta, self.design)

    def evidence(self, predicted: float) -> dict[str, Any]:
        free = self.design.figures
        found: dict[str, Any] = {
            "surrogate_bandwidth_hz": predicted / HZ,
            "without_suspension": {
                "stable": free.certificate.stable,
                "bandwidth_hz": free.bandwidth / HZ,
                "sensitivity_peak": free.sensitivity_peak,
            },
            "references": {
                check.name: {
                    "certified": check.certified,
                    "reason": check.outcome.value,
                    "stable": check.figures.certificate.stable,
                    "bandwidth_hz": check.figures.bandwidth / HZ,
                    "sensitivity_peak": check.figures.sensitivity_peak,
                    "gamma": check.figures.gamma,
                }
                for check in self.references
            },
            "gap": None,  # nothing bounds KS, and so no ω_b, but the weights that are searched
        }
        if self.robust is not None:
            found["robust"] = {
                "nominal_sensitivity_peak": self.robust.nominal,
                "stable": isfinite(self.robust.peak),
                "worst_sensitivity_peak": self.robust.peak,
                "worst_shift": self.robust.at.shift,
                "worst_damping": self.robust.at.damping,
                "plants": self.robust.plants,
                **({} if self.damping is None else self.damping.entry),
            }
        return found

    def checks(self) -> dict[str, bool]:
        found = {} if self.robust is None else {"robust": self.robust.passed}
        if self.references:
            stable = [check.figures.certificate.stable for check in self.references]
            found["closer_models"] = all(stable)
        return found

    def certified_line(self) -> Check:
        design, bounds = self.design.figures, self.problem.inner.bounds
        norm, norm_bound = design.certificate.norm, design.certificate.norm_bound
        figures = {"norm": norm, "norm_bound": norm_bound}
        figures["sensitivity_peak"] = design.sensitivity_peak
        found = [Reason.BOUNDS_MET()]
        if not design.certified:
            found = [Reason.NOT_CERTIFIED()]
        elif not self.feasible:
            found = [Reason.BOUND_NOT_MET(bounds=list(bounds))]
        if "compliance_max" in bounds:
            figures["compliance_max"] = design.compliance
            found.append(Reason.COMPLIANCE())
        good = design.certified and self.feasible
        state = State.PASSED if good else State.FAILED
        return Check("certified", state, (*found, Reason.NORM()), figures)

    def own_set(self) -> dict[str, Any]:
        found = [
            (check.name, check.figures.certificate.stable, check.figures.sensitivity_peak)
            for check in self.references
        ]
        return {"closer": found, **({} if self.robust is None else set_findings(self.robust))}

    def better(self) -> Finding:
        return Reason.WEIGHTS_BETTER()
