"""Run a study of tests/oracles: `python benchmarks/oracle.py NAME ...`."""

import runpy
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

if __name__ == "__main__":
    del sys.argv[0]
    runpy.run_module(f"oracles.{sys.argv[0]}", run_name="__main__", alter_sys=True)
