"""What a force does to the stage, for each kind of controller at the same θ.

    OPENBLAS_NUM_THREADS=1 nice python benchmarks/compliance.py [--sections] [--disturbance 1 10]

Case study 1 and the tutorial's stage, each with the model alone and with its resonances 3 % lower
or higher: the inner optimum, |GS(0)| on the suspended plant, the largest |GS|, and the RMS
position under white force of 1 N²/Hz (two-sided), ∫|GS|² dω/2π by a Lyapunov equation; on the
model, and the largest RMS of both ends of the set.

With `--sections` a PID, sections of two biquads, the same with a bound on |GS|, and the same for
the least RMS error at no less robust bandwidth than the first kind has.
"""

import argparse
import re
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, best_choice, scaled_plant
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_problem import StructuredProblem
from ccd_casadi.inner_problem.structured_search import least_from, prepared
from ccd_casadi.lti.closed_loop import closed_loop
from ccd_casadi.lti.state_space import StateSpace, balanced
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.statics import compliance_of
from ccd_casadi.synthesis.synthesis import synthesise

ROOT = Path(__file__).parent.parent
ROBUST = "\n[robust]\nresonance_shift = 0.03\n"
BLOCK = re.compile(r"^```\w+ title=\"(my_\w+\.\w+)\"\n(.*?)^```$", re.MULTILINE | re.DOTALL)


# Two-sided 1 N²/Hz; sections of either case: γ of its own full-order optimum as the level
BUDGET = '\n[budget.force]\nunit = "N^2/Hz"\nlevel = 2.0\n'
LEVELS = {"case study 1": 8.426, "tutorial": 16.6}
SECTIONS = """
[controller]
structure = "sections"
biquads = {biquads}
least_damping = {damping}
weighted_level = {level}
"""


def rms(plant: ScaledPlant, K: StateSpace) -> float:
    """Of the position under white force; infinite where the loop is not stable."""
    loop = closed_loop(plant.plant_si(), K).GS
    A, B, C = balanced(loop.A, loop.B, loop.C)
    if not np.linalg.eigvals(A).real.max() < 0.0:
        return np.inf
    P = solve_continuous_lyapunov(A, -B @ B.T)
    return float(np.sqrt(np.trace(C @ P @ C.T)))


def figures(problem: CoDesignProblem, theta: tuple[float, ...], K: StateSpace) -> str:
    """|GS(0)|, max |GS| and the RMS position of white force, and the largest RMS of the set."""
    plain = scaled_plant(replace(problem, robust=None), theta)
    loop = closed_loop(plain.plant_si(), K).GS
    static = np.linalg.norm(loop.C @ np.linalg.solve(loop.A, loop.B), 2)
    if isinstance(problem.controller, StructuredProblem):
        uncertain = uncertain_plant(problem, theta)
        others = uncertain.plants(uncertain.corners())
    else:
        family = scaled_plant(problem, theta).family
        others = list(family.perturbed) if family else []
    largest = max([rms(plant, K) for plant in others] or [np.nan])
    most = compliance_of(plain, K).gain
    return f"{static:9.2e} | {most:9.2e} | {rms(plain, K):9.2e} | {largest:9.2e}"


def full_order(
    problem: CoDesignProblem, theta: tuple[float, ...]
) -> tuple[float, StateSpace | None]:
    """ω_b* in Hz and its controller; None where the box has none."""
    choice, found = best_choice(problem, theta)
    if found.optimum is None:
        least = min(row.sensitivity_peak for row in found.rows if row.certified)
        print(f"  none: the least peak of S is {least:.3f}")
        return np.nan, None
    at = found.optimum.figures
    made = synthesise(
        scaled_plant(choice, theta),
        choice.weights.at(at.omega_S, at.omega_T),
        omega_low=choice.inner.omega_low,
        gamma_backoff=choice.inner.gamma_backoff,
    )
    return at.bandwidth / HZ, made.controller


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sections", action="store_true", help="search sections too")
    parser.add_argument("--bound", type=float, default=1e-6, help="compliance_max, m/N")
    parser.add_argument("--only", default="", help='a case and a set, "tutorial, ±3 %%"')
    parser.add_argument("--disturbance", type=float, nargs="*", default=[1.0, 10.0, 20.0])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for page in ("tutorial.md", "mixed_sensitivity.md"):
            for name, text in BLOCK.findall((ROOT / "docs" / page).read_text()):
                (Path(folder) / name).write_text(text)
        stage = Path(folder) / "my_nominal.toml"
        cases = (
            ("case study 1", ROOT / "runs" / "two_mass.toml", (60.0, 60.0)),
            ("tutorial", stage, (19.0, 8.0)),
        )
        print("case | set | controller | ω_b Hz | GS(0) | max GS m/N | RMS m | of set | CPU s")
        draft = Path(folder) / "draft.toml"
        for title, path, theta in cases:
            for extra, words in (("", "model"), (ROBUST, "±3 %")):
                if options.only and options.only not in f"{title}, {words}":
                    continue

                def told(label: str, hz: float, K: StateSpace | None, problem: CoDesignProblem,
                         began: float, head: str = f"{title} | {words}",
                         theta: tuple[float, ...] = theta) -> None:  # fmt: skip
                    spent = f"{time.process_time() - began:.1f}"
                    found = "infeasible" if K is None else f"{hz:.2f} | " + figures(
                        problem, theta, K
                    )  # fmt: skip
                    print(f"{head} | {label} | {found} | {spent}", flush=True)

                first = np.nan
                for kind in ("h_infinity", "h_infinity_disturbance"):
                    tail = f'\n[controller]\nstructure = "{kind}"\n' + extra
                    draft.write_text(path.read_text() + tail)
                    problem = problem_of(load_case(draft))
                    levels = options.disturbance if problem.weights.disturbance else [0.0]
                    for level in levels:
                        weights = replace(
                            problem.weights, disturbance=level * problem.weights.M_K
                        )  # fmt: skip
                        asked = replace(problem, weights=weights)
                        began = time.process_time()
                        hz, K = full_order(asked, theta)
                        first = first if level else hz
                        told(f"{kind} {level:g} M_K" if level else kind, hz, K, asked, began)
                if not options.sections:
                    continue
                for label, biquads, damping, bound in (
                    ("PID", 0, 0.0, ""),
                    ("two biquads", 2, 0.05, ""),
                    ("two biquads, compliance_max", 2, 0.05, f"{options.bound:g}"),
                ):
                    text = path.read_text()
                    if bound:
                        text = text.replace("[inner]", f"[inner]\ncompliance_max = {bound}")
                    text += SECTIONS.format(biquads=biquads, damping=damping, level=LEVELS[title])
                    draft.write_text(text + extra + BUDGET)
                    problem = replace(problem_of(load_case(draft)), start=theta)
                    began = time.process_time()
                    ready, raced, _ = prepared(problem)
                    K = raced.controller if raced.certified else None
                    told(label, raced.bandwidth / HZ, K, ready, began)
                    if bound or K is None:
                        continue
                    # no less bandwidth than the first kind has, or half of one's own
                    least = min(HZ * first, raced.bandwidth) if biquads else 0.5 * raced.bandwidth
                    assert isinstance(ready.controller, StructuredProblem)
                    ready = replace(
                        ready, controller=replace(ready.controller, bandwidth_least=least)
                    )  # fmt: skip
                    began = time.process_time()
                    ready, made, _ = least_from(ready, theta, raced)
                    told(f"{label}, least RMS at {least / HZ:.1f} Hz and more",
                         made.bandwidth / HZ, made.controller, ready, began)  # fmt: skip


if __name__ == "__main__":
    main()
