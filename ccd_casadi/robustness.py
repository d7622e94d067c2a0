"""`python -m ccd_casadi.robustness RUN_DIR`: what a finished design survives."""

import argparse
from pathlib import Path

from ccd_casadi.robust import MOVE_OPTIONS, Demands, move_of
from ccd_casadi.support.command_line import RUN, ExitCode, command, run_folder
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.options import integer, option, positive, real, take_value
from ccd_casadi.support.process_pool import PoolOptions, Workers
from ccd_casadi.support.terminal import inform, plain

PERCENT = real(0.0, 50.0, strict=True)


@command(
    "ccd_casadi.robustness",
    "Find what a design survives: plants, tolerances, noise, a move.",
    option("--controller", type=Path, metavar="FILE",
           help="judge this controller, not the run's: .json, .mat or .toml, see "
           "docs/robustness.md"),
    take_value("--shift", "PERCENT", PERCENT, "resonance shift", 5.0),
    option("--damping", type=positive, nargs=2, default=[0.5, 2.0], metavar=("LOW", "HIGH"),
           help="range of factors of the damping (default: 0.5 2)"),
    take_value("--tolerance", "PERCENT", PERCENT, "tolerance of every hardware parameter", 1.0),
    take_value("--samples", "N", integer(1), "number of random sets of hardware", 200),
    take_value("--noise", "X", positive, "sensor noise, m/√Hz", 1.0),
    take_value("--disturbance", "X", positive, "density of the force at every actuator, N/√Hz",
               1.0),
    take_value("--axis", "N", integer(1), "output that moves", 1),
    *MOVE_OPTIONS, needs=["ccd_casadi.robust.study"], place=RUN,
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Run the command."""
    from ccd_casadi.cases.run_folder import read_run
    from ccd_casadi.codesign.result import with_verdict_line
    from ccd_casadi.deployment.given_controller import as_it_runs, with_controller
    from ccd_casadi.inner_problem.kinds import kind_of
    from ccd_casadi.robust.study import robustness, study_dict, survival_line
    from ccd_casadi.support.json_files import write_json
    from ccd_casadi.support.text import versions

    finished = read_run(options.run, of_share=True)
    outputs = finished.plant.C.shape[0]
    if options.axis > 1 and (places := kind_of(finished.problem).bounds().places):
        words = f"is {options.axis}; of several sensors on one actuator that of {places[0].name}"
        raise UserError(f"--axis: {words} moves; leave it out")
    if options.axis > outputs:
        raise UserError(f"--axis: is {options.axis}; the plant has outputs 1 to {outputs}")
    if not options.damping[0] <= 1.0 <= options.damping[1]:
        low, high = options.damping
        raise UserError(f"--damping: is {low:g} {high:g}; give a factor up to 1 and one from 1")
    place = options.out or options.run
    if options.controller is None:
        finished = as_it_runs(finished)
    else:
        finished = with_controller(finished, options.controller)
        if options.out is None:  # the run's own page stays
            place = options.run / f"robustness_{options.controller.stem}"
    folder = run_folder(options.run, place)
    limits, window = move_of(options, finished, options.axis - 1)
    demands = Demands(
        shift=options.shift / 100.0,
        damping=tuple(options.damping),
        tolerance=options.tolerance / 100.0,
        samples=options.samples,
        sensor=options.noise,
        disturbance=options.disturbance,
        limits=limits,
        window=window,
        axis=options.axis - 1,
    )
    with Workers(options.workers, PoolOptions.patience) as workers:
        found = robustness(finished, demands, options.seed, options.quiet, workers)
    answer = study_dict(finished, found)
    answer |= {"seed": options.seed, "versions": versions(), "seconds": options.seconds()}
    write_json(folder / "robustness.json", answer)
    from ccd_casadi.reporting.robustness_page import conclusion, robustness_page
    from ccd_casadi.reporting.run_verdict import index_of, publish  # matplotlib is slow to import

    own = options.controller is None
    if own:
        finished = with_verdict_line(finished, folder, survival_line(finished, found))
    page = robustness_page(finished, found, options.seed, index_of(folder), own=own)
    publish(folder, folder / "robustness.html", page)
    inform(plain("\n".join(filter(None, (page.head.decision, *conclusion(finished, found))))))
    inform(f"page          {folder / 'robustness.html'}")
    return ExitCode.DONE


if __name__ == "__main__":
    raise SystemExit(main())
