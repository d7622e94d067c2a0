"""`python -m ccd_casadi.kernels` compiles every kernel into the cache on disk.

One tiny problem serves all: SISO and MIMO have the same types.
"""

import time

start = time.perf_counter()

import numpy as np  # noqa: E402

from ccd_casadi.kernels.bound_peak import bound_peak  # noqa: E402
from ccd_casadi.kernels.design import assess, sweep  # noqa: E402
from ccd_casadi.kernels.gamma import plant_gain  # noqa: E402
from ccd_casadi.kernels.generalized_plant import generalized_plant  # noqa: E402
from ccd_casadi.kernels.gradients import design_with_gradients  # noqa: E402


def compile_all() -> None:
    """Call each entry point with arrays laid out as the Python layer passes them."""
    # 1/(s² + 0.1 s + 1) with the paper's weights
    A, B, C = np.array([[0.0, 1.0], [-1.0, -0.1]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    w = np.array([2.0, 1e-4, 4.0, 1e4, 1.0, 1.0, 1e-2, 1.0])
    grid = np.geomspace(1e-2, 1e2, 41)
    gain = np.array([plant_gain(A, B, C, omega) for omega in grid])
    sweep(A, B, C, w, w[2:3].copy(), w[7:8].copy(), grid, gain, 1.02, 0.01)
    none = (np.zeros((1, *matrix.shape)) for matrix in (A, B, C))
    row, Ak, Bk, Ck, *_ = design_with_gradients(A, B, C, w, grid, gain, 1.02, 0.01, 0.0, *none)
    generalized_plant(A, B, C, w)
    bound_peak(A, B, C, w, 1.0)
    assess(A, B, C, Ak, Bk, Ck, np.zeros((1, 1)), w, float(row[3]), 0.01, row)
    if row[0] != 0.0:
        raise SystemExit("the compiled kernels do not certify a design that they should")


if __name__ == "__main__":
    compile_all()
    print(f"kernels compiled or read from the cache in {time.perf_counter() - start:.1f} s")
