"""The PID rule of Delissen, van Keulen and Langelaar (2023) beside a free PID, on guided beams.

    python benchmarks/oracle.py guided_beam [GUIDE_MM TIP_MM]... [--grid N]

Their controller has one parameter, the bandwidth w (rad/s) that is wished for, with the mass m:

    K(s) = 1.1 m w³ (s + w/3)(s + w/5) 15 / (s (s + 3w)(s + 5w)),    |K(jw)| = 1.1 m w²

w is raised here until the loop is unstable or |1 + L| < 0.5. Ours has the same structure, its five
parameters free. Both are judged alike, by eigenvalues and |S| on a dense grid; ω_b is the first -3
dB of S. `--grid` asks instead for ω_b* on N x N pairs of heights, as the co-design does: the five
best of those that the volume allows.
"""

import argparse
import sys
from itertools import product
from pathlib import Path

import numpy as np
from scipy.signal import tf2ss

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.inner_problem.problem import box, plant_of, scaled_plant
from ccd_casadi.inner_problem.structured_bandwidth import structured_value
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.inner_problem.structured_search import prepare_search, with_range
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.plant import constraint_values

CASE = Path(__file__).resolve().parents[2] / "examples" / "guided_beam" / "case.toml"
HZ = 2.0 * np.pi
BEAMS = ((0.03, 0.03), (0.045, 0.015), (0.055, 0.005))  # the co-design ends at the last


def judged(G: StateSpace, K: StateSpace) -> tuple[bool, float, float]:
    """Stable or not, the peak of |S| and its first -3 dB in Hz."""
    A = np.block([[G.A - G.B @ K.D @ G.C, G.B @ K.C], [-K.B @ G.C, K.A]])
    poles = np.linalg.eigvals(A)
    near = np.abs(poles.imag)[:, None] + np.abs(poles.real)[:, None] * np.linspace(-3.0, 3.0, 31)
    omega = np.concatenate([HZ * np.geomspace(0.1, 1e6, 20000), near.ravel()])
    omega = np.unique(omega[omega > HZ * 0.1])
    S = np.abs(1.0 / (1.0 + response(G, omega) * response(K, omega)))
    over = int(np.argmax(S * np.sqrt(2.0) > 1.0))
    first = np.interp(np.sqrt(0.5), S[over - 1 : over + 1], omega[over - 1 : over + 1])
    return bool((poles.real < 0.0).all()), float(S.max()), float(first) / HZ


def response(system: StateSpace, omega: np.ndarray) -> np.ndarray:
    """C (jω - A)⁻¹ B + D; a controller's poles may be equal, those of the beam's modes are not."""
    if len(system.A) <= 3:
        shifted = 1j * omega[:, None, None] * np.eye(len(system.A)) - system.A
        return (system.C @ np.linalg.solve(shifted, system.B + 0j))[:, 0, 0] + system.D[0, 0]
    values, V = np.linalg.eig(system.A)
    terms = (system.C @ V)[0] * np.linalg.solve(V, system.B + 0j)[:, 0]
    return (terms / (1j * omega[:, None] - values)).sum(1) + system.D[0, 0]


def their_pid(w: float, mass: float) -> StateSpace:
    """Their controller with the wished bandwidth w in rad/s."""
    above = 1.1 * mass * w**3 * np.polymul([3.0, w], [5.0, w])
    return StateSpace(*tf2ss(above, np.polymul([1.0, 3.0 * w, 0.0], [1.0, 5.0 * w])))


def global_check(count: int) -> None:
    """ω_b* on a grid over the box of both heights."""
    problem = prepare_search(problem_of(load_case(CASE)))[0]
    axes = [np.linspace(low, high, count) for low, high in zip(*box(problem), strict=True)]
    found = []
    for theta in product(*axes):
        if (constraint_values(plant_of(problem), theta) <= 1e-9).all():
            value = structured_value(problem, theta)
            found.append((value.bandwidth / HZ if value.feasible else 0.0, theta))
    print(f"{len(found)} beams, {sum(width == 0.0 for width, _ in found)} without a design")
    for width, (guide, tip) in sorted(found, reverse=True)[:5]:
        print(f"{1e3 * guide:8.2f} {1e3 * tip:7.2f} {width:9.2f} Hz")


def main(beams: list[tuple[float, float]]) -> None:
    problem = with_range(problem_of(load_case(CASE)))  # of K's roots, as the co-design has it
    frequencies = structured_of(problem).frequencies
    print(
        "guide mm  tip mm   mass kg   |  rule: w Hz    -3 dB Hz  max|S| | free PID: -3 dB  max|S|"
    )
    rows = []
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
        made = synthesise_sections(
            [plant], structure_of(problem), bounds_of(problem), seed=0, frequencies=frequencies
        )
        assert made.controller is not None
        stable, own_peak, own_width = judged(G, made.controller)
        assert stable
        print(f"{1e3 * guide:8.1f} {1e3 * tip:7.1f} {mass:9.2f}   | {low / HZ:12.2f} {width:10.2f} "
              f"{peak:8.4f} | {own_width:18.2f} {own_peak:8.4f}", flush=True)  # fmt: skip
        what = f"{1e3 * guide:.0f}, {1e3 * tip:.0f} mm: -3 dB of S at \\|1 + L\\| >= 0.5"
        rows.append([what, f"{width:.1f} Hz (their PID's rule)", f"{own_width:.1f} Hz"])
    sys.path.append(str(CASE.parents[2] / "benchmarks"))
    from peer_table import keep

    keep("guided beam", rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("heights", type=float, nargs="*", metavar="MM")
    parser.add_argument("--grid", type=int, metavar="N")
    given = parser.parse_args()
    mm = [1e-3 * height for height in given.heights]
    if given.grid:
        global_check(given.grid)
    else:
        main(list(zip(mm[::2], mm[1::2], strict=True)) or list(BEAMS))
