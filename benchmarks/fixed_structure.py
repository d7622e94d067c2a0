"""What a fixed structure reaches on sets of plants, judged apart from the synthesis.

    python benchmarks/fixed_structure.py [case1|derivatives|stage|starts|all] [--write]

Every figure is of `certificate.certify`, which rebuilds the loops from matrices: eigenvalues, peaks
on grids through every pole and zero, hold and delay exact; here on a lattice of 1001 plants.
`--shape-ends crossing` gives the rows of case1 the meaning that the shape had first: below ω_b
only. `starts` climbs from every start to its end, with both meanings, and counts the ends within
2 % of the best. `--write` keeps the results in benchmarks/fixed_structure.json.
"""

import argparse
import itertools
import json
import platform
import time
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
from robust_design import synthesise_robustly

from ccd_casadi.analysis.loop_figures import loop_entry
from ccd_casadi.fixed_structure import Bounds, Sampling, ShapeEnd, Structure, certify
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.figures import assess, constraints, to_theta
from ccd_casadi.fixed_structure.local_search import ascend
from ccd_casadi.fixed_structure.race import started
from ccd_casadi.fixed_structure.starts import at_random, stabilising
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import lattice
from ccd_casadi.plants.modal import Perturbation, Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics, build_plant, mechanics
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
from ccd_casadi.plants.two_mass import two_mass_plant
from ccd_casadi.synthesis.weights import Weights

HZ = 2.0 * np.pi
RESULTS = Path(__file__).with_suffix(".json")
M_K = 2e7
WEIGHTS = Weights(
    M_S=2.0, A_S=1e-4, omega_S=800.0 * HZ, c_K=1e4, omega_K=100.0 * HZ, M_K=M_K, A_l=1.0,
    A_u=1e-2, omega_T=25.0 * HZ,
)  # fmt: skip
BOUNDS = Bounds(
    S_max=1.75, S_low=0.03, omega_low=HZ, shape=1.1, weighted_level=8.426, weights=WEIGHTS
)
SAMPLED = Sampling(10000.0, 100.0)


def two_mass(theta: tuple[float, float]) -> Mechanics:
    """Case study 1 at θ in kg."""
    return mechanics(two_mass_plant(("m1", "m2")), theta)


def box(shift: float, damping: tuple[float, float] = (1.0, 1.0)) -> UncertainPlant:
    """Case study 1 at (55, 55) kg, its resonance off by ± `shift`."""
    return UncertainPlant((two_mass((55.0, 55.0)),), M_K, resonance_shift=shift,
                          damping=damping)  # fmt: skip


ROWS = {
    "+-3 %": (box(0.03), Structure(), None, None),
    "+-5 %": (box(0.05), Structure(), None, None),
    "+-3 %, damping x 0.5 to 2, 10 kHz, 100 us": (
        box(0.03, (0.5, 2.0)), Structure(), SAMPLED, None,
    ),
    "+-3 %, least_damping 0.05": (box(0.03), Structure(least_damping=0.05), None, 48.5),
    "+-5 %, least_damping 0.05": (box(0.05), Structure(least_damping=0.05), None, 47.0),
    "+-3 %, damping x 0.5 to 2, 10 kHz, 100 us, least_damping 0.05": (
        box(0.03, (0.5, 2.0)), Structure(least_damping=0.05), SAMPLED, 42.0,
    ),
}  # fmt: skip


def case1(seed: int, chosen: str, ends: ShapeEnd) -> dict[str, dict[str, object]]:
    """Case study 1 at (55, 55) kg; the rows whose name has `chosen` at its end."""
    found, limits = {}, replace(BOUNDS, shape_ends=ends)
    for name, (uncertain, structure, sampling, asked) in ROWS.items():
        if not name.endswith(chosen):
            continue
        begun, processor = time.perf_counter(), time.process_time()
        made = synthesise_robustly(uncertain, structure, limits, sampling=sampling, seed=seed)
        spent, used = time.perf_counter() - begun, time.process_time() - processor
        row: dict[str, object] = {"required_hz": asked, "outcome": made.design.outcome.value}
        if made.design.controller is not None:
            plants = uncertain.plants(lattice(uncertain, 1001, 12345))
            judge = certify(plants, made.design.controller, limits, sampling)
            K, peak = made.design.controller, max(f.S_peak for f in judge.plants)
            corners = [p.plant_si() for p in uncertain.plants(uncertain.corners())]
            row |= {
                "bandwidth_hz": made.design.bandwidth / HZ,
                "judged_bandwidth_hz": judge.bandwidth / HZ,
                "judged_plants": len(plants),
                "worst_over_bound": judge.worst,
                "judge": judge.words,
                "stable_everywhere": all(figures.stable for figures in judge.plants),
                "loop": loop_entry(corners, K, sampling, made.design.bandwidth, peak),
                "kappa": made.design.kappa.tolist(),
            }
        row |= {
            "set": len(made.added),
            "kkt_residual": made.design.kkt_residual,
            "local_optima_hz": [[o.bandwidth / HZ, o.count] for o in made.design.local_optima],
            "multipliers": made.design.multipliers,
            "loops": made.design.evaluations,
            "seconds": spent,
            "processor_seconds": used,
        }
        found[name] = row
        judged = row.get("judged_bandwidth_hz", np.nan)
        print(f"{name:62s} required {asked}, got {judged:.2f} Hz on {row.get('judged_plants')} "
              f"plants, {used:.0f} s of a processor ({spent:.0f} s), "
              f"KKT {made.design.kkt_residual:.1e}: {row.get('judge')}", flush=True)  # fmt: skip
        print(f"    {row.get('loop')}", flush=True)
    return found


