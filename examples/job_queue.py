"""A co-design whose samples are made by jobs of a queue: SLURM, PBS, SGE, LSF, HTCondor, OAR.

    pip install "ccd-casadi[cluster]" dask-jobqueue
    python examples/job_queue.py slurm 64 runs/two_mass.toml --formulation lifted

starts a Dask scheduler here, asks the queue for 64 jobs of one worker each, and gives the words
after the number to `solve`. Jobs that come later join, those that the queue ends are replaced; what
a site asks for beyond (account, queue, wall time) is in dask-jobqueue's own file,
~/.config/dask/jobqueue.yaml. `local` runs the jobs as processes of this machine, to try it.
"""

import argparse
from importlib import import_module
from typing import Any

from ccd_casadi.solve import main as solve

QUEUES = {
    "slurm": "SLURMCluster", "pbs": "PBSCluster", "sge": "SGECluster", "lsf": "LSFCluster",
    "htcondor": "HTCondorCluster", "oar": "OARCluster", "moab": "MoabCluster",
}  # fmt: skip


def cluster_of(queue: str) -> Any:
    """A cluster whose jobs hold one worker of one thread, as samples need one BLAS thread each."""
    module = "dask_jobqueue.local" if queue == "local" else "dask_jobqueue"
    kind = getattr(import_module(module), QUEUES.get(queue, "LocalCluster"))
    return kind(cores=1, processes=1, memory="2GB")


def main(argv: list[str] | None = None) -> int:
    """Ask for the jobs, solve, let them go; the exit code is that of `solve`."""
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("queue", choices=["local", *QUEUES])
    arguments.add_argument("jobs", type=int)
    options, words = arguments.parse_known_args(argv)
    with cluster_of(options.queue) as cluster:
        cluster.scale(jobs=options.jobs)
        return solve([*words, "--scheduler", cluster.scheduler_address])


if __name__ == "__main__":
    raise SystemExit(main())
