"""What figures of one result.json deny each other: nothing, of any run."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from ccd_casadi.codesign.outer_mixed import VerifiedDesign
from ccd_casadi.codesign.verdict import VerdictOptions
from ccd_casadi.inner_problem.problem import CoDesignProblem, plant_of
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.inner_problem.structured_robustness import BoxCheckOptions

CLOSE, LEAST = 1e-6, VerdictOptions().least_shift


def contradictions(result: Mapping[str, Any], problem: CoDesignProblem) -> list[str]:
    """In words; empty where every figure agrees with every other."""
    if result["status"] == "infeasible":
        return [] if "verdict" not in result else ["infeasible, with a verdict"]
    return [words for holds, words in _claims(result, problem) if not holds]


def _claims(r: Mapping[str, Any], problem: CoDesignProblem) -> Iterator[tuple[bool, str]]:
    checks, lines = r["checks"], r["verdict"]
    failed = {name: line["state"] == "failed" for name, line in lines.items()}
    sections = isinstance(problem.controller, StructuredProblem)
    yield (r["status"] == "verified") == (False not in checks.values()), "status and checks"
    yield (r["status"] == "verified") == (not any(failed.values())), "status and lines"
    yield sum(r["spent"].values()) == r["syntheses"], "spent and syntheses"
    yield 0 <= r["syntheses_to_optimum"] <= r["syntheses"], "syntheses to the optimum"

    loose = 1.0 + BoxCheckOptions.looseness * sections
    certificate, S_max = r["certificate"], problem.inner.S_max * loose
    certain = checks["certificate"] and checks["constraints"]
    certain = certain and checks["second_engine"] is not False
    yield failed["certified"] == (not certain), "certified line and checks"
    if not failed["certified"]:
        yield certificate["passed"] and certificate["stable"], "certified, no certificate"
        yield certificate["max_real_pole"] < 0.0, "certified, a pole on the right"
        yield certificate["norm"] <= certificate["norm_bound"], "certified, above its bound"
        yield r["sensitivity_peak"] <= S_max * (1.0 + CLOSE), "certified, S above S_max"

    kkt = r["kkt"]["stationarity"]
    # None: a search that its time ended, of which nothing is known
    sure = checks["optimality"] is not False and checks["inner_optimum"] is not False
    yield failed["optimal"] == (not sure), "optimal line and checks"
    if not sections:
        stationary = kkt is not None and kkt <= VerifiedDesign.kkt_level
        yield checks["optimality"] == stationary, "optimal and kkt"
    yield lines["optimal"].get("kkt_residual") == kkt, "two residuals"
    yield failed["predicted"] == (checks["prediction"] is False), "predicted line and check"
    yield from _survives(r, problem, lines["survives"], failed["survives"])


def _survives(
    r: Mapping[str, Any], problem: CoDesignProblem, line: Mapping[str, Any], failed: bool
) -> Iterator[tuple[bool, str]]:
    kept = r["checks"].get("robust", True)
    if r["checks"].get("closer_models", True):
        yield failed == (not kept), "survives line and check"
    if "stable_shift" not in line:
        return
    stable, within = line["stable_shift"], line["S_max_shift"]
    yield stable[0] <= within[0] <= 0.0 <= within[1] <= stable[1], "within S_max, not stable"
    yield line["stable_damping"][0] <= 1.0 <= line["stable_damping"][1], "damping of the model"
    narrow = stable[0] > -LEAST or stable[1] < LEAST
    yield not (narrow and line["state"] == "passed"), "a narrow range passed"
    modulus, (down, up) = line["modulus_margin"], line["gain_margin"]
    if problem.robust is not None:
        reach, worst = problem.robust.shift, r["robust"]["worst_sensitivity_peak"]
        inside = within[0] <= -reach and reach <= within[1]
        yield kept <= inside, "the set is kept, the range ends in it"
        if not problem.robust.damping:
            yield inside <= kept, "the range holds the set, which is not kept"
        yield kept == (worst is not None and worst <= problem.inner.S_max * (1.0 + CLOSE)), "worst"
        whole = r["sensitivity_peak"]  # of the plants that the controller was designed on
        yield worst is None or worst >= whole * (1.0 - CLOSE), "the set's peak above the worst"
        yield whole * modulus >= 1.0 - CLOSE, "the model's peak above the set's"
        nominal = r["robust"]["nominal_sensitivity_peak"]
        yield abs(nominal * modulus - 1.0) <= CLOSE, "two peaks of S on the model"
    elif isinstance(problem.controller, StructuredProblem):
        u = problem.controller.uncertainty
        ends = [(1.0 + s * u.resonance_shift) * (1.0 + s * u.mode_shift) - 1.0 for s in (-1, 1)]
        yield kept <= (within[0] <= ends[0] and ends[1] <= within[1]), "the box is kept, not along"
        whole = line["worst_excess"] <= 5.1e-6  # 100 % in six digits
        yield whole or "within every bound" not in line["words"], "within bounds, one exceeded"
    else:
        yield abs(r["sensitivity_peak"] * modulus - 1.0) <= CLOSE, "two peaks of S on the model"
    if plant_of(problem).outputs == 1:  # |1 + L| >= the modulus margin
        phase = math.degrees(2.0 * math.asin(min(1.0, 0.5 * modulus)))
        phases = [item["phase_margin_deg"] for item in (line, r["verdict"]["deployable"])]
        yield phases[0] == phases[1], "two phase margins"
        yield phases[0] is None or phases[0] >= phase * (1.0 - CLOSE), "phase and modulus margin"
        yield up is None or up * (1.0 - modulus) >= 1.0 - CLOSE, "gain and modulus margin"
        yield down * (1.0 + modulus) <= 1.0 + CLOSE, "gain and modulus margin, down"
