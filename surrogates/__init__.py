"""Smooth surrogates of expensive functions, for use inside CasADi.

Sample (`design`), fit (`fit`), judge (`loo_errors`, `cross_validate`, `diagnose`),
export (`to_casadi`) and keep (`save`, `load`):

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

from surrogates.casadi_export import to_casadi
from surrogates.designs import DesignKind, corners, design, grid, latin_hypercube, sobol
from surrogates.diagnostics import Diagnosis, Roughness, diagnose
from surrogates.fitting import fit, fit_outputs
from surrogates.gaussian_process import GaussianProcess, condition, loo_errors
from surrogates.interface import Surrogate, SurrogateFitError
from surrogates.kernels import Hyperparameters, Kernel
from surrogates.serialise import SurrogateFileError, load, save
from surrogates.validation import Errors, cross_validate, errors

__all__ = [
    "DesignKind",
    "Diagnosis",
    "Errors",
    "GaussianProcess",
    "Hyperparameters",
    "Kernel",
    "Roughness",
    "Surrogate",
    "SurrogateFileError",
    "SurrogateFitError",
    "condition",
    "corners",
    "cross_validate",
    "design",
    "diagnose",
    "errors",
    "fit",
    "fit_outputs",
    "grid",
    "latin_hypercube",
    "load",
    "loo_errors",
    "save",
    "sobol",
    "to_casadi",
]
