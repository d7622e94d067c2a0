"""How often the back ends agree, and who the certificate is with: two masses, and 3 x 3 stages.

OPENBLAS_NUM_THREADS=1 python benchmarks/back_ends.py [two masses, 40] [stages, 40]
"""

import sys
from collections import Counter
from pathlib import Path

import numpy as np
from problems import OMEGA_LOW, Problem, stage, two_masses, weights

from ccd_casadi.extensions.cross_check.backends import SOLVERS, TITLES, synthesise_with, verdicts
from ccd_casadi.support.worker_process import Runner

sys.path += [str(Path(__file__).parents[1] / folder) for folder in (".", "tests")]

from oracles import lmi

SEED = 0
SOLVERS["lmi"] = lmi.solve
TITLES["lmi"] = "LMI (Clarabel)"


def problems(masses: int, stages: int) -> list[Problem]:
    """Random masses and break frequencies; random stages of 2 to 6 flexible modes."""
    rng = np.random.default_rng(SEED)
    found = []
    for i in range(masses + stages):
        omega_S, omega_T = 10.0 ** rng.uniform([1.5, 1.4], [3.2, 3.0])
        if i < masses:
            plant = two_masses(*rng.uniform(55.0, 70.0, 2))
        else:
            plant = stage(i, flexible=int(rng.integers(2, 7)))
        kind = "two masses" if i < masses else "stage"
        found.append(Problem(kind, plant, weights(omega_S, omega_T)))
    return found


def main(masses: str = "40", stages: str = "40") -> None:
    """Print for each kind and back end: verdicts by number, largest distance of γ, seconds."""
    outcomes: dict[tuple[str, str], Counter] = {}
    apart: dict[tuple[str, str], list[float]] = {}
    seconds: dict[tuple[str, str], list[float]] = {}
    with Runner() as runner:
        for problem in problems(int(masses), int(stages)):
            results = [
                synthesise_with(
                    name, problem.plant, problem.weights, omega_low=OMEGA_LOW, runner=runner
                )
                for name in TITLES
            ]
            for item in verdicts(results):
                key = (problem.name, item.backend)
                words = item.words.split(" % ")[-1]
                outcomes.setdefault(key, Counter())[words.split(" (")[0]] += 1
                seconds.setdefault(key, []).append(item.seconds)
                if item.certified:
                    distance = abs(item.gamma_opt / results[0].gamma_opt - 1.0)
                    apart.setdefault(key, []).append(distance)
    for key, counts in outcomes.items():
        far = max(apart.get(key, [np.nan]))
        print(f"{key[0]:11s} {TITLES[key[1]]:20s} median {np.median(seconds[key]):.4f} s, ", end="")
        print(f"gamma of certified ones within {far:.1e} of ours")
        for words, count in counts.most_common():
            print(f"{'':12s}{count:4d}  {words}")


if __name__ == "__main__":
    main(*sys.argv[1:])
