"""Calls that never return are ended, and the next one is served."""

import os
import time

import pytest

from ccd_casadi.deadline import Overrun, Runner
from ccd_casadi.errors import UserError


def fail(message: str) -> None:
    raise UserError(message)


def test_results_errors_overruns_and_deaths() -> None:
    with Runner() as runner:
        assert runner.call(60.0, divmod, 7, 2) == (3, 1)
        with pytest.raises(UserError, match="what is wrong"):
            runner.call(60.0, fail, "what is wrong")
        first = runner.call(60.0, os.getpid)
        began = time.monotonic()
        with pytest.raises(Overrun, match=r"within 0\.2 s"):
            runner.call(0.2, time.sleep, 3600.0)
        assert time.monotonic() - began < 3000.0
        with pytest.raises(ProcessLookupError):
            os.kill(first, 0)
        with pytest.raises(Overrun, match="died"):
            runner.call(60.0, os._exit, 3)
        last = runner.call(60.0, os.getpid)
        assert last not in (first, os.getpid())
    with pytest.raises(ProcessLookupError):
        os.kill(last, 0)
