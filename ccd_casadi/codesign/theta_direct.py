"""The true v(θ) and local solves on it: IPOPT, and steps that pass its kinks (`optim.pieces`)."""

from dataclasses import replace

import numpy as np

from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.outer_problem import OuterFailure, nested_program, solve_program
from ccd_casadi.inner_problem.objective import hardware_at, objective_gradient, objective_of
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.optim.pieces import FIRST, Local, descend, jumps
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.casadi_callback import VectorCallback
from surrogates import design

PRECISE = 1e-6  # IPOPT's tolerance: ω_b* is known to about 1e-8
SETTLED = 1e-7  # of J: at a kink of ω_b* no residual falls, a hundred line searches gain no more
FAR = 0.1  # of the box: the first radius where the optimum is not known to be near by
STEPS = 15  # per parameter, at most, to where pieces meet: from near by it takes half of that


class TrueBandwidth(VectorCallback):
    """θ -> ω_b*(θ) in rad/s with its envelope gradient; NaN where no design is certified."""

    def __init__(self, sampler: Sampler, label: str) -> None:
        self.sampler, self.label = sampler, label
        self.known: dict[bytes, BandwidthSample] = {}
        count = len(sampler.problem.names)
        super().__init__("true_bandwidth", count, 1, self._value, self._slope)

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

    def _value(self, theta: Array) -> Array:
        sample = self.at(theta)
        stationary = np.isfinite(sample.gradient).all()
        return np.array([sample.value if stationary else np.nan])

    def _slope(self, theta: Array) -> Array:
        return np.array(self.at(theta).gradient)[None, :]


def solve_direct_value(sampler: Sampler, starts: int, *, seed: int) -> FormulationResult:
    """IPOPT on the true ω_b*(θ) from the case's start and a Sobol set of starts."""
    problem = sampler.problem
    lower, upper = box(problem)
    points = np.array(problem.start)[None, :]
    if starts > 1:
        points = np.vstack([points, design("sobol", lower, upper, starts - 1, seed)])
    truth = TrueBandwidth(sampler, "direct")
    good = [p for p in points if truth.at(p).feasible and np.isfinite(truth.at(p).gradient).all()]
    if not good:
        message = f"none of {len(points)} starting designs is certified"
        return FormulationResult(message=message)
    program = nested_program(problem, truth)
    program = replace(program, exact_hessian=False)
    try:
        solution = solve_program(program, np.array(good), tolerance=PRECISE, settled=SETTLED)
    except OuterFailure as error:
        best = min((truth.at(p) for p in good), key=lambda s: objective_of(problem, s))
        if not np.isfinite(objective_of(problem, best)):
            return FormulationResult(message=str(error))
        return FormulationResult(np.array(best.theta), None, (), (), None, False, str(error))
    best = min(truth.known.values(), key=lambda s: objective_of(problem, s))
    return FormulationResult(np.array(best.theta), None, (), (), solution, True, "")


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
