"""The one decorator of the kernels: compiled, cached on disk, 1/0 = inf as in NumPy."""

from numba import njit

compiled = njit(cache=True, error_model="numpy")
