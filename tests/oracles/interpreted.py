"""pytest plugin: the kernels as plain Python, so that a mutant needs no two minutes of compiling.

Only the LAPACK wrappers stay compiled; they cannot be interpreted.
"""

import os

import numpy as np

os.environ["CCD_CASADI_COMPILES"] = "1"  # only the wrappers are, and not on two processes

import ccd_casadi.kernels.compiled as gate
import ccd_casadi.kernels.linear_algebra

assert ccd_casadi.kernels.linear_algebra.stable_subspace is not None
np.seterr(all="ignore")  # 1/0 is inf in a compiled kernel
gate.compiled = gate.inlined = lambda function: function
