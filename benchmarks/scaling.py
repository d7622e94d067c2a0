"""How a certified synthesis grows with the number of states: n = 10 to 200 in all.

OPENBLAS_NUM_THREADS=1 python benchmarks/scaling.py
"""

import time

from problems import BACKOFF, OMEGA_LOW, stage, weights

from ccd_casadi.kernels.design import design
from ccd_casadi.kernels.figures import Code, Column


def main() -> None:
    """Print order, CPU time per design, Schur forms to γ_opt and the outcome."""
    print("  N  plant  channels      ms  Schur forms")
    for flexible, channels in ((1, 1), (3, 2), (10, 3), (20, 3), (40, 3), (60, 3), (91, 3)):
        plant = stage(1, flexible=flexible, channels=channels)
        w = weights(400.0, 100.0).scaled(plant.omega_0)
        low = OMEGA_LOW / plant.omega_0
        data = (plant.A, plant.B, plant.C, w, plant.grid, plant.gain, BACKOFF, low, 0.0)
        times = []
        while len(times) < 3 or sum(times) < 0.5:
            start = time.process_time()
            row = design(*data)[0]
            times.append(time.process_time() - start)
        n, (p, m) = plant.A.shape[0], (plant.C.shape[0], plant.B.shape[1])
        outcome = Code(int(row[Column.CODE])).name.lower()
        print(f"{n + 2 * p + m:3d}  {n:5d}  {p:8d}  {1e3 * min(times):8.2f}  "
              f"{row[Column.SCHUR_FORMS]:.0f}  {outcome}")  # fmt: skip


if __name__ == "__main__":
    main()
