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

The package knows nothing of what the function means. scikit-learn is imported when
something is fitted and not before.
"""

import sys as _sys

from surrogates import interrupts as _interrupts

if _sys.argv[:1] == ["-m"]:  # a command is starting, not a library
    _interrupts.starting()

from surrogates.casadi_export import to_casadi
from surrogates.covariance import Hyperparameters, Kernel
from surrogates.extrapolation import Extrapolation, extrapolation
from surrogates.fitting import Kind, fit, fit_outputs
from surrogates.gaussian_process import GaussianProcess, condition, loo_errors
from surrogates.interface import Errors, Surrogate, SurrogateFitError
from surrogates.polynomial import Polynomial, fit_polynomial
from surrogates.quality import Quality, Roughness, quality_of
from surrogates.radial_basis import Basis, RadialBasis, fit_radial_basis
from surrogates.samples import Samples, checked
from surrogates.sampling_plan import DesignKind, corners, design, grid, latin_hypercube, sobol
from surrogates.serialise import SurrogateFileError, load, save
from surrogates.validation import errors

del _interrupts, _sys

__all__ = [
    "Basis",
    "DesignKind",
    "Errors",
    "Extrapolation",
    "GaussianProcess",
    "Hyperparameters",
    "Kernel",
    "Kind",
    "Polynomial",
    "Quality",
    "RadialBasis",
    "Roughness",
    "Samples",
    "Surrogate",
    "SurrogateFileError",
    "SurrogateFitError",
    "checked",
    "condition",
    "corners",
    "design",
    "errors",
    "extrapolation",
    "fit",
    "fit_outputs",
    "fit_polynomial",
    "fit_radial_basis",
    "grid",
    "latin_hypercube",
    "load",
    "loo_errors",
    "quality_of",
    "save",
    "sobol",
    "to_casadi",
]
