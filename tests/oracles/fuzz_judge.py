"""What is wrong with how a command took an input: an exception, words, an exit code."""

import json
from dataclasses import dataclass

from oracles.fuzz_values import Input

STATUS = {0: "verified", 3: "infeasible", 4: "not_verified"}


@dataclass(frozen=True)
class Ending:
    """How a call ended: its exit code, what it printed, the traceback of what came out of it."""

    code: int | None
    out: str
    err: str
    trace: str = ""


def misbehaviour(given: Input, ending: Ending) -> list[str]:
    """An exception, a traceback, an exit code or words that break the commands' promises."""
    wrong = []
    if ending.trace:
        wrong.append(f"traceback: {ending.trace.strip().splitlines()[-1][:200]}")
    if "Traceback (most recent" in ending.err + ending.out:
        wrong.append(f"traceback printed: {ending.err[-200:]}")
    if wrong:
        return wrong
    if ending.code not in (0, 2, 3, 4, 130):
        wrong.append(f"exit code {ending.code}")
    lines = ending.err.splitlines()
    if ending.code in (2, 130):
        if len(lines) != 1 or not lines[0].strip():
            wrong.append(f"{len(lines)} lines on stderr: {ending.err[:300]!r}")
        elif not lines[0].isprintable() or len(lines[0]) > 2000:
            wrong.append(f"an unprintable or endless line: {ending.err[:300]!r}")
        if ending.out and "f = print" not in given.note:  # that plant prints by itself
            wrong.append(f"words on stdout: {ending.out[:200]!r}")
    elif any("Warning" in line for line in lines):
        wrong.append(f"a warning: {ending.err[:300]!r}")
    if ending.code == 130 and given.interrupt is None and "KeyboardInterrupt" not in given.note:
        wrong.append(f"interrupted by nobody: {ending.err[:300]!r}")
    if given.command == "inner" and ending.code in STATUS:
        status = json.loads(ending.out)["status"]
        if status != STATUS[ending.code]:
            wrong.append(f"{status} with exit code {ending.code}")
    return wrong
