"""A user's plant function is code: whether it may run here at all, and for how long.

Everything else in a case file or a run folder is data. Only `problem.py` loads a plant file, and it
asks here first.
"""

import functools
import inspect
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from os.path import isfile
from types import FrameType
from typing import Any, NoReturn

from ccd_casadi.support.errors import UserError, describe

_refused: ContextVar[bool] = ContextVar("user_code_refused", default=False)


class UserCodeRefused(UserError):
    """A case names a plant function where none may run."""


class _Late(BaseException):
    """Not an Exception, so that `except Exception` in a user's loop does not swallow it."""


class _Ended(BaseException):
    """The function would have ended this process."""


MODULE = "user_plant_"  # how the module of a plant's file is named, before the file's own name
_given = set[str]()  # where the code of functions is that came as callables
_leave = os._exit


def name_of(function: object) -> str:
    """Return the name of a plant function.

    Parameters
    ----------
    function : str or callable
        As a case file names it, or a callable.

    Returns
    -------
    str
    """
    if isinstance(function, str):
        return function
    return str(getattr(function, "__qualname__", type(function).__name__))


def raised_in_user_code(error: BaseException) -> str:
    """Find the line of a plant's file that an exception came from last.

    Parameters
    ----------
    error : BaseException

    Returns
    -------
    str
        "line N of FILE"; empty where there is none.
    """
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        module = str(frame.f_globals.get("__name__"))
        if module.startswith(MODULE) or frame.f_code.co_filename in _given:
            place = f"line {line} of {os.path.basename(frame.f_code.co_filename)}"
    return place


def raised_words(error: BaseException) -> str:
    """Describe an exception of a user's function, with the line that it came from.

    Parameters
    ----------
    error : BaseException

    Returns
    -------
    str
    """
    place = raised_in_user_code(error)
    return f"{describe(error)} in {place}" if place else describe(error)


@dataclass(frozen=True)
class GivenFunction:
    """A plant function that a program gives as a callable; a worker process finds it by its name.

    Attributes
    ----------
    call : callable

    Raises
    ------
    UserError
        On pickling, where a worker process cannot find it.
    """

    call: Callable[..., Any]

    def __post_init__(self) -> None:
        code = getattr(self.call, "__code__", None)
        if code is not None:
            _given.add(code.co_filename)

    def __getstate__(self) -> dict[str, Any]:
        self.require_found()
        return vars(self)

    def require_found(self) -> None:
        """Raise UserError where a worker process cannot find it."""
        name, module = name_of(self.call), sys.modules.get(getattr(self.call, "__module__", ""))
        found: Any = module
        for part in name.split("."):
            found = getattr(found, part, None)
        file = getattr(module, "__file__", None) or ""
        if found is not self.call or (module is sys.modules["__main__"] and not isfile(file)):
            words = f"{name} cannot be found by module and name in a worker process"
            raise UserError(f"plant.function: {words}; move it into a file, or give workers=1")


@contextmanager
def exit_refused() -> Iterator[None]:
    """Raise on os._exit within the block, in this thread; the exit of a C library is not caught."""
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
    """Permit within the block plant functions of users, or refuse them (--no-user-code).

    Parameters
    ----------
    allowed : bool
    """
    token = _refused.set(not allowed)
    try:
        yield
    finally:
        _refused.reset(token)


def require_user_code(function: str) -> None:
    """Check that a plant function may run.

    Parameters
    ----------
    function : str
        Its name.

    Raises
    ------
    UserCodeRefused
    """
    if _refused.get():
        raise UserCodeRefused(
            f"function = {function} is code, which --no-user-code refuses; "
            "read it, and leave the option out if you trust it"
        )


@contextmanager
def time_limit(seconds: float, error: UserError, *, again: float = 1.0) -> Iterator[None]:
    """Raise `error` in the block after this many seconds of real time, and again where the block
    swallows it, every `again` s.

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
            signal.setitimer(signal.ITIMER_REAL, seconds, again)
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
    """Wrap a function: a time limit on every call, and no end but a value or an error.

    Parameters
    ----------
    function : callable
    seconds : float
        Real time of a call.
    late : UserError
        Raised after that.

    Returns
    -------
    callable
        Raises UserError, too, where the function would end the process (SystemExit, os._exit) or
        raises an exception that cannot be shown.
    """

    @functools.wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        with time_limit(seconds, late), exit_refused():
            try:
                value = function(*arguments, **options)
            except (KeyboardInterrupt, _Late):
                raise
            except BaseException as error:
                if isinstance(error, Exception) and describe(error) != type(error).__name__:
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
