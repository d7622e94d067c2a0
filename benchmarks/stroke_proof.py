"""The gantry's stroke of 0.6 m: proven, and what other code says at 1,001 positions.

    python benchmarks/stroke_proof.py [--most N] [--positions N] [--mutants]

The design is benchmarks/gantry_design.json: its height, ω_b and the controller's parameters, as
`inner examples/gantry_stroke/case.toml --theta h=0.12` printed them. `prove` is required to show
every bound within 5 % at all positions and resonances ±2 %. NumPy and SciPy alone (Legendre
polynomials of the beam, hold and delay of each mode, K's matrices by Tustin's rule, poles of the
sampled loop) then compute every figure at so many positions, each with resonances at both ends, in
the middle and at random: none may exceed what is proven. `--mutants`: 10 % more gain, half the
damping, a carriage of 5 kg: where that code finds a bound exceeded by a hundredth, the proof must
refuse.
"""

import argparse
import json
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from time import process_time

import casadi as ca
import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import eigh, expm

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import SLACK_OF_MANY, prove
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of, uncertain_plant
from ccd_casadi.lti.state_space import StateSpace

HERE = Path(__file__).parent
CASE = HERE.parent / "examples" / "gantry_stroke" / "case.toml"
HZ = 2.0 * np.pi
GRID = np.unique(np.concatenate([np.geomspace(0.05, 3999.0, 1500), np.linspace(20.0, 600.0, 1500)]))
LENGTH, WIDTH, YOUNG, DENSITY, MOTOR, GUIDE = 0.9, 0.06, 69e9, 2700.0, 2.5, 5.0e6


def beam(h: float, wall: float) -> tuple[np.ndarray, np.ndarray]:
    """M and K without the carriage, of nine Legendre polynomials."""
    area = WIDTH * h - (WIDTH - 2 * wall) * (h - 2 * wall)
    bending = YOUNG * (WIDTH * h**3 - (WIDTH - 2 * wall) * (h - 2 * wall) ** 3) / 12.0
    z, weight = legendre.leggauss(9)
    P, ends = legendre.legvander(z, 8), legendre.legvander([-1.0, 1.0], 8)
    bent = np.stack([legendre.legval(z, legendre.legder(row, 2)) for row in np.eye(9)], 1)
    M = DENSITY * area * LENGTH / 2.0 * P.T @ (weight[:, None] * P) + MOTOR * ends.T @ ends
    K = bending * (2.0 / LENGTH) ** 3 * bent.T @ (weight[:, None] * bent)
    K[1, 1] += GUIDE * (2.0 / LENGTH) ** 2
    return M, K


