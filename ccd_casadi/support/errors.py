"""How work ends early: errors that a user can cause and correct, in one line, and Ctrl-C.

Python raises KeyboardInterrupt between two instructions of whatever runs. Three places need care:
imports (nothing has begun: the process just ends), finalizers (the exception is printed and lost),
and compiled code. There it comes out as another exception, with or without a trace of the first, or
not at all: `raise_dropped` checks between the steps of long work. CasADi's solvers swallow it, so
`interrupts_kept` holds it until they are done.
"""

import _thread
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import FrameType
from typing import Any


class UserError(ValueError):
    """A mistake of the user, as one line with its remedy; commands print it and exit with 2."""


class PlantError(UserError):
    """A model returned something that is not a plant; the message has the remedy."""


class NoDesign(UserError):
    """No controller was found again where one had been: a search ends without, or with another."""


def describe(error: BaseException) -> str:
    """Write the kind and the message of an exception of foreign code, which may have none.

    Parameters
    ----------
    error : BaseException

    Returns
    -------
    str
    """
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:
        return type(error).__name__


class MissingPackage(UserError):
    """An optional package is not installed; the line says which, and how to get it."""


def require(package: str, extra: str) -> Any:
    """Import a package of the extra `ccd-casadi[extra]`.

    Parameters
    ----------
    package, extra : str

    Returns
    -------
    module

    Raises
    ------
    MissingPackage
        It, or a library of the system that it loads, is not installed.
    """
    import numpy as np  # a command that needs no extra starts without

    try:
        with np.printoptions():  # pyyeti changes how every number of the program is written
            return import_module(package)
    except ImportError:
        words = f"is not installed; install it with pip install 'ccd-casadi[{extra}]'"
        raise MissingPackage(f"{package}: {words}") from None
    except OSError as error:
        words = f"cannot be loaded ({error}); install that library of the system"
        raise MissingPackage(f"{package}: {words}") from None


_pressed = threading.Event()
_noticing = threading.Event()
_kept = threading.Event()


def _leave(number: int, frame: FrameType | None) -> None:
    # An exception would come out of whatever is being imported, which may swallow or reword it.
    os.write(2, b"interrupted before anything was begun\n")
    os._exit(130)


def exit_on_ctrl_c() -> None:
    """Let Ctrl-C end the process at once, unless it is handled or ignored already."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)


def raise_on_ctrl_c() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again."""
    if signal.getsignal(signal.SIGINT) is _leave:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _press(number: int, frame: FrameType | None) -> None:
    _pressed.set()
    signal.default_int_handler(number, frame)


@contextmanager
def ctrl_c_noticed() -> Iterator[None]:
    """Remember within the block every Ctrl-C for `was_ctrl_c`, the last block's that is.

    One that came where nothing can be raised is sent once more.
    """
    before = sys.unraisablehook
    _pressed.clear()
    ours = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    if ours:
        signal.signal(signal.SIGINT, _press)

    def again() -> None:
        if _noticing.is_set():
            _thread.interrupt_main()

    def noticed(unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            before(unraisable)
            return
        # Not from here, where it could not be raised either, but 10 ms later.
        timer = threading.Timer(0.01, again)
        timer.daemon = True
        timer.start()

    sys.unraisablehook = noticed
    _noticing.set()
    try:
        yield
    finally:
        _noticing.clear()
        sys.unraisablehook = before
        if ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def raise_dropped() -> None:
    """Raise the KeyboardInterrupt that a compiled library has dropped, if one did.

    Long work calls it between its steps; it does nothing outside `ctrl_c_noticed`.

    Raises
    ------
    KeyboardInterrupt
    """
    if _pressed.is_set() and _noticing.is_set():
        _noticing.clear()  # once: what is under way to the end is not to be met by another
        raise KeyboardInterrupt


def was_ctrl_c(error: BaseException | None) -> bool:
    """Whether an exception is a KeyboardInterrupt, or was raised in place of one.

    After a Ctrl-C every one counts: libraries drop the interrupt and stumble over its traces.
    """
    if _pressed.is_set():
        return True
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def ctrl_c_pending() -> bool:
    """Whether Ctrl-C was pressed since the current solve began: end what is under way soon."""
    return _kept.is_set()


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Hold Ctrl-C until the end of the block and raise KeyboardInterrupt there.

    Only the main thread receives signals; elsewhere the block runs as it is.

    Raises
    ------
    KeyboardInterrupt
        At the end of the block.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def keep(number: int, frame: FrameType | None) -> None:
        _kept.set()

    before = signal.signal(signal.SIGINT, keep)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        held = _kept.is_set()
        _kept.clear()
        if held:  # also where the block ends with an error, which may be of the end that was asked
            raise KeyboardInterrupt
