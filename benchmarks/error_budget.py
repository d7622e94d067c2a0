"""RMS error by Lyapunov's equation against simulations of 10⁶ samples, on ten loops.

    python benchmarks/error_budget.py [--samples 1000000]

Ten random stable loops of case study 1 (continuous plant, sampled with hold and delay), each under
one source. The simulation runs the sampled process step by step in its eigenvectors, driven by
pseudo-random numbers; its standard error is that of 100 batches. Asked: the difference is within
its statistical error, |z| < 4 on all ten, and their squares' mean is about 1.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path += [str(folder) for folder in (Path(__file__).parents[1] / "tests").iterdir()]

from fixed_structure_loops import FAST, LATE, SLOW
from test_error_budget import SHAPED, built, simulated

from ccd_casadi.budget.derivatives import of_source
from ccd_casadi.budget.loops import process
from ccd_casadi.fixed_structure import Structure


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--samples", type=int, default=1_000_000)
    samples = options.parse_args().samples
    structures = (Structure(biquads=0), Structure(biquads=1))
    scores = []
    print("loop                 source               Lyapunov        simulation      error    z")
    for number in range(10):
        sampling = (SLOW, LATE, FAST)[number % 3]
        source = (*SHAPED, *SHAPED)[number]
        made, _, _ = built(sampling, number, structures[number % 2])
        exact = float(of_source(made, source, None)[0])
        model = process(made, source)
        mean, error = simulated(model, samples, number, 100)
        scores.append((mean - exact) / error)
        print(f"{sampling.rate_hz:6.0f} Hz {sampling.delay_us:4.0f} us  {source.name:20s} "
              f"{np.sqrt(exact):.6e} m  {np.sqrt(mean):.6e} m  {0.5 * error / exact:.1e}  "
              f"{scores[-1]:+.2f}")  # fmt: skip
    print(f"largest |z| {np.abs(scores).max():.2f}, mean z^2 {np.mean(np.square(scores)):.2f}")


if __name__ == "__main__":
    main()
