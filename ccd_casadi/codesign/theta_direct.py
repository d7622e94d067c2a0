"""The true v(θ) and local solves on it, by steps that pass its kinks (`optim.pieces`)."""

import numpy as np

from ccd_casadi.inner_problem.objective import hardware_at, objective_gradient, objective_of
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.optim.pieces import FIRST, Local, descend
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import InnerSample
from ccd_casadi.support.arrays import Array

SETTLED = 1e-7  # of J: what steps promise less than that is not looked for
FAR = 0.1  # of the box: the first radius where the optimum is not known to be near by
FOLLOWED = 3  # descents at most, each with the better controllers that the one before has found
STEPS = 15  # per parameter, at most, to where pieces meet: from near by it takes half of that


def pieces_from(
    sampler: Sampler, best: InnerSample, settled: float, first: float = FIRST
) -> InnerSample:
    """From a sample to where the pieces of J promise no more, with what is known near by.

    Again from the best where a better controller was found on the way for what had been known.
    """
    problem, asked = sampler.problem, [best]
    lower, upper = box(problem)
    width = upper - lower

    def at(z: Array) -> Local | None:
        theta = np.clip(lower + width * z, lower, upper)
        asked.extend(sampler.values(theta, "local solve"))
        return local(asked[-1])

    def local(sample: InnerSample) -> Local | None:
        J, gradient = objective_of(problem, sample), objective_gradient(problem, sample)
        if not (np.isfinite(J) and np.isfinite(gradient).all()):
            return None
        return Local((np.array(sample.theta) - lower) / width, J, gradient)

    def constraints(z: Array) -> tuple[Array, Array]:
        found = hardware_at(problem, lower + width * z)
        return found.constraints, found.slopes

    steps = STEPS * len(lower)
    for _ in range(FOLLOWED):
        start, improvements = local(best), sampler.improvements
        if start is None:
            break
        others = [found for found in map(local, sampler.solved.values()) if found is not None]
        descend(at, start, others, constraints, steps=steps, settled=settled, first=first)
        best = min(sampler.latest(asked), key=lambda sample: objective_of(problem, sample))
        if sampler.improvements == improvements:
            break
    return best
