"""Without what POSIX alone has, as on Windows: processes, deadlines and a synthesis work."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
# Read by Python as it starts, in the worker processes too.
TAKEN_AWAY = """
import os, signal, sys
sys.modules["fcntl"] = sys.modules["resource"] = None
for name in ("pthread_sigmask", "SIGALRM", "setitimer"):
    delattr(signal, name)
del os.sched_getaffinity
"""
JOB = """
import math
import ccd_casadi as ccd
from ccd_casadi.support.worker_process import Runner
from ccd_casadi.support.process_pool import Workers

if __name__ == "__main__":
    try:
        import resource
    except ImportError:
        pass
    else:
        raise SystemExit("nothing was taken away")
    with Workers(2) as workers:
        assert sorted(workers.map_unordered(math.sqrt, [1.0, 4.0, 9.0])) == [1.0, 2.0, 3.0]
    with Runner() as runner:
        assert runner.call(60.0, math.sqrt, 4.0) == 2.0
    problem = ccd.problem_of(ccd.load_case(ccd.TWO_MASS))
    solution = ccd.solve(problem, ccd.Direct(starts=1, box_points=0))
    assert solution.result["status"] == "verified"
"""


def test_a_solve_needs_no_posix(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(TAKEN_AWAY)
    (tmp_path / "job.py").write_text(JOB)
    paths = os.pathsep.join([str(tmp_path), str(ROOT)])
    done = subprocess.run(
        [sys.executable, str(tmp_path / "job.py")],
        env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
