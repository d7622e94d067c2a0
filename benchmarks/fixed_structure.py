"""What a fixed structure reaches on sets of plants, judged apart from the synthesis.

    python benchmarks/fixed_structure.py [case1|pid|derivatives|stage|all] [--write]

Every figure is of `certificate.certify`, which rebuilds the loops from matrices: eigenvalues, peaks
on grids through every pole and zero, hold and delay exact; here on a lattice of 1001 plants.
`--write` keeps the results in benchmarks/fixed_structure.json.
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

from ccd_casadi.fixed_structure import Bounds, Sampling, Structure, certify, synthesise_sections
from ccd_casadi.fixed_structure.certificate import judged
from ccd_casadi.fixed_structure.design import problem_for
from ccd_casadi.fixed_structure.figures import assess, constraints, to_theta
from ccd_casadi.fixed_structure.loop import closed_loops, stable
from ccd_casadi.fixed_structure.starts import at_random, kept
from ccd_casadi.fixed_structure.structure import response, state_space
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import lattice, synthesise_robustly
from ccd_casadi.plants.modal import Perturbation, Suspension, modal_plant
from ccd_casadi.plants.plant import Mechanics, build_plant, mechanics
from ccd_casadi.plants.registry import MODELS
from ccd_casadi.plants.scaling import ScaledPlant, scale_plant
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
LEVELS = 11  # of the grids of a PID
SAMPLED = Sampling(10000.0, 100.0)


def two_mass(theta: tuple[float, float]) -> Mechanics:
    """Case study 1 at θ in kg."""
    return mechanics(build_plant(MODELS["two_mass"], ("m1", "m2"), {"zeta": 0.01}), theta)


def box(shift: float, damping: tuple[float, float] = (1.0, 1.0)) -> UncertainPlant:
    """Case study 1 at (55, 55) kg, its resonance off by ± `shift`."""
    return UncertainPlant((two_mass((55.0, 55.0)),), Suspension(), M_K, resonance_shift=shift,
                          damping=damping)  # fmt: skip


ROWS = {
    "+-3 %": (box(0.03), Structure(), None, 55.0),
    "+-5 %": (box(0.05), Structure(), None, 50.0),
    "+-3 %, damping x 0.5 to 2, 10 kHz, 100 us": (
        box(0.03, (0.5, 2.0)), Structure(), SAMPLED, 46.0,
    ),
    "+-3 %, least_damping 0.05": (box(0.03), Structure(least_damping=0.05), None, 50.0),
    "+-5 %, least_damping 0.05": (box(0.05), Structure(least_damping=0.05), None, None),
    "+-3 %, damping x 0.5 to 2, 10 kHz, 100 us, least_damping 0.05": (
        box(0.03, (0.5, 2.0)), Structure(least_damping=0.05), SAMPLED, None,
    ),
}  # fmt: skip


def case1(seed: int, chosen: str = "") -> dict[str, dict[str, object]]:
    """The rows of issue 17 at (55, 55) kg; those whose name has `chosen` at its end."""
    found = {}
    for name, (uncertain, structure, sampling, asked) in ROWS.items():
        if not name.endswith(chosen):
            continue
        begun, processor = time.perf_counter(), time.process_time()
        made = synthesise_robustly(uncertain, structure, BOUNDS, sampling=sampling, seed=seed)
        spent, used = time.perf_counter() - begun, time.process_time() - processor
        row: dict[str, object] = {"asked_hz": asked, "outcome": made.design.outcome.value}
        if made.design.controller is not None:
            plants = uncertain.plants(lattice(uncertain, 1001, 12345))
            judge = certify(plants, made.design.controller, BOUNDS, sampling)
            row |= {
                "bandwidth_hz": made.design.bandwidth / HZ,
                "judged_bandwidth_hz": judge.bandwidth / HZ,
                "judged_plants": len(plants),
                "worst_over_bound": judge.worst,
                "judge": judge.words,
                "stable_everywhere": all(figures.stable for figures in judge.plants),
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
        print(f"{name:62s} asked {asked}, got {row.get('judged_bandwidth_hz', np.nan):.2f} Hz on "
              f"{row.get('judged_plants')} plants, {used:.0f} s of a processor ({spent:.0f} s), "
              f"KKT {made.design.kkt_residual:.1e}: {row.get('judge')}", flush=True)  # fmt: skip
    return found


def pid_plants() -> dict[str, tuple[ScaledPlant, Bounds]]:
    """Plants on which a PID is compared with a grid; W_KS ends at 10/M_K, as a PID needs it."""
    found = {}
    bounds = replace(BOUNDS, weights=replace(WEIGHTS, c_K=10.0))
    for theta in ((55.0, 55.0), (60.0, 56.0), (70.0, 55.0)):
        modal = modal_plant(two_mass(theta), Suspension())
        found[f"two_mass {theta}"] = (scale_plant(modal, M_K), bounds)
    stage = replace(BOUNDS, S_max=2.0, weighted_level=None, weights=None, compliance_max=2e-5)
    for rib in (17.0, 25.0):
        modal = modal_plant(carriage((rib, 6.0)), Suspension())
        found[f"tutorial stage, rib {rib:g} mm"] = (scale_plant(modal, 2e6), stage)
    return found


def pid_grid(plant: ScaledPlant, bounds: Bounds) -> float:
    """The best ω_b in Hz of PID by grids over (gain, ω_i, z, p), the finer the closer to the best.

    Nothing of the search's figures is used: a response on fixed frequencies for every point, and
    the judge for the best of them.
    """
    structure = Structure(True, 1, 0, 0)
    problem = problem_for([plant], structure, bounds)
    v = np.unique(np.concatenate([problem.base, problem.fixed[0], np.geomspace(0.05, 20.0, 5000)]))
    v = v[(v >= problem.base[0]) & (v <= problem.base[-1])]
    G, _ = problem.plants.responses(np.zeros(len(v), int), v)
    weights = bounds.weights or WEIGHTS
    _, W_KS, W_T = np.abs(weights.responses(v * plant.omega_0))
    low = np.log(np.array([1e-2, 1e-3, 1e-2, 0.3]))
    high = np.log(np.array([1e1, 1.0, 3.0, 30.0]))
    at_low = np.array([bounds.omega_low / plant.omega_0])
    G_low, _ = problem.plants.responses(np.zeros(1, int), at_low)
    best, centre = -np.inf, 0.5 * (low + high)
    width = 0.5 * (high - low)
    for level in range(LEVELS):
        counts = (21, 9, 9, 9) if level == 0 else (21, 7, 7, 7)
        axes = [c + w * np.linspace(-1.0, 1.0, count)
                for c, w, count in zip(centre, width, counts, strict=True)]  # fmt: skip
        points = np.clip(np.array(list(itertools.product(*axes))), *problem.box)
        for part in np.array_split(points, max(1, len(points) // 2000)):
            part = part[stable(closed_loops(problem.plants, structure, part)).all(1)]
            if not len(part):
                continue
            K = response(structure, part.T[:, :, None], 1j * v[None])
            S = np.abs(1.0 / (1.0 + G * K))
            good = S.max(1) <= bounds.S_max
            if bounds.weighted_level is not None:
                KS = np.abs(K) * S
                good &= (W_KS * KS * plant.force).max(1) <= bounds.weighted_level
                good &= (W_T * KS * np.abs(G)).max(1) <= bounds.weighted_level
            if bounds.compliance_max is not None:
                good &= (np.abs(G) * S).max(1) / plant.force <= bounds.compliance_max
            K_low = response(structure, part.T[:, :, None], 1j * at_low[None])
            good &= np.abs(1.0 / (1.0 + G_low * K_low))[:, 0] <= bounds.S_low
            # ω_b: the last ω up to which room >= ω, room the least shape ω/(√2|S|) so far
            room = np.minimum.accumulate((bounds.shape or np.inf) * v / (np.sqrt(2.0) * S), axis=1)
            fine = (np.sqrt(0.5) >= S) & (room >= v)
            last = np.where(fine.all(1), len(v) - 1, np.argmin(fine, axis=1) - 1)
            value = np.where(good & (last >= 0), v[last], -np.inf)
            k = int(np.argmax(value))
            if value[k] > best:
                best, centre = float(value[k]), part[k]
        width *= 0.75 if level else 0.35
    if not np.isfinite(best):
        return np.nan
    kappa = structure.in_units(centre, plant.omega_0, plant.force)
    figures = judged(plant, state_space(structure, kappa), bounds, None, True)
    worst = max(bounds.shares(figures).values())
    assert worst < 1.0 + 2e-3, f"the grid's frequencies miss a peak: {worst}"
    return figures.bandwidth / HZ


def pid(seed: int) -> dict[str, dict[str, float]]:
    """PID by the search against the grid."""
    found = {}
    for name, (plant, bounds) in pid_plants().items():
        made = synthesise_sections([plant], Structure(True, 1, 0, 0), bounds, seed=seed)
        grid = pid_grid(plant, bounds)
        got = made.bandwidth / HZ
        found[name] = {"search_hz": got, "grid_hz": grid, "difference": got / grid - 1.0}
        print(f"PID, {name:32s} search {got:.3f} Hz, grid {grid:.3f} Hz, "
              f"{got / grid - 1.0:+.3%}: {made.words}", flush=True)  # fmt: skip
    return found


def derivatives(seed: int, count: int = 200) -> dict[str, float]:
    """The largest error of a derivative to κ, τ and θ over differences, of random loops.

    Relative to the largest derivative of its constraint; half of the loops are sampled.
    """
    rng = np.random.default_rng(seed)
    plant = build_plant(MODELS["two_mass"], ("m1", "m2"), {"zeta": 0.01})
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
        starts = kept(problem, at_random(problem, np.exp(rng.uniform(-3.0, 0.0, 30)), rng))
        if not len(starts):
            continue
        looked += 1
        kappa, tau = starts[0], float(rng.uniform(-3.0, -1.0))
        peaks = assess(problem, kappa, tau, depth=-3.0).peaks
        assert peaks is not None
        size = np.abs(peaks.to_kappa).max(1) + 1e-3

        def values(problem, kappa, tau):
            return constraints(problem, kappa, tau, peaks.curve, peaks.plant, peaks.v)  # noqa: B023

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
                ends.append(constraints(pair, kappa, tau, peaks.curve,
                                        np.ones_like(peaks.plant), peaks.v).value)  # fmt: skip
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
        uncertain = UncertainPlant((carriage((rib, 6.0)),), Suspension(), 2e6,
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
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    parts = {"case1": case1, "pid": pid, "derivatives": derivatives, "stage": stage}
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name, part in parts.items():
        if options.part in (name, "all"):
            found = case1(options.seed, options.row) if name == "case1" else part(options.seed)
            results[name] = {**results.get(name, {}), **found}
            results["seed"] = options.seed
            results["machine"] = platform.processor() or platform.machine()
            if options.write:
                RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
