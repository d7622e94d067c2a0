"""Run a study of tests/oracles: `python benchmarks/oracle.py NAME ...`."""

import runpy
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

if __name__ == "__main__":
    del sys.argv[0]
    runpy.run_module(f"oracles.{sys.argv[0]}", run_name="__main__", alter_sys=True)
