"""Random problems of fixed structures: nothing certified that another judge refutes, none hangs.

    python benchmarks/random_sections.py [--problems N] [--first SEED] [--limit S] [--write]

Each seed makes a chain of masses, a structure, bounds, a box of uncertain parameters, continuous or
sampled, and asks `synthesise_robustly` for a controller. What comes back certified is judged with
NumPy alone: the plants' matrices from the chain, hold and delay by eigenvectors, K by Tustin's
rule, eigenvalues, S, KS, T and GS on dense grids through every pole and zero, on plants at the
corners and at random. What is proven must hold there too, and what is refuted must fail where it
says. `--write` keeps every seed's row in benchmarks/random_sections.json and goes on from there.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.fixed_structure import Bounds, Sampling, Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import synthesise_robustly
from ccd_casadi.plants.modal import Suspension
from ccd_casadi.plants.plant import build_plant, mechanics
from ccd_casadi.support.deadline import Overrun, Runner
from ccd_casadi.synthesis.weights import Weights

HZ = 2.0 * np.pi
RESULTS = Path(__file__).with_suffix(".json")
LIMIT = 600.0  # s of a problem: some of them take a minute of a busy machine
ALLOWED = 3e-4  # relative: by how much the synthesis says that a plant of the box may pass a bound
RANDOM_PLANTS = 6
COUNT = 12  # plants that the search for the worst starts from, and that its judge looks at


@dataclass(frozen=True)
class Case:
    """A random problem; the chain itself for the judge."""

    mass: np.ndarray
    stiffness: np.ndarray
    zeta: float
    sensor: int
    uncertain: UncertainPlant
    structure: Structure
    bounds: Bounds
    sampling: Sampling | None


def case(seed: int) -> Case:
    """The problem of a seed."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    mass = np.exp(rng.uniform(0.0, 4.0, n))
    modes_hz = np.exp(rng.uniform(np.log(30.0), np.log(500.0), n - 1))
    springs = (modes_hz * HZ) ** 2 * np.minimum(mass[:-1], mass[1:])
    K = np.zeros((n, n))
    for i, k in enumerate(springs):
        K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    zeta = float(np.exp(rng.uniform(np.log(0.002), np.log(0.05))))
    sensor = int(rng.integers(n))

    def chain(theta: dict[str, Any]) -> dict[str, Any]:
        return {
            "mass": ca.DM(np.diag(mass)),
            "stiffness": ca.DM(K),
            "damping_ratio": zeta,
            "input": ca.DM(np.eye(n)[:, :1]),
            "output": ca.DM(np.eye(n)[sensor : sensor + 1]),
            "hardware_cost": theta["a"],
        }

    M_K = float(mass.sum() * (60.0 * HZ) ** 2)
    box: dict[str, Any] = {}
    if n > 1 and rng.random() < 0.6:
        box["resonance_shift"] = float(rng.uniform(0.005, 0.05))
    if n > 1 and rng.random() < 0.4:
        box["damping"] = (float(rng.uniform(0.5, 1.0)), float(rng.uniform(1.0, 2.0)))
    if rng.random() < 0.4:
        box["gain"] = float(rng.uniform(0.01, 0.1))
    system = mechanics(build_plant(chain, ("a",), {}), (1.0,))
    uncertain = UncertainPlant((system,), Suspension(), M_K, **box)
    structure = Structure(
        bool(rng.random() < 0.8), int(rng.integers(3)), int(rng.integers(2)),
        int(rng.integers(4)), float(rng.choice([0.0, 0.05])),
    )  # fmt: skip
    weights = Weights(
        M_S=2.0, A_S=1e-4, omega_S=800.0 * HZ, c_K=1e4, omega_K=100.0 * HZ, M_K=M_K, A_l=1.0,
        A_u=1e-2, omega_T=25.0 * HZ,
    )  # fmt: skip
    level = float(rng.uniform(3.0, 20.0)) if rng.random() < 0.7 and structure.roll_off else None
    bounds = Bounds(
        S_max=float(rng.uniform(1.4, 2.5)), S_low=float(rng.uniform(0.02, 0.3)),
        omega_low=float(rng.uniform(0.3, 1.0)) * HZ,
        shape=float(rng.uniform(1.05, 1.6)) if rng.random() < 0.8 else None,
        weighted_level=level, weights=weights if level else None,
        compliance_max=float(np.exp(rng.uniform(2.0, 6.0))) / M_K if rng.random() < 0.4 else None,
    )  # fmt: skip
    sampling = None
    if rng.random() < 0.5:
        sampling = Sampling(float(rng.uniform(3e3, 2e4)), float(rng.choice([0.0, 80.0, 200.0])))
    return Case(mass, K, zeta, sensor, uncertain, structure, bounds, sampling)


