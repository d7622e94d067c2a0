"""A user's plant function is code: whether it may run here at all, and for how long.

Everything else in a case file or a run folder is data. Only `problem.py` loads a plant file, and it
asks here first.
"""

import functools
import inspect
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from types import FrameType
from typing import Any, NoReturn

from ccd_casadi.support.errors import UserError, described

AGAIN = 1.0  # s after which a function that swallowed the first alarm gets another

_refused: ContextVar[bool] = ContextVar("user_code_refused", default=False)


class UserCodeRefused(UserError):
    """A case names a plant function where none may run."""


class _Late(BaseException):
    """Not an Exception, so that `except Exception` in a user's loop does not swallow it."""


class _Ended(BaseException):
    """The function would have ended this process."""


MODULE = "user_plant_"  # how the module of a plant's file is named, before the file's own name
_leave = os._exit


def raised_in_user_code(error: BaseException) -> str:
    """The line of a plant's file that an exception came from last, in words; empty: none."""
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        if str(frame.f_globals.get("__name__")).startswith(MODULE):
            place = f"line {line} of {os.path.basename(frame.f_code.co_filename)}"
    return place


def raised_words(error: BaseException) -> str:
    """An exception of a user's function, and the line that it came from."""
    place = raised_in_user_code(error)
    return f"{described(error)} in {place}" if place else described(error)


@contextmanager
def exit_refused() -> Iterator[None]:
    """Within the block os._exit raises, in this thread; the exit of a C library does not."""
    caller, before = threading.current_thread(), os._exit

    def refuse(status: int) -> NoReturn:
        if threading.current_thread() is caller:
            raise _Ended(f"os._exit({status})")
        _leave(status)

    os._exit = refuse
    try:
        yield
    finally:
        os._exit = before


@contextmanager
def permit_user_code(allowed: bool) -> Iterator[None]:
    """Within the block, plant functions of users run or (--no-user-code) are refused."""
    token = _refused.set(not allowed)
    try:
        yield
    finally:
        _refused.reset(token)


def require_user_code(function: str) -> None:
    """Raise UserCodeRefused where a plant function must not run."""
    if _refused.get():
        raise UserCodeRefused(
            f"function = {function} is code, which --no-user-code refuses; "
            "read it, and leave the option out if you trust it"
        )


@contextmanager
def time_limit(seconds: float, error: UserError) -> Iterator[None]:
    """Raise `error` in the block after so many seconds of real time.

    By SIGALRM: in the main thread of a process (every command and every worker of the pool), on
    systems that have it, and between two Python instructions; elsewhere the block runs as it is.
    """
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "SIGALRM"):
        yield
        return

    def late(number: int, frame: FrameType | None) -> None:
        raise _Late

    before = signal.signal(signal.SIGALRM, late)
    try:
        try:
            signal.setitimer(signal.ITIMER_REAL, seconds, AGAIN)
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    except _Late:
        raise error from None
    finally:
        signal.signal(signal.SIGALRM, before)


def with_time_limit(
    function: Callable[..., Any], seconds: float, late: UserError
) -> Callable[..., Any]:
    """The function with a time limit on every call, and with no way out but a value or an error.

    Raises `late` after so many seconds, and UserError where the function would end the process
    (SystemExit, os._exit) or raises what cannot even be shown.
    """

    @functools.wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        with time_limit(seconds, late), exit_refused():
            try:
                value = function(*arguments, **options)
            except (KeyboardInterrupt, _Late):
                raise
            except BaseException as error:
                if isinstance(error, Exception) and described(error) != type(error).__name__:
                    raise
                words = raised_words(error)
                if isinstance(error, _Ended | SystemExit):
                    words = f"would end the program ({words.removeprefix('_Ended: ')})"
                    raise type(late)(f"the function {words}; correct it") from None
                raise type(late)(f"the function raised {words}; correct it") from None
        if inspect.iscoroutine(value):
            value.close()  # else Python warns that nobody awaited it
            raise type(late)("the function is an async one; write a plain def")
        return value

    return call
