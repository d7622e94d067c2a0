"""The scripts of benchmarks/ as modules."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

FOLDER = Path(__file__).parents[2] / "benchmarks"


def benchmark(name: str) -> ModuleType:
    """A script of benchmarks/, which may import its neighbours."""
    if str(FOLDER) not in sys.path:
        sys.path.append(str(FOLDER))  # last: no module of the tests is hidden by it
    return importlib.import_module(name)