def solved(seed: int) -> dict[str, Any]:
    """The synthesis of a seed and its judge, as a row."""
    asked = case(seed)
    begun = time.process_time()
    made = synthesise_robustly(
        asked.uncertain, asked.structure, asked.bounds, sampling=asked.sampling, starts=1,
        seed=seed, rounds=1, count=COUNT,
    )  # fmt: skip
    spent = time.process_time() - begun
    row: dict[str, Any] = {
        "outcome": made.design.outcome.name, "certified": made.certified, "seconds": spent,
        "parameters": len(asked.uncertain.names), "sampled": asked.sampling is not None,
    }  # fmt: skip
    proof = made.proof
    if proof is not None:
        row |= {"proof": proof.outcome.name, "boxes": proof.boxes}
    if made.certified and proof is not None and made.design.controller is not None:
        controller = made.design.controller
        K = (controller.A, controller.B, controller.C, controller.D)
        worst, words = 0.0, ""
        rng = np.random.default_rng(seed + 10**9)
        ends = asked.uncertain.box
        points = [point for _, point in asked.uncertain.corners()]
        points += [rng.uniform(ends[0], ends[1]) for _ in range(RANDOM_PLANTS)]
        for point in points:
            values = figures(asked, point, K, made.design.bandwidth)
            name = max(values, key=lambda key: values[key])
            if values[name] > worst:
                worst, words = values[name], name
        limit = 1.0 + (max(ALLOWED, proof.slack) if not proof.proven else proof.slack)
        row |= {"worst": worst, "bound": words, "refuted": not worst <= limit}
        if proof.refuted:
            there = figures(asked, np.array(proof.point), K, made.design.bandwidth)
            row["fails_there"] = max(there.values()) > 1.0 + 0.999 * proof.slack
    return row


def figures(
    asked: Case, point: np.ndarray, K: tuple[np.ndarray, ...], bandwidth: float
) -> dict[str, float]:
    """Every figure over its bound on one plant of the box; infinite where the loop is unstable."""
    A, b, c = chain_at(asked, point)
    poles, V = np.linalg.eig(A)
    left, right = np.linalg.solve(V, b + 0j), c @ V
    a, k_b, k_c, k_d = K[0], K[1][:, 0], K[2][0], float(K[3][0, 0])
    T = None if asked.sampling is None else asked.sampling.period
    if T is None:
        closed = np.block([[A - np.outer(b, c) * k_d, np.outer(b, k_c)], [-np.outer(k_b, c), a]])
        loop_poles = np.linalg.eigvals(closed)
        if not (loop_poles.real < 0.0).all():
            return {"stable": np.inf}
        top, roots = 1e3 * max(np.abs(poles).max(), np.abs(loop_poles).max()), loop_poles
    else:
        age = int(np.ceil(1e-6 * asked.sampling.delay_us / T - 1e-9))
        h = T * age - 1e-6 * asked.sampling.delay_us  # of the newest force in a period
        late = ((np.exp(poles * h) - 1.0) / poles * left) if h > 1e-12 else np.zeros_like(left)
        early = np.exp(poles * h) * (np.exp(poles * (T - h)) - 1.0) / poles * left
        n, m = len(A), len(a)
        Ad = (V * np.exp(poles * T)) @ np.linalg.inv(V)
        inverse = np.linalg.inv(np.eye(m) - 0.5 * T * a)
        a_z, b_z = inverse @ (np.eye(m) + 0.5 * T * a), inverse @ k_b * T
        c_z, d_z = k_c @ inverse, k_d + 0.5 * T * k_c @ inverse @ k_b
        size = n + age + m
        closed = np.zeros((size, size))
        closed[:n, :n] = Ad.real
        # e = -c x, u = d_z e + c_z x_K; the force is u_{k-age} at first, then u_{k-age+1}
        command = np.concatenate([-d_z * c, np.zeros(age), c_z])
        vectors = [(V @ early).real, (V @ late).real]
        for back, vector in zip((age, age - 1), vectors, strict=True):
            if back <= 0:
                closed[:n] += np.outer(vector, command)
            else:
                closed[:n, n + back - 1] += vector
        if age:
            closed[n] += command
            for i in range(1, age):
                closed[n + i, n + i - 1] = 1.0
        closed[n + age :, :n] = -np.outer(b_z, c)
        closed[n + age :, n + age :] = a_z
        inside = np.linalg.eigvals(closed)
        if not (np.abs(inside) < 1.0).all():
            return {"stable": np.inf}
        top, roots = np.pi / T, np.log(inside[np.abs(inside) > 1e-12]) / T
    near = np.concatenate([roots, poles, np.linalg.eigvals(a)])
    omega = [np.geomspace(1e-2 * asked.bounds.omega_low, top, 4000)]
    steps = np.concatenate([-np.geomspace(1e-2, 30.0, 25), [0.0], np.geomspace(1e-2, 30.0, 25)])
    omega += [abs(p.imag) + abs(p.real) * steps for p in near]
    w = np.unique(np.concatenate([*omega, [bandwidth, asked.bounds.omega_low]]))
    w = w[(w > 0.0) & (w <= top)]
    s = 1j * w
    free = (right * left / (s[:, None] - poles)).sum(1)
    if T is None:
        G, x = free, s
    else:
        z = np.exp(s * T)
        terms = (early * z[:, None] ** -age + late * z[:, None] ** (1 - age)) * right
        G = (terms / (z[:, None] - np.exp(poles * T))).sum(1)
        x = 2.0 / T * (z - 1.0) / (z + 1.0)
    k = (k_c * np.linalg.solve(x[:, None, None] * np.eye(len(a)) - a, k_b[:, None] + 0j)[..., 0]
         ).sum(1) + k_d  # fmt: skip
    S = 1.0 / (1.0 + G * k)
    bounds = asked.bounds
    low = int(np.argmin(np.abs(w - bounds.omega_low)))
    found = {"S_max": np.abs(S).max() / bounds.S_max, "S_low": abs(S[low]) / bounds.S_low}
    counted = w if asked.structure.integrator else np.maximum(w, bounds.omega_low)
    slope = np.ones_like(w) if bounds.shape is None else bounds.shape * counted / bandwidth
    below = w <= bandwidth
    found["shape"] = (np.abs(S) * np.sqrt(2.0) / np.minimum(1.0, slope))[below].max()
    if bounds.weighted_level is not None and bounds.weights is not None:
        v = bounds.weights
        W_KS = v.c_K / v.M_K * (s + v.omega_K) / (s + v.c_K * v.omega_K)
        W_T = (s + v.omega_T / v.A_l) / (s + v.omega_T / v.A_u) / v.A_u
        found["KS"] = np.abs(W_KS * k * S).max() / bounds.weighted_level
        found["T"] = np.abs(W_T * G * k * S).max() / bounds.weighted_level
    if bounds.compliance_max is not None:
        found["GS"] = np.abs(free * S).max() / bounds.compliance_max
    return {name: float(value) for name, value in found.items()}