def starts(seed: int, count: int = 16) -> dict[str, dict[str, object]]:
    """Where local searches from random stable starts end, on the corners of each set."""
    found = {}
    for ends in ShapeEnd:
        limits = replace(BOUNDS, shape_ends=ends)
        for name, (uncertain, structure, sampling, _) in ROWS.items():
            if not name.endswith("least_damping 0.05"):
                continue
            plants = uncertain.plants(uncertain.corners())
            problem = problem_for(plants, structure, limits, sampling)
            rng = np.random.default_rng(seed)
            draws = np.exp(rng.uniform(np.log(0.03), 0.0, 40 * count))
            pool = stabilising(problem, at_random(problem, draws, rng))[:count]
            tops = [ascend(problem, started(problem, kappa), iterations=150) for kappa in pool]
            good = [end for end in tops if end.point.assessment.violation < 1e-4]
            unit = problem.plants.omega_0 / HZ
            hz = unit * np.sort([np.exp(end.point.tau) for end in good])[::-1]
            near = int((hz >= 0.98 * hz[0]).sum())
            loops = float(np.mean([end.evaluations for end in tops]))
            found[f"{name}, shape up to {ends}"] = {
                "starts": len(pool), "within_2_percent": near, "ends_hz": hz.round(2).tolist(),
                "loops_each": loops,
            }  # fmt: skip
            print(f"{name}, shape up to {ends}: {near} of {len(pool)} starts within 2 % of "
                  f"{hz[0]:.2f} Hz, {loops:.0f} loops each", flush=True)  # fmt: skip
    return found


