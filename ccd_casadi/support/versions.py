"""Versions of what the numbers depend on."""

import importlib.metadata
import platform

PACKAGES = ("casadi", "numpy", "scipy", "control", "slycot", "scikit-learn", "numba")


def versions() -> dict[str, str]:
    """Versions of Python and of what the numbers depend on."""
    found = {"python": platform.python_version(), "ccd-casadi": _version("ccd-casadi")}
    return found | {name: _version(name) for name in PACKAGES}


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