def chain_at(asked: Case, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(A, b, c) of the chain at a point of the box, in modal coordinates."""
    values = dict(zip(asked.uncertain.names, point.tolist(), strict=True))
    root = 1.0 / np.sqrt(asked.mass)
    lam, modes = np.linalg.eigh(root[:, None] * asked.stiffness * root)
    omega = np.sqrt(np.maximum(lam, 0.0)) * (1.0 + values.get("resonance_shift", 0.0))
    zeta = np.full(len(lam), asked.zeta * values.get("damping", 1.0))
    omega[0], zeta[0] = 0.1 * HZ, 0.7  # the suspension of the free chain
    n = len(lam)
    A = np.zeros((2 * n, 2 * n))
    A[:n, n:] = np.diag(omega)
    A[n:, :n], A[n:, n:] = -np.diag(omega), -np.diag(2.0 * zeta * omega)
    shape = root[:, None] * modes
    b = np.concatenate([np.zeros(n), shape[0]]) * (1.0 + values.get("gain", 0.0))
    return A, b, np.concatenate([shape[asked.sensor] / omega, np.zeros(n)])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--limit", type=float, default=LIMIT)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    rows: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    bad = 0
    with Runner() as runner:
        for seed in range(options.first, options.first + options.problems):
            if str(seed) in rows:
                continue
            try:
                row = runner.call(options.limit, solved, seed)
            except Overrun as error:
                row = {"outcome": "OVERRUN", "words": str(error), "refuted": True}
            except Exception as error:
                row = {"outcome": "RAISED", "words": repr(error), "refuted": True}
            rows[str(seed)] = row
            bad += bool(row.get("refuted")) or row.get("fails_there") is False
            print(seed, row, flush=True)
            if options.write:
                RESULTS.write_text(json.dumps(rows) + "\n")
    certified = [row for row in rows.values() if row.get("certified")]
    seconds = [row["seconds"] for row in rows.values() if "seconds" in row]
    proofs = [row.get("proof") for row in certified]
    print(f"{len(rows)} problems, {len(certified)} certified, proofs "
          f"{ {name: proofs.count(name) for name in sorted(set(map(str, proofs)))} }, refuted or "
          f"overrun {sum(bool(row.get('refuted')) for row in rows.values())}, "
          f"{np.mean(seconds):.2f} s each, at most {max(seconds):.1f} s")  # fmt: skip
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
