"""The base of every error that a user can cause and correct, and its one line."""

from importlib import import_module
from typing import Any


class UserError(ValueError):
    """A mistake of the user, as one line with its remedy; commands print it and exit with 2."""


class PlantError(UserError):
    """A model returned something that is not a plant; the message has the remedy."""


class NoDesign(UserError):
    """No controller was found again where one had been: a search ends without, or with another."""


def described(error: BaseException) -> str:
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
