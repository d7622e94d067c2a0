"""How long a search may take, known wherever it is asked: within a budget searches end by
themselves, each with the best that it has.

What takes long asks `time_is_up` between its steps and notes what it leaves (`not_searched`). A
stage of a search may use the time up to its share of the budget, what ends and judges it the rest.
Without a budget the time is never up. Tasks of worker processes have the deadline of who sent them.
"""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class StageOptions:
    """Shares of a budget up to which each stage of a search may last.

    Attributes
    ----------
    start : float
        The search for a first controller.
    search : float
        Over θ.
    ending : float
        Of the best one: polish, worse plants, wider searches at its θ.
    repair : float
        Of a design that the judge refuted.
    """

    start: float = 0.3  # the search for a first controller
    search: float = 0.6  # over θ
    ending: float = 0.75  # of the best one: polish, worse plants, wider searches at its θ
    repair: float = 1.0  # of a design that the judge refuted


@dataclass
class TimeBudget:
    """A budget in minutes, and what was left when it ended.

    Attributes
    ----------
    minutes : float
        Infinite: none.
    began : float
        s of `time.monotonic`, of all processes of a machine.
    left : Counter
        What was not searched, by name: how many.
    share : float
        Of the minutes: the largest whose end left something.
    """

    minutes: float = math.inf
    began: float = field(default_factory=lambda: time.monotonic())
    left: Counter[str] = field(default_factory=Counter)
    share: float = 0.0

    def until(self, share: float) -> float:
        """The end of a share of it, s of `time.monotonic`."""
        return self.began + share * 60.0 * self.minutes

    @property
    def ended(self) -> bool:
        """Whether it ended a search that would have gone on."""
        return bool(self.left)

    @property
    def entry(self) -> dict[str, object]:
        """The entry of result.json."""
        minutes = self.minutes if math.isfinite(self.minutes) else None
        share = {"share": self.share} if self.ended else {}
        return {"minutes": minutes, "ended": self.ended, **share, "not_searched": dict(self.left)}


_BUDGET: ContextVar[TimeBudget | None] = ContextVar("budget", default=None)
_DEADLINE: ContextVar[float] = ContextVar("deadline", default=math.inf)


def budget() -> TimeBudget:
    """The budget of the search that is under way.

    Returns
    -------
    TimeBudget
        Without an end where none was set.
    """
    return _BUDGET.get() or TimeBudget()


@contextmanager
def within_budget(minutes: float | None) -> Iterator[TimeBudget]:
    """Search within a number of minutes, None for any; the search over θ within its share.

    Parameters
    ----------
    minutes : float or None
    """
    made = TimeBudget(math.inf if minutes is None else minutes)
    before = _BUDGET.set(made)
    try:
        with until(made.until(StageOptions.search)):
            yield made
    finally:
        _BUDGET.reset(before)


@contextmanager
def until(deadline: float) -> Iterator[None]:
    """Let the time be up within the block at a deadline, s of `time.monotonic`."""
    before = _DEADLINE.set(deadline)
    try:
        yield
    finally:
        _DEADLINE.reset(before)


@contextmanager
def stage(share: float) -> Iterator[None]:
    """Let the time be up within the block with a share of the budget.

    Parameters
    ----------
    share : float
        Of an infinite budget: never.

    Returns
    -------
    context manager
    """
    own = budget()
    with until(own.until(share) if math.isfinite(own.minutes) else math.inf):
        yield


def time_is_up() -> bool:
    """Decide whether what searches is to end with what it has.

    Returns
    -------
    bool
    """
    deadline = _DEADLINE.get()
    return deadline < math.inf and time.monotonic() > deadline


def not_searched(what: str, count: int = 1) -> None:
    """Note that a search left something because the time was up; nothing where it is not.

    Parameters
    ----------
    what : str
        In words, singular.
    count : int
    """
    if count > 0 and time_is_up():
        own = budget()
        own.left[what] += count
        own.share = max(own.share, (_DEADLINE.get() - own.began) / max(60.0 * own.minutes, 1e-9))


def ends_early(what: str, count: int = 1) -> bool:
    """Whether the time is up for what is left, which is noted.

    Parameters
    ----------
    what, count : str, int
        As of `not_searched`.
    """
    not_searched(what, count)
    return time_is_up()


class InTime(Generic[T, R]):
    """A function of a task with the deadline of the process that sends it, for another process."""

    def __init__(self, function: Callable[[T], R]) -> None:
        self.function, self.deadline = function, _DEADLINE.get()

    def __call__(self, task: T) -> R:
        with until(self.deadline):
            return self.function(task)
