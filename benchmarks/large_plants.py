"""One certified synthesis of plants of 200 states: stages with 1, 3 and 4 channels.

OPENBLAS_NUM_THREADS=1 python benchmarks/large_plants.py
"""

import resource
import time

from problems import OMEGA_LOW, stage, weights

from ccd_casadi.synthesis.synthesis import synthesise


def main() -> None:
    """Print order, seconds of processor time, outcome and figures."""
    synthesise(stage(0, 1, 1), weights(400.0, 100.0), omega_low=OMEGA_LOW)  # loads the kernels
    print("states  channels    N  scaling s  synthesis s  outcome    gamma  norm/bound  MB")
    for channels in (1, 3, 4):
        began = time.process_time()
        plant = stage(1, flexible=100 - channels, channels=channels)
        made = time.process_time()
        figures = synthesise(plant, weights(400.0, 100.0), omega_low=OMEGA_LOW).figures
        done = time.process_time()
        n, proof = len(plant.A), figures.certificate
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        print(
            f"{n:6d}  {channels:8d}  {n + 3 * channels:3d}  {made - began:9.2f}  "
            f"{done - made:11.2f}  {figures.outcome.name.lower():9s}  {figures.gamma_opt:5.3f}  "
            f"{proof.norm / proof.norm_bound:10.6f}  {memory:.0f}"
        )


if __name__ == "__main__":
    main()
