"""Tolerances: what a share of machines gains, how often fresh draws agree, what prices are worth.

    python benchmarks/tolerances.py share SEED  the rib stage's z channel at 99.9 %, 20 certificates
    python benchmarks/tolerances.py coverage    1,000 toys whose share is known
    python benchmarks/tolerances.py prices      price lists against searches with many starts
    python benchmarks/tolerances.py widths      half-widths, machine and controller of case study 1

`share` takes half an hour on two cores, `prices` and `widths` some minutes each.

Measured, five tolerances at 3 sigma: the model alone about 80 Hz, the whole box 64.84 Hz, the share
68.16 Hz (+5.1 %). 2 failures in six rounds of 13,809 draws accepted it (3 may), after 30 rounds in
all; of its own certificate none failed (5 may). 20 of 20 certificates of other draws agree, with 0
to 2 failures each and 12 in all, 4.3e-5 of all machines. Where one round accepted it, four of five
agreed (68.45 Hz). Of 777 toys below 99.9 % 2 were claimed (at 99 % confidence 8 may be). Prices
agree with many starts to 1.2 %, but for half of the rib stage's shift (3.26 Hz, many starts 2.86)
and of that of two encoders (2.27 and 1.70), where the list has found better designs. By multipliers
they are off by 1 to 10 %, of damping by 20 to 30 %. With the shipped ±2 % of each mode and damping
alone (74.32 Hz, the model 79.91 Hz) the share gains 0.8 %: one tolerance dominates, and its
quantile is near the end of its range.
"""

import sys
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ccd_casadi.cases.case import load_case, parse_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.tables import Case
from ccd_casadi.extensions.tolerances.answers import design_for_share, share_answer, tolerance_case
from ccd_casadi.extensions.tolerances.machines import Plan, certified_share
from ccd_casadi.extensions.tolerances.prices import buy, prices, scale_width
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_robustness import DesignOnBox
from ccd_casadi.inner_problem.structured_search import prepare_search
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.process_pool import PoolOptions, Workers
from ccd_casadi.support.text import HZ

ROOT = Path(__file__).resolve().parents[1]
NAMES = ("resonance_shift", "mode_shift", "damping", "gain")
WIDE = {"resonance_shift": 0.04, "mode_shift": 0.02, "damping": [0.5, 2.0], "gain": 0.06}


def rib_stage_z(**robust: Any) -> Case:
    """The vertical channel of the shipped rib stage, only its rib height free."""
    path = ROOT / "runs" / "rib_stage_built.toml"
    data = tomllib.loads(path.read_text())
    data["plant"]["outputs"] = "z"
    for name, table in data["theta"].items():
        if name != "H":
            data["theta"][name] = {"fixed": table["start"], "unit": "m"}
    del data["controller"]["channel"]
    data["controller"]["biquads"] = 3
    data["robust"] = robust
    return parse_case(data, path)


def with_sampler(case: Case, body: Callable[[Sampler], None], *, quiet: bool = True) -> None:
    """Call with a sampler of the whole box's problem, in this process."""
    of = tolerance_case(case)
    with Workers(1) as workers, SampleStore(":memory:") as store:
        body(Sampler(of.problem, store, workers, quiet=quiet))


def share(seed: int = 0, certificates: int = 20) -> None:
    """Design for 99.9 %, then 20 certificates of the design, each of other draws."""
    case = rib_stage_z(**WIDE, share=0.999, distribution=dict.fromkeys(NAMES, "normal"))
    of = tolerance_case(case)
    with Workers(2, PoolOptions.patience) as workers, SampleStore(":memory:") as store:
        sampler = Sampler(of.problem, store, workers, quiet=False)
        found = design_for_share(of, sampler, of.problem.start, seed, 120.0)
        print("\n".join(share_answer(found).words), flush=True)
        box = DesignOnBox(found.search.problem, found.search.best.theta, found.design)
        passed = failed = 0
        for number in range(certificates):
            own = 1000 * (seed + 1) + number
            one = certified_share(box, of.plan or found.search.plan, of.distribution, own, workers)
            passed, failed = passed + one.passed, failed + one.failed
            print(
                f"{passed} of {number + 1} agree; {one.failed} failed, {failed} in all", flush=True
            )


def coverage(toys: int = 1000) -> None:
    """Of machines with two uniform tolerances 1 - d²/8 have x + y <= 2 - d."""
    case = rib_stage_z(resonance_shift=0.02, gain=0.02)
    problem = problem_of(case)
    uncertain = uncertain_plant(problem, problem.start)
    plan, rng = Plan(0.999, 0.99), np.random.default_rng(0)
    shares = 1.0 - np.append(np.full(toys // 2, 1.0001e-3), rng.uniform(0.0, 2e-3, toys // 2))
    wrong = passed = 0
    for seed, true in enumerate(shares.tolist()):
        most = 0.02 * (2.0 - np.sqrt(8.0 * (1.0 - true)))
        box: Any = SimpleNamespace(
            uncertain=uncertain,
            kept=lambda machines, most=most: [point.sum() <= most for _, point in machines],
        )
        found = certified_share(box, plan, {}, seed).passed
        passed += found
        wrong += found and true < plan.share
    too_low = int((shares < plan.share).sum())
    print(f"{toys} toys, {too_low} below {plan.share}: {wrong} of these claimed ({passed} in all)")


def price_lists() -> None:
    """The list, by re-solves from the run's controller, and by multipliers, against many starts."""
    cases = {
        "case study 1": load_case(ROOT / "runs" / "two_mass_built.toml"),
        "two encoders": load_case(ROOT / "examples" / "two_encoders" / "case.toml"),
        "rib stage, z": rib_stage_z(**WIDE),
    }
    for label, case in cases.items():

        def body(sampler: Sampler, label: str = label) -> None:
            problem, design, _ = prepare_search(sampler.problem)
            theta = problem.start
            bandwidth, found = prices(problem, theta, design.kappa, None, lambda words: None)
            print(f"{label}: {bandwidth / HZ:.3f} Hz", flush=True)
            for price in found:
                scaled = (scale_width(sampler.problem, price.name, factor) for factor in (0.0, 0.5))
                anew = [prepare_search(one)[1].bandwidth for one in scaled]
                cost, buys = ((best - bandwidth) / HZ for best in anew)
                own = price.entry
                slope = own["slope_hz"]
                print(f"  {price.words}; many starts {cost:.3f}, {buys:.3f} Hz; multipliers "
                      f"{slope:.3f}, {0.5 * slope:.3f} Hz", flush=True)  # fmt: skip

        with_sampler(case, body)


def widths() -> None:
    """Half-widths of case study 1 where a percent less costs 0.4 kg."""
    case = load_case(ROOT / "runs" / "two_mass_built.toml")
    case = replace(case, robust=replace(case.robust, cost_per_percent={"resonance_shift": 0.4}))

    def body(sampler: Sampler) -> None:
        problem, design, _ = prepare_search(sampler.problem)
        own, cost = sampler.of(problem), case.robust.cost_per_percent
        found = buy(own, problem.start, design.kappa, cost or {}, {}, print)
        print(found)

    with_sampler(case, body)


if __name__ == "__main__":
    parts = {"share": share, "coverage": coverage, "prices": price_lists, "widths": widths}
    parts[sys.argv[1]](*map(int, sys.argv[2:]))
