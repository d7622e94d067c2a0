"""What co-design gains over the sequential way, estimated in seconds.

`python -m ccd_casadi.worth CASE.toml`: what co-design gains over the sequential way, in seconds.

Writes worth.json: hardware first by a rule of thumb, the best design found, what is left open.
"""

import argparse

from ccd_casadi.support.command_line import ExitCode, command, run_folder
from ccd_casadi.support.extensions import Extension
from ccd_casadi.support.process_pool import Workers
from ccd_casadi.support.terminal import inform

EXTENSION = Extension(
    commands={"worth": ("ccd_casadi.extensions.worth", "estimate in seconds what co-design gains")}
)


@command(
    "ccd_casadi.worth", "Estimate what co-design gains over the sequential way.",
    needs=["ccd_casadi.extensions.worth.worth_estimate"],
)  # fmt: skip
def main(options: argparse.Namespace) -> ExitCode:
    """Run the command."""
    from ccd_casadi.extensions.worth.worth_estimate import worth, worth_words
    from ccd_casadi.sampling.sampler import Sampler
    from ccd_casadi.sampling.store import SampleStore
    from ccd_casadi.studies.steepest_descent import case_to_compare
    from ccd_casadi.support.json_files import write_json
    from ccd_casadi.support.text import versions

    case, problem = case_to_compare(options.case, "worth")
    out = options.out or options.case.with_name(options.case.stem + "_worth")
    folder = run_folder(options.case, out)
    with (
        Workers(options.workers, 10.0) as workers,  # s: threads here share a plant's elements
        SampleStore(folder / "samples.sqlite") as store,
    ):
        found = worth(case, Sampler(problem, store, workers, quiet=options.quiet), options.seed)
    write_json(folder / "worth.json", found | {"seed": options.seed, "versions": versions()})
    inform("\n".join([*worth_words(found), f"file          {folder / 'worth.json'}"]))
    return ExitCode.DONE
