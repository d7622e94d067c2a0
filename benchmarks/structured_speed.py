"""Time of a loop of structured synthesis, and of a climb at one θ; two checkouts in one run.

    OPENBLAS_NUM_THREADS=1 python benchmarks/structured_speed.py [--against CHECKOUT] [--climbs]

A loop is one `assess`: stability, every peak, every constraint with its derivatives. The sets are
case study 1 with five plants (one channel), the beam of examples/two_axes (2 x 2, a bound of its
own for the tilt), and the rib stage of benchmarks/rib_stage_design at the corners of its set.
With `--against` another checkout runs the same in turn, and the ratios are printed. CPU seconds
of one process, the least of the rounds. `--climbs` adds a climb of `STEPS` steps from where the
loops are looked at, and beside it SciPy's SLSQP from the same start on the same loops and bounds:
the largest τ with the largest peak of every curve and plant as a constraint, exact slopes, for
`PATIENCE` times the climb at most. Both ends are looked at by `assess`: `passed` is by how much a
bound is passed (ln), infinite where a loop is unstable.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
ROUNDS = 3
STEPS = 40  # of a climb
PATIENCE = 10.0  # climbs: how long the peer may take
DESIGN = ROOT / "benchmarks" / "rib_stage_design"


def problems():
    """Name, problem, κ and τ of each set, κ stable on all its plants."""
    sys.path[:0] = [str(Path(os.environ.get("PYTHONPATH", ROOT)) / "tests/support")]
    from fixed_structure_loops import FAST, loop

    from ccd_casadi.cases.case import load_case
    from ccd_casadi.cases.case_problem import problem_of
    from ccd_casadi.cases.run_folder import sections_kappa
    from ccd_casadi.fixed_structure import Structure, synthesise
    from ccd_casadi.fixed_structure.design import problem_for
    from ccd_casadi.fixed_structure.sections_design import in_problem_units
    from ccd_casadi.inner_problem.structured_plant_set import (
        bounds_of,
        plants_of,
        structure_of,
        structured_of,
        with_options,
    )
    from ccd_casadi.inner_problem.structured_search import with_range

    shifts = (-0.03, -0.015, 0.0, 0.015, 0.03)
    found, kappa = loop(0, Structure(), FAST, shifts)
    yield "5 plants, 1 x 1", found, kappa, -2.2
    beam, stage = ROOT / "examples/two_axes/case.toml", ROOT / "runs/rib_stage_built.toml"
    cases = [("two axes, 2 x 2", beam, None, 0.02, (0.0, 0.02)),
             ("rib stage, 4 x 4", stage, DESIGN, None, ())]  # fmt: skip
    for name, path, folder, theta, offsets in cases:
        stated = with_range(problem_of(load_case(path)))
        design = json.loads((DESIGN / "inner.json").read_text())
        at = [theta] if theta else list(design["theta"].values())
        plants, structure, bounds = plants_of(stated, at), structure_of(stated), bounds_of(stated)
        if offsets:
            moved = [with_options(stated, (("offset", offset),)) for offset in offsets]
            plants = [plant for one in moved for plant in plants_of(one, at)]
        sections = structured_of(stated)
        if folder is None:
            made = synthesise(plants, structure, bounds, sampling=sections.sampling, starts=2,
                              frequencies=sections.frequencies)  # fmt: skip
            kappa, bandwidth = made.kappa, made.bandwidth
        else:
            kappa = np.array(sections_kappa(folder, structure))
            bandwidth = 2.0 * np.pi * design["bandwidth_hz"]
        found = problem_for(plants, structure, bounds, sections.sampling, sections.frequencies)
        yield (name, found, in_problem_units(found, kappa),
               float(np.log(0.9 * bandwidth / found.plants.omega_0)))  # fmt: skip


def climbed(problem, kappa, tau) -> dict[str, float]:
    """Seconds, loops, bandwidth and violation of a climb from κ, τ and of SciPy's SLSQP."""
    from scipy.optimize import minimize

    from ccd_casadi.fixed_structure.figures import assess
    from ccd_casadi.fixed_structure.local_search import Point, ascend

    start = Point(kappa, tau, assess(problem, kappa, tau))
    began = time.process_time()
    end = ascend(problem, start, iterations=STEPS)
    own = time.process_time() - began
    seen = start.assessment.peaks
    groups = np.unique(np.column_stack([seen.curve, seen.plant]), axis=0)

    def rows(x):
        """The largest constraint of every curve and plant, and its slopes."""
        if time.process_time() - began > own * (1.0 + PATIENCE):
            raise TimeoutError
        value, slopes = np.full(len(groups), -1.0), np.zeros((len(groups), len(x)))
        peaks = assess(problem, x[:-1], float(x[-1])).peaks
        if peaks is None:  # unstable
            return value + 3.0, slopes
        for i, (curve, plant) in enumerate(groups):
            of = np.flatnonzero((peaks.curve == curve) & (peaks.plant == plant))
            if len(of):
                j = of[np.argmax(peaks.value[of])]
                value[i], slopes[i] = peaks.value[j], np.append(peaks.to_kappa[j], peaks.to_tau[j])
        return value, slopes

    best = np.append(kappa, tau)

    def keep(x):
        nonlocal best
        best = x.copy()

    try:
        best = minimize(
            lambda x: -x[-1], best, jac=lambda x: -np.eye(len(x))[-1], method="SLSQP",
            callback=keep, options={"maxiter": 10 * STEPS},
            bounds=[*zip(*problem.box, strict=True), (-5.0, 2.0)],
            constraints={"type": "ineq", "fun": lambda x: -rows(x)[0],
                         "jac": lambda x: -rows(x)[1]},
        ).x  # fmt: skip
    except TimeoutError:
        pass
    peer = time.process_time() - began - own
    found = {"climb_s": own, "climb_loops": end.evaluations, "slsqp_over_climb": peer / own}
    for name, x in (("climb", np.append(end.point.kappa, end.point.tau)), ("slsqp", best)):
        seen = assess(problem, x[:-1], float(x[-1]))
        found[f"{name}_hz"] = float(np.exp(x[-1])) * problem.plants.omega_0 / (2.0 * np.pi)
        found[f"{name}_passed"] = seen.violation if seen.stable else float("inf")
    return found


