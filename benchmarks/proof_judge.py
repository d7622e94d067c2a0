"""The proof for the rib stage's controller, and what other code says of it.

    python benchmarks/proof_judge.py [--draws N] [--climbs N] [--option I] [--mutants] [--bare]
        [--most N]

The design is that of runs/rib_stage_built.toml. `prove` is required to show stability and |S|,
|KS|, |T| and |GS| within 1.05 of their bounds (`--bare`: |S| alone) on the box of every option:
each flexible mode ±2 % by itself, damping × 0.5 to 2, up to 25 parameters. Then NumPy alone (its
own hold and delay of each mode, K by Tustin's rule) looks for the largest figures in random
plants, half of them corners, and climbs from the worst ones parameter by parameter. `--mutants`:
plants that are not those of the proof, none of which may be proven: a twentieth of the damping,
modes that move by ±20 %, a gain by ±60 %, a drive turned over.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np
import rib_stage_built as built

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_files import sections_kappa
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import BoxProofOptions, prove
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, structure_of, uncertain_plant
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.plants.modal import modal_plant

CASE = Path(__file__).parent.parent / "runs" / "rib_stage_built.toml"
HZ = 2.0 * np.pi
T = 1.0 / built.RATE
MOST = 700_000  # enclosures for each option
GRID = np.unique(np.concatenate([np.geomspace(0.5, 6200.0, 150), np.linspace(60.0, 1000.0, 180)]))


def held(omega: np.ndarray, zeta: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(draws, modes, frequencies): 1/(s² + 2ζωs + ω²) behind a hold, and one sample late."""
    p = omega * (-zeta + 1j * np.sqrt(1.0 - zeta**2))
    total = 0.0
    for pole in (p, p.conj()):
        residue = 1.0 / (pole - (p.conj() if pole is p else p))
        step = np.expm1(pole * T) / pole * residue
        total = total + step[..., None] / (z - np.exp(pole * T)[..., None])
    return total / z


def free(omega: np.ndarray, zeta: np.ndarray, s: np.ndarray) -> np.ndarray:
    """The same without hold and delay, at s = jω."""
    w, z = omega[..., None], zeta[..., None]
    return 1.0 / (s**2 + 2.0 * z * w * s + w**2)


