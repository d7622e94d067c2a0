"""`python -m ccd_casadi.insight RUN_DIR`: the trade-off around a design, and what it answers to.

Writes insight.json and insight.html into the run folder: the front of hardware cost against
bandwidth with every point verified, the derivatives of the optimum to what the case gives, what
limits the bandwidth, and the rule of thumb against what was achieved.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from time import perf_counter
from typing import Any

import numpy as np

from ccd_casadi.cluster import pool
from ccd_casadi.command_line import ExitCode, add_scheduler, run, run_folder, run_parser
from ccd_casadi.modal import modal_plant
from ccd_casadi.pareto import Front, pareto_front
from ccd_casadi.plant import mechanics
from ccd_casadi.post_optimal import PostOptimal, post_optimal
from ccd_casadi.problem import plant_of
from ccd_casadi.results import versions, write_json
from ccd_casadi.run_folder import FinishedRun, read_run
from ccd_casadi.samples import SampleStore
from ccd_casadi.sampling import Truth
from ccd_casadi.solve import PATIENCE
from surrogates.options import whole

HZ = 2.0 * np.pi


def natural_hz(run: FinishedRun) -> tuple[float, ...]:
    """Natural frequencies of the flexible modes at the design, Hz."""
    modal = modal_plant(mechanics(plant_of(run.problem), run.theta), run.problem.suspension)
    return tuple(float(w) / HZ for w in modal.natural[~modal.rigid])


def insight_dict(run: FinishedRun, front: Front, responses: PostOptimal) -> dict[str, Any]:
    """insight.json: SI, and Hz where a key says so."""
    names = run.problem.names
    points = [
        {
            "theta": dict(zip(names, point.theta, strict=True)),
            "hardware_cost": point.hardware_cost,
            "bandwidth_hz": point.bandwidth / HZ,
            "predicted_bandwidth_hz": point.predicted / HZ,
            "omega_S_hz": point.omega_S / HZ,
            "omega_T_hz": point.omega_T / HZ,
            "active": list(point.active),
            "efficient": point.efficient,
            "status": "verified" if point.verified else "not_verified",
            "reason": point.reason,
        }
        for point in front.points
    ]
    natural = natural_hz(run)
    return {
        "front": {"points": points, "rounds": front.rounds, "syntheses": front.syntheses},
        "optimum": {
            "responses": {item.parameter: asdict(item) for item in responses.responses},
            "determined": responses.determined,
            "weakly_active": list(responses.weak),
            "stationarity": responses.kkt.stationarity,
        },
        "natural_hz": list(natural),
        "first_resonance_over_bandwidth": (
            min(natural) * HZ / run.figures.bandwidth if natural else None
        ),
        "versions": versions(),
    }


def command(options: argparse.Namespace) -> ExitCode:
    """The command itself."""
    began = perf_counter()
    done = read_run(options.run)
    folder = run_folder(options.run, options.out or options.run)
    x = np.array([*done.theta, *np.log([done.weights.omega_S, done.weights.omega_T])])
    with (
        pool(options.scheduler, options.workers, PATIENCE) as workers,
        SampleStore(done.folder / "samples.sqlite") as samples,
    ):
        truth = Truth(done.problem, samples, workers, quiet=options.quiet)
        front = pareto_front(
            truth,
            points=options.points,
            samples=done.case.sampling.lifted_points,
            tolerance=done.case.outer.tolerance,
            seed=options.seed,
        )
    responses = post_optimal(done.problem, x)
    seconds = perf_counter() - began
    found = insight_dict(done, front, responses)
    write_json(folder / "insight.json", found | {"seed": options.seed, "seconds": seconds})
    from ccd_casadi.insight_report import write_insight  # matplotlib is slow to import

    write_insight(folder, done, front, responses)
    verified = [point for point in front.points if point.verified]
    if not options.quiet:
        efficient = sum(point.efficient for point in verified)
        print(f"front         {len(verified)} of {len(front.points)} points verified, ", end="")
        print(f"{efficient} efficient, {front.syntheses} syntheses, {seconds:.1f} s")
        print(f"written       {folder / 'insight.html'}")
    return ExitCode.DONE if len(verified) == len(front.points) else ExitCode.NOT_VERIFIED


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point."""
    arguments = run_parser(
        "ccd_casadi.insight", "Weight against bandwidth, and what the optimum answers to."
    )
    arguments.add_argument(
        "--points", metavar="N", type=whole(2, 9999), default=20, help="of the front (default: 20)"
    )
    add_scheduler(arguments)
    return run(command, arguments, argv)


if __name__ == "__main__":
    raise SystemExit(main())
