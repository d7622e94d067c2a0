"""`python -m ccd_casadi.insight RUN_DIR`: the trade-off around a design, and what it answers to.

Writes insight.json and insight.html into the run folder: the front of hardware cost against
bandwidth, error or move time with every point verified, the derivatives of the optimum to what the
case gives, what limits the bandwidth, and the rule of thumb against what was achieved.
"""

import argparse

from ccd_casadi.support.command_line import RUN, SCHEDULER, ExitCode, command, run_folder
from ccd_casadi.support.options import integer, take_value
from ccd_casadi.support.process_pool import PoolOptions, pool
from ccd_casadi.support.terminal import inform


@command(
    "ccd_casadi.insight", "Trade hardware cost against bandwidth.",
    take_value("--points", "N", integer(2, 9999), "most points on the front", 20),
    SCHEDULER, needs=["ccd_casadi.codesign.pareto"], place=RUN,
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Run the command."""
    from ccd_casadi.cases.run_folder import read_run
    from ccd_casadi.codesign.pareto import insight_dict, pareto_front
    from ccd_casadi.codesign.run import outer_of
    from ccd_casadi.sampling.sampler import Sampler
    from ccd_casadi.sampling.store import SampleStore
    from ccd_casadi.support.json_files import write_json

    done = read_run(options.run)
    folder = run_folder(options.run, options.out or options.run)
    with (
        pool(options.scheduler, options.workers, PoolOptions.patience) as workers,
        SampleStore(done.folder / "samples.sqlite") as samples,
    ):
        sampler = Sampler(done.problem, samples, workers, quiet=options.quiet)
        outer = outer_of(sampler)
        front = pareto_front(
            outer_of, sampler, done.theta, points=options.points, seed=options.seed
        )
        responses = outer.responses(outer.point_of(done.theta, done.weights))
    seconds = options.seconds()
    reported = insight_dict(done, front, responses)
    write_json(folder / "insight.json", reported | {"seed": options.seed, "seconds": seconds})
    verified = [point for point in front.points if point.verified]
    inform(f"front         {len(verified)} of {len(front.points)} points verified, "
           f"{front.syntheses} syntheses, {seconds:.1f} s")  # fmt: skip
    from ccd_casadi.reporting.insight_page import insight_page
    from ccd_casadi.reporting.run_verdict import index_of, publish

    page = insight_page(done, front, responses, index_of(folder))
    publish(folder, folder / "insight.html", page)
    inform(f"answer        {page.head.decision}")
    inform(f"page          {folder / 'insight.html'}")
    return ExitCode.DONE if len(verified) == len(front.points) else ExitCode.NOT_VERIFIED


if __name__ == "__main__":
    raise SystemExit(main())
