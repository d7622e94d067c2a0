"""Time of one certified synthesis: control.mixsyn, a well-called SB10AD, and ours, in one run.

    OPENBLAS_NUM_THREADS=1 python benchmarks/synthesis.py

Every design is certified by the same kernel, `design.judge`. Times are CPU seconds of this
process on one core, the best of several, so that neighbours on the machine count little. SB10AD
is called well: job 1 from a finite γ, then job 4 at the backed-off γ; mixsyn as its users call it.
"""

import json
import os
import platform
import sys
import time
import warnings
from importlib.metadata import version
from pathlib import Path

import control
import numpy as np
import slycot
from problems import BACKOFF, HZ, OMEGA_LOW, Problem, stage, two_masses, weights

from ccd_casadi.inner_problem.search import search_inner
from ccd_casadi.inner_problem.sweep import InnerBounds
from ccd_casadi.kernels.certified_design import design, judge, sweep
from ccd_casadi.kernels.gamma import optimal_gamma
from ccd_casadi.kernels.generalized_plant import generalized_plant
from ccd_casadi.kernels.linear_algebra import stable_subspace
from ccd_casadi.kernels.riccati import RiccatiOptions, level_hamiltonian, lqr_hamiltonian
from ccd_casadi.kernels.sensitivity import Code, Column

RESULTS = Path(__file__).with_name("results.json")


def best(action, seconds: float, least: int = 3) -> float:
    """The least CPU time of `action` over some `seconds` of repetitions."""
    times, stop = [], time.perf_counter() + seconds
    action()
    while len(times) < least or time.perf_counter() < stop:
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return min(times)


def certify(problem: Problem, controller, gamma: float) -> str:
    """What the project's own certificate says of a controller at its γ."""
    plant, w = problem.plant, problem.weights.scale(problem.plant.omega_0)
    row = np.full(int(Column.COUNT), np.nan)
    Ak, Bk, Ck, Dk = (np.ascontiguousarray(matrix, float) for matrix in controller)
    low = OMEGA_LOW / plant.omega_0
    judge(plant.A, plant.B, plant.C, Ak, Bk, Ck, Dk, w, 0.0, gamma, low, row)
    return Code(int(row[Column.CODE])).name.lower()


def by_mixsyn(problem: Problem) -> tuple[float, str]:
    """Time and certificate of control.mixsyn; K at its own γ, as it hands it over."""
    plant = problem.plant
    M_S, A_S, omega_S, c_K, omega_K, A_l, A_u, omega_T = problem.weights.scale(plant.omega_0)
    p, m = plant.C.shape[0], plant.B.shape[1]

    def diagonal(num, den, count):
        return control.append(*[control.ss(control.tf(num, den))] * count)

    G = control.ss(plant.A, plant.B, plant.C, np.zeros((p, m)))
    w1 = diagonal([1 / M_S, omega_S], [1, omega_S * A_S], p)
    w2 = diagonal([c_K, c_K * omega_K], [1, c_K * omega_K], m)
    w3 = diagonal([1, omega_T / A_l], [A_u, omega_T], p)
    seconds = best(lambda: control.mixsyn(G, w1, w2, w3), 3.0)
    K, _, (gamma, _) = control.mixsyn(G, w1, w2, w3)
    return seconds, certify(problem, (K.A, K.B, K.C, K.D), BACKOFF * float(gamma))


def by_sb10ad(problem: Problem) -> tuple[float, str]:
    """Time and certificate of slycot's SB10AD: job 1 from γ = 1e3, then job 4 at 1.02·γ."""
    plant = problem.plant
    w = problem.weights.scale(plant.omega_0)
    A, B1, B2, C1, C2, d1, d2 = generalized_plant(plant.A, plant.B, plant.C, w)
    p, m = C2.shape[0], B2.shape[1]
    B, C = np.hstack([B1, B2]), np.vstack([C1, C2])
    D = np.zeros((C.shape[0], B.shape[1]))
    D[:p, :p], D[p : p + m, p:], D[2 * p + m :, :p] = d1 * np.eye(p), d2 * np.eye(m), np.eye(p)
    size = (A.shape[0], B.shape[1], C.shape[0], m, p)

    def run():
        gamma = slycot.sb10ad(*size, 1e3, A, B, C, D, job=1)[0]
        return slycot.sb10ad(*size, BACKOFF * gamma, A, B, C, D, job=4)[1:5], BACKOFF * gamma

    seconds = best(run, 3.0)
    controller, gamma = run()
    return seconds, certify(problem, controller, float(gamma))


def by_ours(problem: Problem) -> tuple[float, float, str]:
    """Time in a sweep and of a single cold design, certificate and figures included."""
    plant = problem.plant
    w = problem.weights.scale(plant.omega_0)
    low = OMEGA_LOW / plant.omega_0
    # around the problem's own break frequencies, as dense as the paper's 20 x 20 sweep
    omega_S = problem.weights.omega_S / plant.omega_0 * np.geomspace(0.5, 4.0, 20)
    omega_T = problem.weights.omega_T / plant.omega_0 * np.geomspace(0.2, 10.0, 20)
    if plant.A.shape[0] > 10:
        omega_S, omega_T = omega_S[4:12], omega_T[6:12]
    data = (plant.A, plant.B, plant.C, w)
    end = (plant.grid, plant.gain, BACKOFF, low)
    rows = sweep(*data, omega_S, omega_T, *end)
    swept = best(lambda: sweep(*data, omega_S, omega_T, *end), 5.0) / rows[..., 0].size
    single = best(lambda: design(*data, *end, 0.0), 2.0)
    bad = int((rows[..., Column.CODE] != 0).sum())
    verdict = "certified" if bad == 0 else f"{bad} of {rows[..., 0].size} refused"
    return swept, single, verdict


