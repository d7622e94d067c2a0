"""The true v(θ) and local solves on it, by steps that pass its kinks (`optim.pieces`)."""

import numpy as np

from ccd_casadi.inner_problem.objective import hardware_at, objective_gradient, objective_of
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.optim.pieces import FIRST, Local, descend
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array

SETTLED = 1e-7  # of J: what steps promise less than that is not looked for
FAR = 0.1  # of the box: the first radius where the optimum is not known to be near by
FOLLOWED = 3  # descents at most, each with the better controllers that the one before has found
STEPS = 15  # per parameter, at most, to where pieces meet: from near by it takes half of that


class TrueBandwidth:
    """θ -> ω_b*(θ) in rad/s with its envelope gradient, from a sampler."""

    def __init__(self, sampler: Sampler, label: str) -> None:
        self.sampler, self.label = sampler, label
        self.asked: dict[tuple[float, ...], BandwidthSample] = {}  # as they were when asked for

    def at(self, theta: Array) -> BandwidthSample:
        """The sample at θ; repeated points cost nothing."""
        return self.all_at(np.atleast_2d(theta))[0]

    def all_at(self, thetas: Array) -> list[BandwidthSample]:
        """Those at several θ (k, n), over the workers."""
        samples = self.sampler.bandwidths(thetas, self.label)
        self.asked |= {sample.theta: sample for sample in samples}
        return samples

    @property
    def known(self) -> list[BandwidthSample]:
        """What is known by now of all that were asked for."""
        return self.sampler.latest(list(self.asked.values()))


def pieces_from(
    truth: TrueBandwidth, best: BandwidthSample, settled: float, first: float = FIRST
) -> BandwidthSample:
    """From a sample, and what was asked for near it, to where the pieces of J promise no more.

    Again from the best where a better controller was found on the way for what had been known.
    """
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

    steps = STEPS * len(lower)
    for _ in range(FOLLOWED):
        start, raised = local(best), truth.sampler.raised
        if start is None:
            break
        others = [found for found in map(local, truth.known) if found is not None]
        descend(at, start, others, constraints, steps=steps, settled=settled, first=first)
        # where nothing is promised nothing was asked for
        found = (*truth.sampler.latest([best]), *truth.known)
        best = min(found, key=lambda sample: objective_of(problem, sample))
        if truth.sampler.raised == raised:
            break
    return best
