"""Structured synthesis beside SciPy's SLSQP from the same starts, on the same bounds, one judge.

    OPENBLAS_NUM_THREADS=1 python benchmarks/structured_peers.py [--problems N] [--lot SEED]
        [--patience X] [--out FILE]

The problems are chains of benchmarks/random_sections.py with two or three masses, something
uncertain and a lead or biquads. The search of this package runs with 12 starts. Its peer is what
one would write with a general optimiser: max τ over (κ, τ), the largest peak of every curve and
plant as a constraint with its exact slopes, SLSQP from one start after the other (those that the
search draws, half by rules, half at random, then others drawn alike) until it has had `--patience`
times the processor time. Every end is given the largest ω_b that its controller has and passes the
gate of every design: the judge. Where neither end is certified a bound on every controller may show
that none can be. One line of JSON a problem, counts at the end; what `--out` holds is not run
again. With `--lot` the problems are run in an order by lot, so that a part of them is a sample of
all.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from ccd_casadi.fixed_structure.channel_design import synthesise_sections
from ccd_casadi.fixed_structure.design import DesignOptions, DesignSearch, _pool, problem_for
from ccd_casadi.fixed_structure.figures import assess
from ccd_casadi.fixed_structure.local_search import Point
from ccd_casadi.fixed_structure.loop_problem import LoopCurve, LoopProblem
from ccd_casadi.fixed_structure.multi_start import at_its_bandwidth, start_at
from ccd_casadi.plants.scaling import ScaledPlant

sys.path += [str(Path(__file__).parents[1] / folder) for folder in (".", "tests")]

from oracles.random_sections import case, impossible
from oracles.sections_judge import Case

STARTS = 12
STEPS = 300  # of SLSQP from one start
INSIDE = 2e-6  # ln: what SLSQP's ends are pulled back by, so that the judge has no rounding to mind
OUT = Path(__file__).with_suffix(".json")


def problems(count: int) -> list[tuple[int, Case]]:
    """Seeds and their problems."""
    found: list[tuple[int, Case]] = []
    seed = 1000
    while len(found) < count:
        required = case(seed)
        sections = required.structure.lead + required.structure.biquads
        if len(required.mass) > 1 and required.uncertain.names and sections:
            found.append((seed, required))
        seed += 1
    return found


def by_slsqp(problem: LoopProblem, start: Point, until: float) -> Point | None:
    """SLSQP's end from a start, at the bandwidth that it has; None where its loops are unstable."""
    curves = [*problem.curves, LoopCurve.S_LOW, LoopCurve.CROSSING]
    place = {(int(curve), plant): i for i, (curve, plant) in enumerate(
        (curve, plant) for curve in curves for plant in range(problem.plants.count))}  # fmt: skip
    last: dict[str, Any] = {"x": None}
    best = np.append(start.kappa, start.tau)

    def rows(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The largest constraint of every curve and plant, and its slopes."""
        if time.process_time() > until:
            raise TimeoutError
        if last["x"] is not None and np.array_equal(last["x"], x):
            return last["rows"]
        value, slopes = np.full(len(place), -1.0), np.zeros((len(place), len(x)))
        peaks = assess(problem, x[:-1], float(x[-1])).peaks
        if peaks is None:  # unstable
            value += 3.0
        else:
            for j in np.argsort(peaks.value):  # the largest is written last
                i = place[int(peaks.curve[j]), int(peaks.plant[j])]
                value[i] = peaks.value[j]
                slopes[i] = np.append(peaks.to_kappa[j], peaks.to_tau[j])
        last.update(x=x.copy(), rows=(value, slopes))
        return value, slopes

    def keep(x: np.ndarray) -> None:
        nonlocal best
        best = x.copy()

    try:
        best = minimize(
            lambda x: -x[-1], best, jac=lambda x: -np.eye(len(x))[-1], method="SLSQP",
            callback=keep, options={"maxiter": STEPS},
            bounds=[*zip(*problem.box, strict=True), (-8.0, 3.0)],
            constraints={"type": "ineq", "fun": lambda x: -rows(x)[0] - INSIDE,
                         "jac": lambda x: -rows(x)[1]},
        ).x  # fmt: skip
    except TimeoutError:
        pass
    kappa = np.clip(best[:-1], *problem.box)
    end = Point(kappa, float(best[-1]), assess(problem, kappa, float(best[-1])))
    stable = end.assessment.stable
    return at_its_bandwidth(problem, kappa, end.tau, DesignOptions.margin) if stable else None


def peer(
    required: Case, plants: list[ScaledPlant], own: float, seconds: float
) -> tuple[float, float, int, float]:
    """The best judged bandwidth in Hz (0: none) after `own` seconds and at the end, starts used,
    processor time."""
    began = time.process_time()
    problem: Any = problem_for(plants, required.structure, required.bounds, required.sampling)
    soon, best, used, turn = 0.0, 0.0, 0, 0
    while time.process_time() - began < seconds:
        for kappa in _pool(problem, STARTS, np.random.default_rng(turn), None):
            if time.process_time() - began >= seconds:
                break
            used += 1
            end = by_slsqp(problem, start_at(problem, kappa), began + seconds)
            if end is not None:
                made = DesignSearch(problem, plants, required.sampling).make_design(end, (), 1, 0)
                if made.certified:
                    best = max(best, made.bandwidth / (2.0 * np.pi))
            if time.process_time() - began <= own:
                soon = best
        turn += 1
    return soon, best, used, time.process_time() - began


def judged(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """How often the search is as good, and better, than the peer at its end."""
    ratio = np.array([(row["hz"] + 1e-9) / (row["slsqp_hz"] + 1e-9) for row in rows])
    return {
        "problems": len(rows),
        "certified": sum(row["hz"] > 0.0 for row in rows),
        "slsqp_certified": sum(row["slsqp_hz"] > 0.0 for row in rows),
        "shown_to_be_impossible": sum(row.get("impossible", False) for row in rows),
        "as_good_within_0.1_percent": int((ratio > 0.999).sum()),
        "better_by_5_percent": int((ratio > 1.05).sum()),
        "slsqp_time_over_ours": round(float(np.median(
            [row["slsqp_seconds"] / row["seconds"] for row in rows])), 2),
    }  # fmt: skip


def main() -> None:
    """Every problem, a line each, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=20)
    parser.add_argument("--lot", type=int)
    parser.add_argument("--patience", type=float, default=10.0)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if options.out.exists():
        rows = json.loads(options.out.read_text())["rows"]
    todo = problems(options.problems)
    if options.lot is not None:
        todo = [todo[i] for i in np.random.default_rng(options.lot).permutation(len(todo))]
    known = {row["seed"] for row in rows}
    for seed, required in todo:
        if seed in known:
            continue
        plants = required.uncertain.plants(required.uncertain.corners())
        began = time.process_time()
        made = synthesise_sections(plants, required.structure, required.bounds,
                                   sampling=required.sampling, starts=STARTS, seed=0)  # fmt: skip
        own = time.process_time() - began
        soon, theirs, used, spent = peer(required, plants, own, options.patience * own)
        rows.append({
            "seed": seed, "hz": made.bandwidth / (2.0 * np.pi) if made.certified else 0.0,
            "seconds": round(own, 2), "slsqp_hz_in_that_time": soon, "slsqp_hz": theirs,
            "slsqp_starts": used, "slsqp_seconds": round(spent, 2),
        })  # fmt: skip
        if not made.certified and theirs == 0.0 and made.bandwidth > 0.0:
            rows[-1]["impossible"] = impossible(required, made.bandwidth)
        print(json.dumps(rows[-1]), flush=True)
        options.out.write_text(json.dumps({"counts": judged(rows), "rows": rows}, indent=1) + "\n")
    print(json.dumps(judged(rows)))


if __name__ == "__main__":
    main()