def floor(problem: Problem) -> float:
    """One ordered Schur form of the Hamiltonian: what every γ test has to do."""
    plant = problem.plant
    gp = generalized_plant(plant.A, plant.B, plant.C, problem.weights.scale(plant.omega_0))
    _, B1, _, C1, _, d1, _ = gp
    H0 = lqr_hamiltonian(gp)
    found = optimal_gamma(H0, B1, C1, d1, 0.5 * d1, 10.0, 1e-8, RiccatiOptions.noise)[0]
    H = level_hamiltonian(H0, B1, C1, d1, (BACKOFF * found) ** 2 - d1**2)
    count = 20 if len(plant.A) < 100 else 1
    return best(lambda: [stable_subspace(H) for _ in range(count)], 2.0) / count


def one_cold(problem: Problem) -> tuple[float, str]:
    """Time of a single design of a plant that is too large to be swept here, and its verdict."""
    plant = problem.plant
    data = (plant.A, plant.B, plant.C, problem.weights.scale(plant.omega_0), plant.grid)
    end = (plant.gain, BACKOFF, OMEGA_LOW / plant.omega_0, 0.0)
    row = design(*data, *end)[0]
    return best(lambda: design(*data, *end), 2.0), Code(int(row[Column.CODE])).name.lower()


def inner_optimum(problem: Problem) -> tuple[float, int]:
    """Time of one ω_b*(θ) by `search_inner`, and its syntheses."""
    box = InnerBounds(
        omega_S=(200 * HZ, 2000 * HZ), omega_T=(20 * HZ, 1000 * HZ), S_max=1.75, S_low=0.05,
        omega_low=OMEGA_LOW,
    )  # fmt: skip
    result = search_inner(problem.plant, problem.weights, box)
    seconds = best(lambda: search_inner(problem.plant, problem.weights, box), 3.0)
    return seconds, result.syntheses


def main() -> None:
    """Run everything, print the table, write results.json."""
    warnings.simplefilter("ignore")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    results: dict = {"machine": platform.processor() or platform.machine(), "versions": {
        name: version(name) for name in ("control", "slycot", "numpy", "scipy", "numba")
    }}  # fmt: skip
    results["versions"]["python"] = sys.version.split()[0]
    problems = (
        Problem("n7", two_masses(), weights(400.0, 100.0)),
        Problem("n35", stage(0), weights(400.0, 100.0)),
    )
    for problem in problems:
        name = problem.name
        mixsyn, mixsyn_verdict = by_mixsyn(problem)
        sb10ad, sb10ad_verdict = by_sb10ad(problem)
        swept, single, verdict = by_ours(problem)
        schur = floor(problem)
        print(f"{name}: {problem.plant.A.shape[0]} plant states, ms per synthesis")
        for method, seconds, said in (
            ("control.mixsyn", mixsyn, mixsyn_verdict),
            ("slycot sb10ad, jobs 1 and 4", sb10ad, sb10ad_verdict),
            ("ours, one design cold", single, verdict),
            ("ours, in a sweep", swept, verdict),
        ):
            print(f"  {method:28s}{1e3 * seconds:10.3f}{seconds / swept:9.1f} x  {said}")
        label, worth = "one ordered Schur form", schur / swept
        print(f"  {label:28s}{1e3 * schur:10.3f}{worth:9.2f} x  the floor of one γ test")
        results |= {
            f"ratio_mixsyn_{name}": mixsyn / swept, f"ratio_sb10ad_{name}": sb10ad / swept,
            f"ms_mixsyn_{name}": 1e3 * mixsyn, f"ms_sb10ad_{name}": 1e3 * sb10ad,
            f"ms_sweep_{name}": 1e3 * swept, f"ms_single_{name}": 1e3 * single,
            f"ms_schur_{name}": 1e3 * schur, f"schur_forms_worth_{name}": swept / schur,
            f"certified_{name}": {
                "mixsyn": mixsyn_verdict, "sb10ad": sb10ad_verdict, "ours": verdict,
            },
        }  # fmt: skip
    large = Problem("n200", stage(1, flexible=97), weights(400.0, 100.0))
    (seconds, verdict), schur = one_cold(large), floor(large)
    print(f"n200: one design cold {1e3 * seconds:.0f} ms, {verdict}; ", end="")
    print(f"{seconds / schur:.2f} ordered Schur forms' worth")
    results |= {
        "ms_single_n200": 1e3 * seconds, "ms_schur_n200": 1e3 * schur,
        "schur_forms_worth_n200": seconds / schur,
    }  # fmt: skip
    seconds, count = inner_optimum(problems[0])
    print(f"one ω_b*(θ) by search_inner: {1e3 * seconds:.1f} ms, {count} syntheses")
    results |= {"ms_inner_optimum": 1e3 * seconds, "syntheses_inner_optimum": count}
    known = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    print(f"{'':34s}{'now':>10s}{'last':>10s}")
    for key, value in results.items():
        if isinstance(value, float):
            last = known.get(key)
            print(f"  {key:32s}{value:10.4g}{'-' if last is None else format(last, '.4g'):>10s}")
    RESULTS.write_text(json.dumps(known | results, indent=2) + "\n")


if __name__ == "__main__":
    main()
