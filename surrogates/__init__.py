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
used: this module alone loads nothing.
"""

from surrogates.lazy_names import from_stub as _from_stub

__all__ = _from_stub(__name__)
