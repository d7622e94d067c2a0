"""What a force does to the stage, for each kind of controller at the same θ.

    OPENBLAS_NUM_THREADS=1 nice python benchmarks/compliance.py [--sections] [--disturbance 1 10]

Case study 1 and the tutorial's stage, each with the model alone and with its resonances 3 % lower
or higher: the inner optimum, |GS(0)| on the suspended plant, the largest |GS|, and the RMS
position under white force of 1 N²/Hz (two-sided), ∫|GS|² dω/2π by a Lyapunov equation.
"""

import argparse
import re
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from ccd_casadi.cases.case import load_case, problem_of
from ccd_casadi.inner_problem.problem import CoDesignProblem, best_choice, scaled_plant
from ccd_casadi.inner_problem.sections_bandwidth import prepared
from ccd_casadi.plants.scaling import StateSpace, balanced
from ccd_casadi.support.units import HZ
from ccd_casadi.synthesis.norms import hinf_norm
from ccd_casadi.synthesis.synthesis import synthesise

ROOT = Path(__file__).parent.parent
ROBUST = "\n[robust]\nresonance_shift = 0.03\n"
BLOCK = re.compile(r"^```\w+ title=\"(my_stage\.\w+)\"\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def force_to_position(G: StateSpace, K: StateSpace) -> StateSpace:
    """GS of a strictly proper plant and a controller e to u, in balanced coordinates."""
    A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    B = np.vstack([G.B, np.zeros((len(K.A), G.B.shape[1]))])
    C = np.hstack([G.C, np.zeros((G.C.shape[0], len(K.A)))])
    return StateSpace(*balanced(A, B, C), np.zeros((C.shape[0], B.shape[1])))


def figures(problem: CoDesignProblem, theta: tuple[float, ...], K: StateSpace) -> str:
    """|GS(0)|, max |GS| and the RMS position of white force."""
    loop = force_to_position(scaled_plant(problem, theta).plant_si(), K)
    static = np.linalg.norm(loop.C @ np.linalg.solve(loop.A, loop.B), 2)
    P = solve_continuous_lyapunov(loop.A, -loop.B @ loop.B.T)
    rms = np.sqrt(np.trace(loop.C @ P @ loop.C.T))
    return f"{static:9.2e} | {hinf_norm(loop)[0]:9.2e} | {rms:9.2e}"


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
    parser.add_argument("--sections", action="store_true", help="a race of sections too")
    parser.add_argument("--disturbance", type=float, nargs="*", default=[1.0, 10.0, 20.0])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name, text in BLOCK.findall((ROOT / "docs" / "tutorial.md").read_text()):
            (Path(folder) / name).write_text(text)
        stage = Path(folder) / "my_stage.toml"
        cases = (
            ("case study 1", ROOT / "runs" / "two_mass.toml", (60.0, 60.0)),
            ("tutorial", stage, (19.0, 8.0)),
        )
        print("case | set | controller | ω_b Hz | GS(0) m/N | max GS m/N | RMS m | CPU s")
        for title, path, theta in cases:
            for extra, words in (("", "model"), (ROBUST, "±3 %")):
                draft = Path(folder) / "draft.toml"
                for kind in ("h_infinity", "h_infinity_disturbance", "sections"):
                    if kind == "sections" and not options.sections:
                        continue
                    tail = f'\n[controller]\nstructure = "{kind}"\n' + extra
                    draft.write_text(path.read_text() + tail)
                    problem = problem_of(load_case(draft))
                    levels = options.disturbance if problem.weights.disturbance else [0.0]
                    for level in levels:
                        weights = replace(
                            problem.weights, disturbance=level * problem.weights.M_K
                        )  # fmt: skip
                        began = time.process_time()
                        if kind == "sections":
                            raced = prepared(replace(problem, start=theta))[1]
                            hz, K = raced.bandwidth / HZ, raced.controller
                        else:
                            hz, K = full_order(replace(problem, weights=weights), theta)
                        label = f"{kind} {level:g} M_K" if level else kind
                        spent = time.process_time() - began
                        if K is None:
                            print(f"{title} | {words} | {label} | infeasible | {spent:.1f}")
                            continue
                        print(
                            f"{title} | {words} | {label} | {hz:.2f} | "
                            f"{figures(problem, theta, K)} | {spent:.1f}",
                            flush=True,
                        )


if __name__ == "__main__":
    main()
