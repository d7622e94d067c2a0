"""Random problems of fixed structures: nothing certified that another judge refutes, none hangs.

    python benchmarks/oracle.py random_sections [--problems N] [--first SEED]

A seed is a problem: a chain of one to three masses on a soft suspension (35, 50, 15 %), modes of 30
to 500 Hz, damping 0.2 to 5 %, sensor anywhere; no to two leads and biquads, roll-off of order 0 to
3, integrator in 80 %, `least_damping` 0.05 in half; half of the loops sampled at 3 to 20 kHz with
0, 80 or 200 us; no, one or two (30, 45, 25 %) of resonance shift, damping and gain uncertain.
Most problems are small, so that many can be run:

    99 of 100  a short climb on the corners of the box (1, 3 or 5 plants): from a random stable
               controller, each bound 1.02 to 1.8 times what it has there, five steps, which
               bring one to four bounds to bear; the end goes through the same gate to a
               certificate as every design, its box through branch and bound with some 800
               boxes, so that looser levels are judged too.
    1 of 100   all of `synthesise_robustly`: a search from one start by rule and one at random with
               all its rounds, worst plants added once, judge, proof with all its boxes.

The judge (`sections_judge`) uses NumPy alone, on the set's plants and random ones. Refuted
is: a certified design that passes a bound on its set by 2e-5 (`synthesise_robustly`: 3e-4 on its
box) or is unstable; a level that is proven and passed anywhere; a box said to be refuted whose
plant keeps its bounds. Every problem runs in a process that is killed after `--limit` seconds,
which counts as a failure too. One row per seed goes to `--rows`; seeds that are there are not run
again. `--write` keeps the counts in benchmarks/random_sections.json.
"""

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ccd_casadi.extensions.limitations.bound import forbids
from ccd_casadi.extensions.limitations.of_problem import limits_of
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import Proof, prove
from ccd_casadi.fixed_structure.certificate import JudgeOptions
from ccd_casadi.fixed_structure.design import (
    DesignOptions,
    DesignSearch,
    SectionsDesign,
    problem_for,
)
from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.local_search import ascend
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, LoopProblem
from ccd_casadi.fixed_structure.multi_start import at_its_bandwidth
from ccd_casadi.fixed_structure.starts import at_random, stabilising
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.plants.plant import build_plant, mechanics
from ccd_casadi.support.terminal import Progress
from ccd_casadi.support.worker_process import Overrun, Runner
from ccd_casadi.synthesis.weights import Weights
from oracles.robust_design import synthesise_robustly
from oracles.sections_judge import Case, figures

HZ = 2.0 * np.pi
RESULTS = Path(__file__).parents[2] / "benchmarks/random_sections.json"
ROWS = Path(__file__).parents[2] / "benchmarks/random_sections.jsonl"
LIMIT = 300.0  # s of a problem
WHOLE = 100  # every so many problems take all of `synthesise_robustly`
CLIMB, RESTORED, BOXES = 5, 5, 800  # steps, steps back within the bounds, boxes of a proof
ALLOWED = 3e-4  # relative: by how much the synthesis says that a plant of the box may pass a bound
ROUNDING = 1e-9  # relative: of a proven level
RANDOM_PLANTS = 4
COUNT = 12  # plants that the search for the worst starts from, and that its judge looks at


