"""What a run's store knows: true inner problems per θ, and single designs."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.sampling.rows import Sample, best_key, hashes_of, sample_key
from ccd_casadi.sampling.store import SampleStore


@dataclass(frozen=True)
class Truths:
    """ω_b*(θ) in Hz where the inner problem was solved (NaN: infeasible), and every design."""

    theta: np.ndarray
    bandwidth_hz: np.ndarray
    designs: tuple[Sample, ...]


def read_truths(path: Path, problem: CoDesignProblem) -> Truths:
    """Everything in the store that belongs to this problem (a folder may have seen others)."""
    designs_hash, inner_hash = hashes_of(problem)
    count = len(problem.names)
    thetas, values = [], []
    with SampleStore(path) as store:
        rows = [s for s in store.select() if len(s.theta) == count]
        for theta in dict.fromkeys(sample.theta for sample in rows):
            known = store.get_result(best_key(inner_hash, theta))
            known = known or store.get_result(sample_key(inner_hash, theta, 0.0, 0.0))
            if known is not None:
                thetas.append(theta)
                value = known["bandwidth"]
                values.append(np.nan if value is None else value / (2.0 * np.pi))
    ours = tuple(
        s for s in rows if s.key == sample_key(designs_hash, s.theta, s.omega_S, s.omega_T)
    )
    return Truths(np.array(thetas).reshape(-1, count), np.array(values), ours)


def feasible(problem: CoDesignProblem, sample: Sample) -> bool:
    """Certified and within every bound, to the surrogates' margin."""
    return sample.certified and problem.inner.excess(sample) <= 1e-9