class Judge:
    """Figures over their bounds of one controller on the beam, by other code than the package's."""

    def __init__(self, K: StateSpace, bounds: Bounds, band: float, damping: float, carriage: float):
        case = tomllib.loads(CASE.read_text())
        self.T, self.bounds, self.band = 1.0 / case["loop"]["rate_hz"], bounds, band
        self.damping, self.carriage = damping, carriage
        self.M, self.stiffness = beam(0.12, case["theta"]["wall"]["fixed"])
        eye, step = np.eye(len(K.A)), 2.0 / self.T
        inverse = np.linalg.inv(step * eye - K.A)
        self.Ad, self.C = inverse @ (step * eye + K.A), K.C
        self.Bd, self.D = (eye + self.Ad) @ inverse @ K.B, K.D + K.C @ inverse @ K.B
        self.z, omega = np.exp(1j * HZ * GRID * self.T), HZ * GRID
        states = np.linalg.solve(self.z[:, None, None] * eye - self.Ad, self.Bd + 0j)
        self.K = (self.C @ states + self.D)[:, 0, 0]
        weights = np.abs(bounds.weights.responses(omega)) / bounds.weighted_level
        below = omega <= band
        shape = 0.5**0.5 / band * np.maximum(omega, bounds.omega_low)  # no room below ω_b
        self.over = {"S_MAX": 1.0 / bounds.S_max, "LEVEL": below * 2.0**0.5, "SHAPE": below / shape}
        self.W_KS, self.W_T = weights[1], weights[2]

    def figures(self, at: float, shift: float) -> dict[str, float]:
        """Each over its bound, and the largest |z| of the loop's poles."""
        tool = legendre.legvander([2.0 * at / LENGTH], 8)[0]
        lam, shapes = eigh(self.stiffness, self.M + self.carriage * np.outer(tool, tool))
        force = 0.5 * legendre.legvander([-1.0, 1.0], 8).sum(axis=0)
        strength = (force @ shapes) * (tool @ shapes)
        omega = np.append(HZ * 0.1, np.sqrt(lam[1:]) * (1.0 + shift))
        zeta = np.append(0.7, np.full(len(lam) - 1, self.damping))
        n, z = 2 * len(lam), self.z
        A, B, C, G = np.zeros((n, n)), np.zeros(n), np.zeros(n), 0.0
        for i, (w, d, r) in enumerate(zip(omega, zeta, strength, strict=True)):
            a = np.array([[0.0, 1.0, 0.0], [-w * w, -2.0 * d * w, r], [0.0, 0.0, 0.0]])
            F, own = expm(a * self.T), slice(2 * i, 2 * i + 2)
            A[own, own], B[own], C[2 * i] = F[:2, :2], F[:2, 2], 1.0
            det = (z - F[0, 0]) * (z - F[1, 1]) - F[0, 1] * F[1, 0]
            G = G + ((z - F[1, 1]) * F[0, 2] + F[0, 1] * F[1, 2]) / det / z
        s, w = 2j * np.pi * GRID[:, None], omega
        free = (strength / (s * s + 2.0 * zeta * w * s + w * w)).sum(axis=1)
        k = len(self.Ad)
        loop = np.zeros((n + 1 + k, n + 1 + k))  # the modes, the force one sample late, K
        loop[:n, :n], loop[:n, n] = A, B
        loop[n, :n], loop[n, n + 1 :] = -self.D[0, 0] * C, self.C[0]
        loop[n + 1 :, :n], loop[n + 1 :, n + 1 :] = -self.Bd * C, self.Ad
        S, b = 1.0 / (1.0 + G * self.K), self.bounds
        return {name: float((np.abs(S) * over).max()) for name, over in self.over.items()} | {
            "S_LOW": float(np.interp(b.omega_low / HZ, GRID, np.abs(S)) / b.S_low),
            "KS": float((np.abs(self.K * S) * self.W_KS).max()),
            "T": float((np.abs(G * self.K * S) * self.W_T).max()),
            "GS": float(np.abs(free * S).max() / b.compliance_max),
            "|z|": float(np.abs(np.linalg.eigvals(loop)).max()),
        }

    def worst(self, positions: int) -> dict[str, tuple[float, float]]:
        """The largest of each, and where."""
        rng, found = np.random.default_rng(0), dict[str, tuple[float, float]]()
        for at in np.linspace(-0.3, 0.3, positions).tolist():
            for shift in (-0.02, 0.0, 0.02, rng.uniform(-0.02, 0.02)):
                for name, value in self.figures(at, shift).items():
                    found[name] = max(found.get(name, (0.0, 0.0)), (value, at))
        return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--most", type=int, help="enclosures")
    parser.add_argument("--positions", type=int, default=1001)
    parser.add_argument("--mutants", action="store_true")
    given = parser.parse_args()
    design, problem = (
        json.loads((HERE / "gantry_design.json").read_text()),
        problem_of(load_case(CASE)),
    )
    kappa = np.log([p["value"] * (HZ if p["unit"] == "Hz" else 1.0) for p in design["parameters"]])
    structure, bounds, band = structure_of(problem), bounds_of(problem), HZ * design["bandwidth_hz"]
    uncertain = uncertain_plant(problem, (design["h"],))
    graph, x = uncertain.graph(0), ca.SX.sym("x")
    M, *others = graph.call([x])
    heavier = ca.Function("heavier", [x], [M + others[3].T @ others[3], *others])
    softer = replace(uncertain.options[0], damping_ratio=0.005)
    cases = {"the design": (1.0, uncertain, 0.01, 4.0)}
    if given.mutants:
        cases = {
            "10 % more gain": (1.1, uncertain, 0.01, 4.0),
            "half the damping": (1.0, replace(uncertain, options=(softer,)), 0.005, 4.0),
            "a carriage of 5 kg": (1.0, replace(uncertain, graph=lambda _: heavier), 0.01, 5.0),
        }
    failed = 0
    for name, (gain, plant, damping, carriage) in cases.items():
        own = kappa.copy()
        own[0] += np.log(gain)
        start = process_time()
        proof = prove(plant, structure, own, band, bounds, problem.sampling, most_boxes=given.most)
        print(f"{name}: {proof.words}\n    {process_time() - start:.1f} s, {proof.boxes} boxes")
        judge = Judge(structure.state_space(own), bounds, band, damping, carriage)
        worst = judge.worst(given.positions)
        for figure, (value, at) in worst.items():
            level = proof.levels.get(figure, 1.0)
            print(f"    {figure:6} {value:.6f} at {at:+.4f} m, proven to {level:.6f}")
            failed += proof.stable and value > level * (1.0 + 1e-9)
        bad = any(value > 1.01 for value, _ in worst.values())
        close = proof.stable and max(proof.levels.values()) <= 1.0 + SLACK_OF_MANY
        failed += (bad and proof.proven) or (name == "the design" and not close)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
