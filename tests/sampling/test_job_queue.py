"""The example that samples through a job queue, with dask-jobqueue's local jobs."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_jobs_of_a_queue_end_where_one_process_does(
    solved: Callable[[str], Path], tmp_path: Path
) -> None:
    pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is not installed")
    words = ["runs/two_mass.toml", "--formulation", "lifted", "--no-report", "--quiet"]
    ran = subprocess.run(
        [sys.executable, "examples/job_queue.py", "local", "2", *words, "--out", str(tmp_path)],
        cwd=ROOT, check=False, timeout=300,
    )  # fmt: skip
    assert ran.returncode == 0
    alone = solved("lifted")
    for name in ("result.json", "controller.json"):
        one, other = (json.loads((folder / name).read_text()) for folder in (alone, tmp_path))
        for key in ("theta", "objective", "bandwidth_hz", "syntheses", "status", "A", "B", "C"):
            assert one.get(key) == other.get(key), (name, key)
        assert one.keys() == other.keys()