def measured(climbs: bool) -> dict[str, dict[str, float]]:
    """Milliseconds of a loop and of the Hessians at it, seconds of a climb, by set."""
    import warnings

    from ccd_casadi.fixed_structure.figures import assess, hessians

    warnings.filterwarnings("ignore")
    table = {}
    for name, problem, kappa, tau in problems():
        rng = np.random.default_rng(0)
        near = [kappa + 0.02 * rng.normal(size=len(kappa)) for _ in range(20)]
        near = [one for one in near if assess(problem, one, tau).stable]
        row: dict[str, float] = {"plants": getattr(problem, "count", len(problem.plants.plants))}
        times, bends = [], []
        for _ in range(ROUNDS):
            began = time.process_time()
            for one in near:
                found = assess(problem, one, tau)
            times.append(1e3 * (time.process_time() - began) / len(near))
            assert found.peaks is not None
            top = found.peaks.only(np.argsort(-found.peaks.value)[:20])
            began = time.process_time()
            for _ in range(5):
                hessians(problem, near[-1], tau, top)
            bends.append(1e3 * (time.process_time() - began) / 5)
        row |= {"loop_ms": min(times), "hessians_ms": min(bends), "rows": len(found.peaks.v)}
        row["largest"] = float(found.peaks.value.max())
        if climbs:
            row |= climbed(problem, kappa, tau)
        table[name] = row
    return table


def main() -> None:
    """Print one row for each set, with the ratio to another checkout."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--against", type=Path, help="the other checkout of this repository")
    options.add_argument("--climbs", action="store_true")
    options.add_argument("--json", action="store_true", help="measure this checkout alone")
    chosen = options.parse_args()
    if chosen.json:
        print(json.dumps(measured(chosen.climbs)))
        return
    tables = []
    for root in filter(None, (chosen.against, ROOT)):
        command = [sys.executable, __file__, "--json", *["--climbs"] * chosen.climbs]
        settings = os.environ | {"PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1"}
        out = subprocess.run(command, env=settings, stdout=subprocess.PIPE, check=True, text=True)
        tables.append(json.loads(out.stdout))
    for name, row in tables[-1].items():
        print(name, {key: round(value, 4) for key, value in row.items()})
        if len(tables) > 1:
            other = tables[0][name]
            print("    before", {key: round(value, 4) for key, value in other.items()})
            times = [key for key in row if key.endswith(("_ms", "_s"))]
            print("    before/after", {key: round(other[key] / row[key], 2) for key in times})


if __name__ == "__main__":
    main()
