"""pytest plugin of mutation runs: the cheapest tests first, and no search for a smallest example.

Where the file named by MUTATION_ORDER exists, tests run by the seconds that it holds; where it
does not, it is written at the end.
"""

import json
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings

settings.register_profile(
    "mutants",
    phases=(Phase.explicit, Phase.generate),
    derandomize=True,
    database=None,
    deadline=None,
    suppress_health_check=tuple(HealthCheck),
)
os.environ["HYPOTHESIS_PROFILE"] = "mutants"  # which tests/conftest.py loads
_FILE = Path(os.environ["MUTATION_ORDER"])
_seconds: dict[str, float] = {}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """By the baseline's seconds; what it does not know comes first."""
    if _FILE.exists():
        known = json.loads(_FILE.read_text())
        items.sort(key=lambda item: known.get(item.nodeid, 0.0))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Set-up and call of a test together."""
    _seconds[report.nodeid] = _seconds.get(report.nodeid, 0.0) + report.duration


def pytest_sessionfinish() -> None:
    """Keep the times of the first run."""
    if not _FILE.exists():
        _FILE.write_text(json.dumps(_seconds))