class Judge:
    """|S|, |KS|, |T|, |GS| over their bounds, of one option's plants."""

    def __init__(self, uncertain: UncertainPlant, bounds: Bounds) -> None:
        modal = modal_plant(uncertain.options[0], uncertain.suspension)
        self.omega, self.rigid, self.B, self.C = modal.natural, modal.rigid, modal.B, modal.C.T
        self.soft = uncertain.suspension
        K = built.controller(built.DESIGN)
        self.z = np.exp(1j * HZ * GRID * T)
        K = K.C @ np.linalg.solve(self.z[:, None, None] * np.eye(len(K.A)) - K.A, K.B + 0j) + K.D
        # matrices c bᵀK of every mode at every frequency
        self.each = np.einsum("ip,im,fmq->ifpq", self.C, self.B, K)
        self.K, self.box = K, uncertain.box
        assert bounds.weights is not None
        assert bounds.weighted_level is not None
        assert bounds.compliance_max is not None
        _, W_KS, W_T = np.abs(bounds.weights.responses(HZ * GRID)) / bounds.weighted_level
        self.over = (1.0 / bounds.S_max, W_KS, W_T, 1.0 / bounds.compliance_max)

    def figures(self, points: np.ndarray) -> np.ndarray:
        """The largest of each on the grid of plants (draws, n), over its bound (draws, 4)."""
        shift = np.zeros((len(points), len(self.omega)))
        flexible = np.flatnonzero(~self.rigid)
        shift[:, flexible] = points[:, : len(flexible)]
        omega = np.where(self.rigid, HZ * self.soft.frequency_hz, self.omega * (1.0 + shift))
        zeta = np.where(self.rigid, self.soft.damping_ratio, 0.01 * points[:, -1:])
        L = np.einsum("dif,ifpq->dfpq", held(omega, zeta, self.z), self.each, optimize=True)
        S = np.linalg.inv(np.eye(4) + L)
        G = np.einsum("dif,ip,im->dfpm", free(omega, zeta, 1j * HZ * GRID), self.C, self.B)
        parts = (S, self.K @ S, np.eye(4) - S, S @ G)
        sizes = [np.linalg.svd(part, compute_uv=False)[..., 0] for part in parts]
        return np.stack([(own * w).max(axis=1) for own, w in zip(sizes, self.over, strict=True)], 1)

    def peaks(self, points: np.ndarray) -> np.ndarray:
        """The largest of them (draws,)."""
        return self.figures(points).max(axis=1)

    def drawn(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Half at random corners, half within the box."""
        share = rng.random((count, self.box.shape[1]))
        share[::2] = np.round(share[::2])
        return np.asarray(self.box[0] + share * (self.box[1] - self.box[0]))

    def climbed(self, point: np.ndarray) -> float:
        """Coordinate by coordinate to the better end or the middle, until none helps."""
        best = float(self.peaks(point[None])[0])
        while True:
            before = best
            for i in range(len(point)):
                tries = np.tile(point, (3, 1))
                tries[:, i] = self.box[0, i], self.box[:, i].mean(), self.box[1, i]
                found = self.peaks(tries)
                if found.max() > best:
                    best, point = float(found.max()), tries[found.argmax()]
            if best <= before * (1.0 + 1e-6):
                return best


def mutants(u: UncertainPlant) -> dict[str, UncertainPlant]:
    """Boxes in which plants exceed the bound by far."""
    option = u.options[0]
    found = {
        "damping from 0.05 on": replace(u, damping=(0.05, 2.0)),
        "every mode ±20 %": replace(u, mode_shift=0.2),
        "gain ±60 %": replace(u, gain=0.6),
    }
    B = option.B.copy()
    B[:, 0] *= -0.2
    return found | {"a drive turned over": replace(u, options=(replace(option, B=B),))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=10_000)
    parser.add_argument("--climbs", type=int, default=5)
    parser.add_argument("--option", type=int)
    parser.add_argument("--mutants", action="store_true")
    parser.add_argument("--bare", action="store_true", help="prove |S| alone")
    parser.add_argument("--most", type=int, default=MOST, help="enclosures for each option")
    given = parser.parse_args()
    problem = problem_of(load_case(CASE))
    whole = uncertain_plant(problem, tuple(built.theta_of(built.DESIGN)))
    structure, sampling = structure_of(problem), structured_of(problem).sampling
    kappa = np.array(sections_kappa(built.DESIGN, structure))
    bounds = replace(bounds_of(problem), shape=None)
    required = replace(bounds, weighted_level=None, compliance_max=None) if given.bare else bounds
    bandwidth = 60.0 * HZ
    rng = np.random.default_rng(0)
    for option in range(len(whole.options)) if given.option is None else [given.option]:
        one = replace(whole, options=(whole.options[option],))
        if given.mutants:
            for name, box in mutants(one).items():
                proof = prove(
                    box, structure, kappa, bandwidth, required, sampling, most_boxes=60_000
                )
                print(f"option {option}, {name}: {proof.outcome.value}", flush=True)
            continue
        began = process_time()
        proof = prove(one, structure, kappa, bandwidth, required, sampling, most_boxes=given.most)
        print(f"option {option}: {proof.words}; {len(proof.parameters)} parameters, "
              f"{process_time() - began:.0f} s of a processor; "
              f"{ {name: round(value, 4) for name, value in proof.levels.items()} }",
              flush=True)  # fmt: skip
        if not given.draws:
            continue
        judge, top = Judge(one, bounds), []
        for _ in range(0, given.draws, 50):
            points = judge.drawn(50, rng)
            top += list(zip(judge.peaks(points).tolist(), points, strict=True))
        top.sort(key=lambda item: -item[0])
        climbed = max([judge.climbed(point) for _, point in top[: given.climbs]], default=np.nan)
        limit = 1.0 + BoxProofOptions.slack_of_many
        refuted = sum(value > limit for value, _ in top) + (climbed > limit)
        print(f"option {option}: a figure of {len(top)} draws is {top[0][0]:.4f} of its bound at "
              f"most, of climbs {climbed:.4f}, proven {limit:.4f}: {refuted} refute it",
              flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
