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

The package knows nothing of what the function means. scikit-learn is imported when
something is fitted and not before.
"""

import sys as _sys

from surrogates import ctrl_c as _ctrl_c

if _sys.argv[:1] == ["-m"]:  # a command is starting, not a library
    _ctrl_c.starting()

from surrogates import casadi_members as _casadi_members  # registers their expressions
from surrogates.assessment import Assessment, assess
from surrogates.casadi_export import to_casadi
from surrogates.designs import DesignKind, corners, design, grid, latin_hypercube, sobol
from surrogates.diagnostics import Diagnosis, Roughness, diagnose
from surrogates.extrapolation import Extrapolation, extrapolation
from surrogates.fitting import Kind, fit
from surrogates.gaussian_process import GaussianProcess, condition, loo_errors
from surrogates.interface import Surrogate, SurrogateFitError
from surrogates.kernels import Hyperparameters, Kernel
from surrogates.maximum import Maximum, fit_maximum, pieces_of
from surrogates.network import Network, fit_network
from surrogates.outputs import fit_outputs
from surrogates.polynomial import Polynomial, fit_polynomial
from surrogates.radial_basis import Basis, RadialBasis, fit_radial_basis
from surrogates.samples import Samples, checked
from surrogates.selection import Candidate, Choice, choose
from surrogates.serialise import SurrogateFileError, load, save
from surrogates.sparse_process import SparseProcess, fit_sparse
from surrogates.transform import Exponential, Transform
from surrogates.validation import Errors, cross_validate, errors

del _casadi_members, _ctrl_c, _sys

__all__ = [
    "Assessment",
    "Basis",
    "Candidate",
    "Choice",
    "DesignKind",
    "Diagnosis",
    "Errors",
    "Exponential",
    "Extrapolation",
    "GaussianProcess",
    "Hyperparameters",
    "Kernel",
    "Kind",
    "Maximum",
    "Network",
    "Polynomial",
    "RadialBasis",
    "Roughness",
    "Samples",
    "SparseProcess",
    "Surrogate",
    "SurrogateFileError",
    "SurrogateFitError",
    "Transform",
    "assess",
    "checked",
    "choose",
    "condition",
    "corners",
    "cross_validate",
    "design",
    "diagnose",
    "errors",
    "extrapolation",
    "fit",
    "fit_maximum",
    "fit_network",
    "fit_outputs",
    "fit_polynomial",
    "fit_radial_basis",
    "fit_sparse",
    "grid",
    "latin_hypercube",
    "load",
    "loo_errors",
    "pieces_of",
    "save",
    "sobol",
    "to_casadi",
]
