"""The PID rule of Delissen, van Keulen and Langelaar (2023) beside a free PID, on guided beams.

    python benchmarks/guided_beam.py [GUIDE_MM TIP_MM]...

Their controller has one parameter, the bandwidth w (rad/s) that is wished for, with the mass m:

    K(s) = 1.1 m w³ (s + w/3)(s + w/5) 15 / (s (s + 3w)(s + 5w)),    |K(jw)| = 1.1 m w²

w is raised here until the loop is unstable or |1 + L| < 0.5. Ours has the same structure, its five
parameters free. Both are judged alike, by eigenvalues and |S| on a dense grid; ω_b is the first -3
dB of S.
"""

import sys
from pathlib import Path

import numpy as np
from scipy.signal import tf2ss

from ccd_casadi.cases.case import load_case, problem_of
from ccd_casadi.fixed_structure import synthesise_sections
from ccd_casadi.inner_problem.problem import scaled_plant
from ccd_casadi.inner_problem.sections_plant_set import bounds_of, structure_of
from ccd_casadi.plants.scaling import StateSpace

CASE = Path(__file__).resolve().parent.parent / "examples" / "guided_beam" / "case.toml"
HZ = 2.0 * np.pi
BEAMS = ((0.03, 0.03), (0.045, 0.015), (0.055, 0.005))


def judged(G: StateSpace, K: StateSpace) -> tuple[bool, float, float]:
    """Stable or not, the peak of |S| and its first -3 dB in Hz."""
    A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    poles = np.linalg.eigvals(A)
    near = np.abs(poles.imag)[:, None] + np.abs(poles.real)[:, None] * np.linspace(-3.0, 3.0, 31)
    omega = np.concatenate([HZ * np.geomspace(0.1, 1e6, 20000), near.ravel()])
    omega = np.unique(omega[omega > HZ * 0.1])
    S = np.abs(1.0 / (1.0 + response(G, omega) * response(K, omega)))
    over = omega[np.argmax(S * np.sqrt(2.0) > 1.0)]
    return bool((poles.real < 0.0).all()), float(S.max()), float(over) / HZ


def response(system: StateSpace, omega: np.ndarray) -> np.ndarray:
    values, V = np.linalg.eig(system.A)
    terms = (system.C @ V)[0] * np.linalg.solve(V, system.B + 0j)[:, 0]
    return (terms / (1j * omega[:, None] - values)).sum(1) + system.D[0, 0]


def their_pid(w: float, mass: float) -> StateSpace:
    """Their controller with the wished bandwidth w in rad/s."""
    above = 1.1 * mass * w**3 * np.polymul([3.0, w], [5.0, w])
    return StateSpace(*tf2ss(above, np.polymul([1.0, 3.0 * w, 0.0], [1.0, 5.0 * w])))


def main(beams: list[tuple[float, float]]) -> None:
    problem = problem_of(load_case(CASE))
    print(
        "guide mm  tip mm   mass kg   |  rule: w Hz    -3 dB Hz  max|S| | free PID: -3 dB  max|S|"
    )
    for guide, tip in beams:
        plant = scaled_plant(problem, (guide, tip))
        G, mass = plant.plant_si(), 2700.0 * 0.3 * 0.3 * 0.5 * (guide + tip)

        def fits(w: float, G: StateSpace = G, mass: float = mass) -> bool:
            stable, peak, _ = judged(G, their_pid(w, mass))
            return stable and peak <= 2.0

        tried = HZ * np.geomspace(1.0, 2000.0, 80)
        fit = np.array([fits(w) for w in tried])
        if not fit.any():
            print(f"{1e3 * guide:8.1f} {1e3 * tip:7.1f}: the rule does not keep |1 + L| >= 0.5")
            continue
        last = int(np.argmax(np.append(~fit[np.argmax(fit) :], True))) + int(np.argmax(fit)) - 1
        low, high = tried[last], tried[min(last + 1, len(tried) - 1)]
        for _ in range(30):
            middle = np.sqrt(low * high)
            low, high = (middle, high) if fits(middle) else (low, middle)
        _, peak, width = judged(G, their_pid(low, mass))
        made = synthesise_sections([plant], structure_of(problem), bounds_of(problem), seed=0)
        assert made.controller is not None
        stable, own_peak, own_width = judged(G, made.controller)
        assert stable
        print(f"{1e3 * guide:8.1f} {1e3 * tip:7.1f} {mass:9.2f}   | {low / HZ:12.2f} {width:10.2f} "
              f"{peak:8.4f} | {own_width:18.2f} {own_peak:8.4f}", flush=True)  # fmt: skip


if __name__ == "__main__":
    given = [1e-3 * float(x) for x in sys.argv[1:]]
    main(list(zip(given[::2], given[1::2], strict=True)) or list(BEAMS))