def derivatives(seed: int, count: int = 200) -> dict[str, float]:
    """The largest error of a derivative to κ, τ and θ over differences, of random loops.

    Relative to the largest derivative of its constraint; half of the loops are sampled.
    """
    rng = np.random.default_rng(seed)
    plant = two_mass_plant(("m1", "m2"))
    worst = {"kappa": 0.0, "tau": 0.0, "theta": 0.0}
    looked = 0
    while looked < count:
        theta = rng.uniform(55.0, 70.0, 2)
        shift, damping = rng.uniform(-0.05, 0.05), rng.uniform(0.5, 2.0)
        sampling = Sampling(rng.uniform(4e3, 2e4), rng.uniform(0.0, 300.0)) if looked % 2 else None
        structure = Structure(bool(rng.integers(2)), int(rng.integers(3)), int(rng.integers(3)),
                              int(rng.integers(1, 4)))  # fmt: skip
        bounds = replace(BOUNDS, compliance_max=1e-6)

        def at(theta: np.ndarray, bounds: Bounds = bounds) -> ScaledPlant:
            modal = modal_plant(mechanics(plant, theta), Suspension(), Perturbation(shift, damping))  # noqa: B023
            return scale_plant(modal, M_K)

        base = at(theta)
        problem = problem_for([base], structure, bounds, sampling)
        starts = stabilising(problem, at_random(problem, np.exp(rng.uniform(-3.0, 0.0, 30)), rng))
        if not len(starts):
            continue
        looked += 1
        kappa, tau = starts[0], float(rng.uniform(-3.0, -1.0))
        peaks = assess(problem, kappa, tau, depth=-3.0).peaks
        assert peaks is not None
        size = np.abs(peaks.to_kappa).max(1) + 1e-3

        def values(problem, kappa, tau):
            return constraints(problem, kappa, tau, peaks)  # noqa: B023

        for i in range(len(kappa)):
            step = 1e-5 * np.eye(len(kappa))[i]
            ends = [values(problem, kappa + s * step, tau).value for s in (1, -1, 2, -2)]
            slope = (8.0 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / 12e-5
            worst["kappa"] = max(
                worst["kappa"], float(np.abs((slope - peaks.to_kappa[:, i]) / size).max())
            )
        exact = to_theta(problem, kappa, peaks)
        scale = np.abs(exact).max(1) + 1e-3 * np.abs(exact).max()
        for i in range(2):
            h = 2e-4
            ends = []
            for s in (1, -1, 2, -2):
                moved = theta.copy()
                moved[i] += s * h
                # ω₀ frozen: the moved plant in the units of the first, which is in the set too.
                pair = problem_for([base, at(moved)], structure, bounds, sampling)
                there = replace(peaks, plant=np.ones_like(peaks.plant))
                ends.append(constraints(pair, kappa, tau, there).value)
            slope = (8.0 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12.0 * h)
            worst["theta"] = max(worst["theta"], float(np.abs((slope - exact[:, i]) / scale).max()))
    print(f"derivatives of {count} random loops: largest relative error to kappa "
          f"{worst['kappa']:.1e}, to theta {worst['theta']:.1e}", flush=True)  # fmt: skip
    return worst


def carriage(theta: tuple[float, float]) -> Mechanics:
    """The stage of docs/tutorial.md; rib and plate in mm."""

    def stage(theta: dict, damping: float = 0.01) -> dict:
        ribs = 0.05 * theta["rib"]
        table = 2.0 + 0.4 * theta["plate"] + 0.5 * ribs
        chuck = 1.5 + 0.5 * ribs
        stiffness = 2.0e6 * (theta["rib"] / 10.0) ** 3
        return {
            "mass": ca.diag(ca.vertcat(table, chuck)),
            "stiffness": stiffness * ca.DM([[1, -1], [-1, 1]]),
            "damping_ratio": damping,
            "input": ca.DM([1, 0]),
            "output": ca.DM([[0.3, 0.7]]),
            "hardware_cost": table + chuck,
        }

    return mechanics(build_plant(stage, ("rib", "plate"), {}), theta)


def stage(seed: int) -> dict[str, dict[str, object]]:
    """The tutorial's stage at +-5 %, plate 6 mm.

    16.12 is the largest |W_KS KS| of the tutorial's own nominal H-infinity design, whose |W_T T|
    reaches 22.4; 8.426 is the level of case study 1.
    """
    weights = replace(WEIGHTS, omega_K=200.0 * HZ, M_K=2e6)
    found = {}
    for rib, level in itertools.product((19.0, 17.0), (16.12, 8.426)):
        bounds = Bounds(S_max=2.0, S_low=0.03, omega_low=HZ, shape=1.1, weighted_level=level,
                        weights=weights if level else None)  # fmt: skip
        uncertain = UncertainPlant((carriage((rib, 6.0)),), 2e6,
                                   resonance_shift=0.05)  # fmt: skip
        made = synthesise_robustly(uncertain, Structure(least_damping=0.05), bounds, seed=seed,
                                   starts=8)  # fmt: skip
        name = f"rib {rib:g} mm, weighted level {level}"
        design = made.design
        row: dict[str, object] = {"mass_kg": 5.9 + 0.05 * rib, "outcome": design.outcome.value}
        if design.controller is not None:
            plants = uncertain.plants(lattice(uncertain, 1001, 12345))
            judge = certify(plants, design.controller, bounds)
            figures = judge.plants[0]
            row |= {
                "judged_bandwidth_hz": judge.bandwidth / HZ,
                "worst_over_bound": judge.worst,
                "judge": judge.words,
                "compliance_at_0": figures.static_compliance,
                "compliance_peak": max(f.GS for f in judge.plants),
                "KS": max(f.KS for f in judge.plants),
            }
        found[name] = row
        print(f"stage, {name}: {row}", flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", nargs="?", default="all")
    parser.add_argument("--row", default="", help="of case1: the end of a row's name")
    parser.add_argument("--shape-ends", type=ShapeEnd, default=ShapeEnd.S_MAX)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    parts = {"derivatives": derivatives, "stage": stage, "starts": starts}
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    ends = options.shape_ends
    asked = {"case1" if ends is ShapeEnd.S_MAX else "case1_crossing": case1} | parts
    for name, part in asked.items():
        if options.part in (name.partition("_")[0], "all"):
            of_case = (options.row, ends) if part is case1 else ()
            results[name] = {**results.get(name, {}), **part(options.seed, *of_case)}
            results["seed"] = options.seed
            results["machine"] = platform.processor() or platform.machine()
            if options.write:
                RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