def case(seed: int) -> Case:
    """The problem of a seed; a climb's bounds are not known yet."""
    rng = np.random.default_rng(seed)
    n = int(rng.choice([1, 2, 3], p=[0.35, 0.5, 0.15]))
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
    box: dict[str, Any] = {
        "resonance_shift": float(rng.uniform(0.005, 0.05)),
        "damping": (float(rng.uniform(0.5, 0.9)), float(rng.uniform(1.1, 2.0))),
        "gain": float(rng.uniform(0.01, 0.1)),
    }
    names = ["resonance_shift", "damping", "gain"] if n > 1 else ["gain"]
    count = min(int(rng.choice([0, 1, 2], p=[0.3, 0.45, 0.25])), len(names))
    chosen = set(rng.choice(names, count, replace=False).tolist())
    system = mechanics(build_plant(chain, ("a",), {}), (1.0,))
    uncertain = UncertainPlant((system,), M_K,
                               **{name: box[name] for name in box if name in chosen})  # fmt: skip
    structure = Structure(
        bool(rng.random() < 0.8),
        int(rng.choice(3, p=[0.1, 0.6, 0.3])),
        int(rng.choice(3, p=[0.4, 0.4, 0.2])),
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
    required, started = case(seed), time.process_time()
    row: dict[str, Any] = {"seed": seed, "kind": "climb" if seed % WHOLE else "whole"}
    on_set = [point for _, point in required.uncertain.corners()]
    design: SectionsDesign | None
    if seed % WHOLE:
        required, design = climbed(required, seed)
        certified = design is not None and design.certified
        allowed = 2.0 * JudgeOptions.tolerance
        proof = proved(required, design) if certified and design is not None else None
        random_too = False  # the certificate is of the set; what is proven is of the box
    else:
        made = synthesise_robustly(
            required.uncertain, required.structure, required.bounds, sampling=required.sampling,
            starts=1, seed=seed, rounds=1, count=COUNT,
        )  # fmt: skip
        design, certified, allowed, proof = made.design, made.certified, ALLOWED, made.proof
        random_too = True
    if design is not None and not certified:
        row["words"] = design.words
    row |= {
        "outcome": "NO_STABLE_START" if design is None else design.outcome.name,
        "certified": certified, "seconds": round(time.process_time() - started, 3),
    }  # fmt: skip
    if proof is not None:
        row |= {"proof": proof.outcome.name, "boxes": proof.boxes}
    if design is None or design.controller is None or proof is None:
        return row
    rng = np.random.default_rng(seed + 10**9)
    ends = required.uncertain.box
    random = [rng.uniform(ends[0], ends[1]) for _ in range(RANDOM_PLANTS if len(ends[0]) else 0)]
    wrong: list[str] = []
    for i, point in enumerate([*on_set, *random]):
        found = figures(required, point, design)
        worst = max(found, key=lambda name: found[name])
        if certified and (i < len(on_set) or random_too):
            row["worst"] = max(row.get("worst", -1.0), found[worst] - 1.0)
            if not found[worst] <= 1.0 + allowed:
                wrong.append(f"certified, {worst} {found[worst]:.6g} at {point}")
        if proof.stable:
            wrong += [
                f"proven {name} {proof.levels[name]:.9g}, is {value:.9g} at {point}"
                for name, value in found.items()
                if not value <= proof.levels.get(name, np.inf) * (1.0 + ROUNDING)
            ]
            if "STABLE" in found:
                wrong.append(f"proven, unstable at {point}")
    if proof.refuted:
        passed = figures(required, np.array(proof.point), design)
        if not max(passed.values()) > 1.0 + 0.999 * proof.slack:
            wrong.append(f"said to be refuted at {proof.point}, is {passed}")
    if proof.outcome.name == "UNSTABLE":
        wrong.append("certified, and the proof says that the model's own loop is unstable")
    return row | ({"wrong": wrong} if wrong else {})


def climbed(required: Case, seed: int) -> tuple[Case, SectionsDesign | None]:
    """A short climb on the corners from a random controller, by whose figures the bounds are."""
    rng = np.random.default_rng(seed + 2 * 10**9)
    plants = required.uncertain.plants(required.uncertain.corners())
    free = problem_for(plants, required.structure, required.bounds, required.sampling)
    starts = stabilising(free, at_random(free, np.exp(rng.uniform(np.log(0.03), 0.0, 24)), rng))
    if not len(starts):
        return required, None
    peaks = assess(free, starts[0], LoopProblem.first_tau, depth=-50.0).peaks
    assert peaks is not None
    over = {code: float(np.exp(peaks.value[peaks.curve == code].max(initial=-np.inf)))
            for code in LoopCurve}  # fmt: skip
    has = {"S_max": over[LoopCurve.S_MAX], "S_low": over[LoopCurve.S_LOW],
           "weighted_level": max(over[LoopCurve.KS], over[LoopCurve.T]),
           "compliance_max": over[LoopCurve.GS]}  # fmt: skip
    drawn = {}
    for name, ratio in has.items():
        times = float(np.exp(rng.uniform(0.02, 0.6)))
        if getattr(required.bounds, name) is not None:
            drawn[name] = getattr(required.bounds, name) * ratio * times
    drawn["S_max"] = max(drawn["S_max"], 1.2)
    required = replace(required, bounds=replace(required.bounds, **drawn))
    problem = problem_for(plants, required.structure, required.bounds, required.sampling)
    first = at_its_bandwidth(problem, starts[0], within=DesignOptions.margin)
    end = ascend(problem, first, iterations=CLIMB)
    point = at_its_bandwidth(problem, end.point.kappa, end.point.tau, DesignOptions.margin)
    examined = end.evaluations
    if point.assessment.violation > DesignOptions.margin:
        end = ascend(problem, point, iterations=RESTORED, restoring=True, radius=0.05)
        point = at_its_bandwidth(problem, end.point.kappa, end.point.tau, DesignOptions.margin)
        examined += end.evaluations
    search = DesignSearch(problem, plants, required.sampling, seed=seed)
    return required, search.make_design(point, (), 1, examined)


def proved(required: Case, design: SectionsDesign) -> Proof:
    """What a few boxes prove."""
    return prove(required.uncertain, required.structure, design.kappa, design.bandwidth,
                 required.bounds, required.sampling, most_boxes=BOXES)  # fmt: skip


def impossible(required: Case, near: float) -> bool:
    """Whether no controller of any order keeps the bounds on the corners, at any ω_b down to a
    thousandth of ω_low; `near` (rad/s): where they are tight."""
    uncertain = required.uncertain
    each = [limits_of(uncertain.plant(point).plant_si(), required.bounds, required.sampling,
                      integrator=required.structure.integrator)
            for _, point in uncertain.corners()]  # fmt: skip
    sets = [replace(own, others=tuple(other for other in each if other is not own))
            for own in each]  # fmt: skip
    return any(forbids(limits, 1e-3 * required.bounds.omega_low, near) for limits in sets)


def counted(rows: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """What the rows say together; failures in full."""
    found: dict[str, Any] = {}
    kept_rows = list(rows)
    for kind in ("climb", "whole"):
        own = [row for row in kept_rows if row["kind"] == kind]
        if not own:
            continue
        seconds = np.array([row["seconds"] for row in own if "seconds" in row])
        worst = [row["worst"] for row in own if "worst" in row]
        slowest = max(own, key=lambda row: row.get("seconds", np.inf))
        found[kind] = {
            "problems": len(own),
            "certified": sum(bool(row.get("certified")) for row in own),
            "outcomes": dict(Counter(row["outcome"] for row in own)),
            "proofs": dict(Counter(row["proof"] for row in own if "proof" in row)),
            "worst_over_bound": max(worst, default=None),
            "processor_seconds": {"mean": round(float(seconds.mean()), 3),
                                  "99 %": round(float(np.quantile(seconds, 0.99)), 2),
                                  "most": [slowest["seed"], slowest.get("seconds")]},
        }  # fmt: skip
    found["failed"] = [row for row in kept_rows if "wrong" in row]
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--limit", type=float, default=LIMIT)
    parser.add_argument("--rows", type=Path, default=ROWS)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    lines = options.rows.read_text().splitlines() if options.rows.exists() else []
    rows = {row["seed"]: row for row in map(json.loads, lines)}
    seeds = [seed for seed in range(options.first, options.first + options.problems)
             if seed not in rows]  # fmt: skip
    with (
        Runner() as runner,
        options.rows.open("a") as kept_file,
        Progress(len(seeds), "random problems") as progress,
    ):
        for seed in seeds:
            row = {"seed": seed, "kind": "climb" if seed % WHOLE else "whole"}
            try:
                row = runner.call(options.limit, solved, seed)
            except Overrun as error:
                row |= {"outcome": "OVERRUN", "wrong": [str(error)]}
            except Exception as error:
                row |= {"outcome": "RAISED", "wrong": [repr(error)]}
            rows[seed] = row
            kept_file.write(json.dumps(row) + "\n")
            kept_file.flush()
            progress.advance()
            if "wrong" in row:
                print(row, flush=True)
    found = counted(rows.values())
    print(json.dumps(found, indent=1))
    if options.write:
        RESULTS.write_text(json.dumps(found, indent=1) + "\n")
    return 1 if found["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
