"""Smooth surrogates of expensive functions, for use inside CasADi.

Sample (`design`), fit (`fit`; a kind, or `kind="auto"`), judge (`assess`, `extrapolation`),
export (`to_casadi`) and keep (`save`, `load`):

>>> import numpy as np
>>> X = design("sobol", [0.0, 0.0], [1.0, 2.0], 32, seed=1)
>>> Y = np.exp(-X[:, 0]) * np.sin(X[:, 1])
>>> surrogate = fit(X, Y, lower=[0.0, 0.0], upper=[1.0, 2.0])
>>> f = to_casadi(surrogate, std=False)
>>> bool(abs(float(f([0.5, 1.0])) - np.exp(-0.5) * np.sin(1.0)) < 1e-2)
True

The package knows nothing of what the function means. Names are imported when they are first
used: this module alone loads nothing, and scikit-learn comes when something is fitted.
"""

import sys as _sys
from importlib import import_module as _import_module
from types import ModuleType as _ModuleType

from surrogates import ctrl_c as _ctrl_c

if _sys.argv[:1] == ["-m"]:  # a command is starting, not a library
    _ctrl_c.starting()

del _ctrl_c

# Every public name, and the module that defines it.
_PUBLIC = {
    "Assessment": "assessment",
    "Basis": "radial_basis",
    "Candidate": "selection",
    "Choice": "selection",
    "DesignKind": "designs",
    "Diagnosis": "diagnostics",
    "Errors": "validation",
    "Exponential": "transform",
    "Extrapolation": "extrapolation",
    "GaussianProcess": "gaussian_process",
    "Hyperparameters": "kernels",
    "Kernel": "kernels",
    "Kind": "fitting",
    "Maximum": "maximum",
    "Network": "network",
    "Polynomial": "polynomial",
    "RadialBasis": "radial_basis",
    "Roughness": "diagnostics",
    "Samples": "samples",
    "SparseProcess": "sparse_process",
    "Surrogate": "interface",
    "SurrogateFileError": "serialise",
    "SurrogateFitError": "interface",
    "Transform": "transform",
    "assess": "assessment",
    "checked": "samples",
    "choose": "selection",
    "condition": "gaussian_process",
    "corners": "designs",
    "cross_validate": "validation",
    "design": "designs",
    "diagnose": "diagnostics",
    "errors": "validation",
    "extrapolation": "extrapolation",
    "fit": "fitting",
    "fit_maximum": "maximum",
    "fit_network": "network",
    "fit_outputs": "outputs",
    "fit_polynomial": "polynomial",
    "fit_radial_basis": "radial_basis",
    "fit_sparse": "sparse_process",
    "grid": "designs",
    "latin_hypercube": "designs",
    "load": "serialise",
    "loo_errors": "gaussian_process",
    "pieces_of": "maximum",
    "save": "serialise",
    "sobol": "designs",
    "to_casadi": "casadi_members",
}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__


class _Package(_ModuleType):
    """Keeps `surrogates.extrapolation` the function when the module of that name is imported."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _PUBLIC and isinstance(value, _ModuleType)):
            super().__setattr__(name, value)


_sys.modules[__name__].__class__ = _Package
