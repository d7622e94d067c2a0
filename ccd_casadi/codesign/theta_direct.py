"""The true v(θ) and local solves on it, by steps that pass its kinks (`optim.pieces`)."""

import numpy as np

from ccd_casadi.inner_problem.objective import hardware_at, objective_gradient, objective_of
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.optim.pieces import FIRST, Local, descend, jumps
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array

SETTLED = 1e-7  # of J: what steps promise less than that is not looked for
FAR = 0.1  # of the box: the first radius where the optimum is not known to be near by
STEPS = 15  # per parameter, at most, to where pieces meet: from near by it takes half of that


class TrueBandwidth:
    """θ -> ω_b*(θ) in rad/s with its envelope gradient, from a sampler."""

    def __init__(self, sampler: Sampler, label: str) -> None:
        self.sampler, self.label = sampler, label
        self.known: dict[bytes, BandwidthSample] = {}

    def at(self, theta: Array) -> BandwidthSample:
        """The sample at θ; repeated points cost nothing."""
        return self.all_at(np.atleast_2d(theta))[0]

    def all_at(self, thetas: Array) -> list[BandwidthSample]:
        """Those at several θ (k, n), over the workers."""
        keys = [np.asarray(theta, float).tobytes() for theta in thetas]
        new = [i for i, key in enumerate(keys) if key not in self.known]
        if new:
            samples = self.sampler.bandwidths(np.asarray(thetas)[new], self.label)
            self.known |= {keys[i]: sample for i, sample in zip(new, samples, strict=True)}
        return [self.known[key] for key in keys]


def pieces_from(
    truth: TrueBandwidth, best: BandwidthSample, settled: float, first: float = FIRST
) -> tuple[BandwidthSample, bool]:
    """The best sample of one function ω_b*, and whether that jumps beside it."""
    problem = truth.sampler.problem
    lower, upper = box(problem)
    width = upper - lower

    def at(z: Array) -> Local | None:
        return local(truth.at(np.clip(lower + width * z, lower, upper)))

    def local(sample: BandwidthSample) -> Local | None:
        J, gradient = objective_of(problem, sample), objective_gradient(problem, sample)
        if not (np.isfinite(J) and np.isfinite(gradient).all()):
            return None
        return Local((np.array(sample.theta) - lower) / width, J, gradient)

    def constraints(z: Array) -> tuple[Array, Array]:
        found = hardware_at(problem, lower + width * z)
        return found.constraints, found.slopes

    start = local(best)
    if start is None:
        return best, False
    others = [found for found in map(local, truth.known.values()) if found is not None]
    steps = STEPS * len(lower)
    end = descend(at, start, others, constraints, steps=steps, settled=settled, first=first)
    met = (found for found in map(local, truth.known.values()) if found is not None)
    jumped = any(found.value > end.value and jumps(end, found) for found in met)
    found = (best, *truth.known.values())  # where nothing is promised nothing was asked for
    return min(found, key=lambda sample: objective_of(problem, sample)), jumped
