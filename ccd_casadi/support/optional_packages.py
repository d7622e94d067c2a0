"""Packages that only some commands need: imported where they are used, missed in one line."""

from importlib import import_module
from typing import Any

from ccd_casadi.support.errors import UserError


class MissingPackage(UserError):
    """An optional package is not installed; the line says which, and how to get it."""


def require(package: str, extra: str) -> Any:
    """Import a package of the extra `ccd-casadi[extra]`.

    Raises MissingPackage without it, or without a library of the system that it loads.
    """
    try:
        return import_module(package)
    except ImportError:
        words = f"is not installed; install it with pip install 'ccd-casadi[{extra}]'"
        raise MissingPackage(f"{package}: {words}") from None
    except OSError as error:
        words = f"cannot be loaded ({error}); install that library of the system"
        raise MissingPackage(f"{package}: {words}") from None
