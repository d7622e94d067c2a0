"""Smooth surrogates of expensive functions, for use inside CasADi.

Sample (`design`), fit (`fit`), judge (`quality_of`, `extrapolation`), export (`to_casadi`) and keep
(`save`, `load`):

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

from surrogates import interrupts as _interrupts

if _sys.argv[:1] == ["-m"]:  # a command is starting, not a library
    _interrupts.starting()

del _interrupts

# Every public name, and the module that defines it.
_PUBLIC = {
    "DesignKind": "sampling_plan",
    "Errors": "interface",
    "Extrapolation": "extrapolation",
    "GaussianProcess": "gaussian_process",
    "Hyperparameters": "covariance",
    "Kernel": "covariance",
    "Kind": "fitting",
    "Polynomial": "polynomial",
    "Quality": "quality",
    "Roughness": "quality",
    "Samples": "samples",
    "Surrogate": "interface",
    "SurrogateRegressor": "estimator",
    "SurrogateFileError": "serialise",
    "SurrogateFitError": "interface",
    "checked": "samples",
    "condition": "gaussian_process",
    "corners": "sampling_plan",
    "design": "sampling_plan",
    "errors": "validation",
    "extrapolation": "extrapolation",
    "fit": "fitting",
    "fit_outputs": "fitting",
    "fit_polynomial": "polynomial",
    "grid": "sampling_plan",
    "latin_hypercube": "sampling_plan",
    "load": "serialise",
    "loo_errors": "gaussian_process",
    "quality_of": "quality",
    "save": "serialise",
    "sobol": "sampling_plan",
    "to_casadi": "casadi_export",
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
