"""The least RMS error of a fixed structure on a set of plants, within the bounds of the bandwidth.

    min ln e(κ)   s.t.  every bound of `figures` at a bandwidth of at least ω_min,
    e² = mean over the plants of the error's variance under an `ErrorBudget`

By quadratic programmes in a trust region, from a controller that meets the bounds: the gradient
of ln e is exact (adjoint Lyapunov equations), its curvature learnt from it, that of the bounds
exact. The merit is ln e + ρ max(0, max c); a step counts only where every loop stays stable.
A little is paid for bandwidth, so that ω_b is what the bounds leave free at this κ. At its end

    d ln e*/dθ = ∂ ln e/∂θ + Σ μ_j ∂c_j/∂θ        (envelope theorem)

but for that payment, `REWARD` dτ/dθ.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.budget import ErrorBudget
from ccd_casadi.budget.derivatives import Change, rms_error_slope, variance_slopes
from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.certificate import certify
from ccd_casadi.fixed_structure.channel_structure import controller_of
from ccd_casadi.fixed_structure.design import Progress, problem_for
from ccd_casadi.fixed_structure.local_search import LoopModel, Point, descend
from ccd_casadi.fixed_structure.loop_problem import Assessment, LoopProblem
from ccd_casadi.fixed_structure.optimality import Envelope, Optimality, envelope_of, optimality
from ccd_casadi.fixed_structure.sections_design import (
    SectionsDesign,
    SectionsOutcome,
    in_problem_units,
)
from ccd_casadi.fixed_structure.structure import Structure, state_space, state_spaces
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.lti.loop import Loop
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.optim.trust_region import Iterate
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ

STEP = 1e-30  # of κ along the imaginary axis
REWARD = 1e-6  # of ln ω_b in ln e
SLOWER = 0.1  # of the largest bandwidth: where a search from a given κ begins
KEPT = 1.0 + 2e-6  # figure over bound that the search leaves


@dataclass(frozen=True)
class RmsError:
    """e of a controller on SISO plants in SI, and its derivatives to κ."""

    plants: tuple[StateSpace, ...]
    structure: Structure
    budget: ErrorBudget
    hold: Sampling | None

    def at(self, kappa: Array) -> tuple[float, Array]:
        """ln e (m) at κ in SI, and its gradient; infinite where a loop is unstable."""
        kappa = np.asarray(kappa, float)
        stepped = state_spaces(self.structure, kappa + 1j * STEP * np.eye(len(kappa)))
        changes = [
            Change(None, StateSpace(*(part[i].imag / STEP for part in stepped)))
            for i in range(len(kappa))
        ]
        return self._summed(kappa, [changes] * len(self.plants))

    def to_theta(self, kappa: Array, plants: Sequence[ScaledPlant]) -> Array:
        """∂ ln e/∂θ at a fixed κ; `plants` are those of the error, with dA, dB, dC."""
        none = [np.zeros((len(p.C), p.B.shape[1])) for p in plants]
        changes = [
            [
                Change(StateSpace(p.omega_0 * dA, p.omega_0 / p.force * dB, dC, D), None)
                for dA, dB, dC in zip(p.dA, p.dB, p.dC, strict=True)
            ]
            for p, D in zip(plants, none, strict=True)
        ]
        return self._summed(np.asarray(kappa, float), changes)[1]

    def _summed(self, kappa: Array, changes: Sequence[Sequence[Change]]) -> tuple[float, Array]:
        """ln e and its derivatives to what the changes of each plant's loop are of."""
        K = state_space(self.structure, kappa)
        total = None
        for plant, own in zip(self.plants, changes, strict=True):
            found = variance_slopes(Loop(plant, K, self.hold), self.budget, own)
            if found is None:
                return np.inf, np.full(len(own), np.nan)
            total = found if total is None else replace(
                total, value=total.value + found.value, gradient=total.gradient + found.gradient
            )  # fmt: skip
        assert total is not None
        value, slope = rms_error_slope(total)
        return value - 0.5 * float(np.log(len(self.plants))), slope


@dataclass(frozen=True)
class LeastError:
    """A design with its RMS error in m over the set, and that of the controller it began with.

    `design.multipliers`: change of ln e per ln of a bound; `design.kkt_residual` is over ‖∇ ln e‖.
    `envelope` has de*/dθ where the plants carry derivatives; None where the end is not stationary.
    """

    design: SectionsDesign
    error: float
    first_error: float
    steps: int
    envelope: Envelope | None


def least_error(
    plants: Sequence[ScaledPlant],
    bounds: Bounds,
    design: SectionsDesign,
    budget: ErrorBudget,
    *,
    sampling: Sampling | None = None,
    least_bandwidth: float = 0.0,
    initial: Sequence[Array] = (),
    progress: Progress | None = None,
) -> LeastError:
    """From `initial` (κ in SI), or a certified design and its other local optima, to the least
    RMS error in m: from the latter where nothing is given or what is leads to no certified design.

    `least_bandwidth` in rad/s. What the judge does not confirm is not handed out: the design that
    it began with is, then. A local optimum, as any search from given starts finds.
    """
    structure = design.structure
    if not isinstance(structure, Structure):
        raise ValueError("the least RMS error is searched for one input and one output only")
    problem = problem_for(plants, structure, bounds, sampling, design.frequencies)
    goal = RmsError(
        tuple(p.plant_si() for p in plants), structure, replace(budget, window=None), sampling
    )
    w0, force = problem.plants.omega_0, problem.plants.force
    floor = float(np.log(max(least_bandwidth, 1e-3 * design.bandwidth) / w0))

    def scaled(kappa: Array) -> tuple[float, Array]:
        return goal.at(structure.in_units(kappa, w0, force))

    model = LoopModel(problem, scaled, REWARD, floor)
    first_hessian = np.diag(np.append(np.ones(len(design.kappa)), 0.0))
    tell = progress or (lambda words: None)
    own = (design.bandwidth, tuple(map(float, design.kappa)))
    others = [(o.bandwidth, o.kappa) for o in design.local_optima[1:] if o.kappa]
    first = float(np.exp(goal.at(design.kappa)[0]))
    best = LeastError(design, first, first, 0, None)
    steps = 0
    slower = max(SLOWER * design.bandwidth, least_bandwidth)
    given = [(slower, tuple(map(float, item))) for item in initial]
    for bandwidth, kappa in [*given, own, *others]:
        if (bandwidth, kappa) == own and best.design is not design:
            break  # one that was given has led to a design: these are climbed from where none does
        if bandwidth < least_bandwidth:
            continue
        begin = in_problem_units(problem, np.array(kappa))
        start = model.at(np.append(begin, np.log(bandwidth / w0)))
        if start is None:
            continue
        end, count = descend(model, start, first_hessian, problem.margin)
        steps += count
        made, conditions = _judged(problem, plants, sampling, end, design, floor)
        error = float(np.exp(end.value + REWARD * end.x[-1]))
        tell(f"{1e9 * error:.4g} nm RMS at {made.bandwidth / HZ:.2f} Hz, {count} steps: "
             f"{made.words}")  # fmt: skip
        if made.certified and error < best.error:
            direct = goal.to_theta(made.kappa, plants)
            envelope = envelope_of(problem, end.x[:-1], conditions, direct)
            if envelope is not None:
                envelope = envelope.times(error)
            best = replace(best, design=made, error=error, envelope=envelope)
    return replace(best, steps=steps)


def _judged(
    problem: LoopProblem,
    plants: Sequence[ScaledPlant],
    sampling: Sampling | None,
    end: Iterate[Assessment],
    design: SectionsDesign,
    floor: float,
) -> tuple[SectionsDesign, Optimality]:
    """The end as a design, certified by the judge, and its conditions of optimality."""
    structure, P = problem.structure, problem.plants
    inside, tau = end.x[:-1], float(end.x[-1])
    kappa = structure.in_units(inside, P.omega_0, P.force)
    controller = controller_of(structure, kappa)
    judged = certify(plants, controller, problem.bounds, sampling, integrator=structure.integrator)
    found = optimality(problem, Point(inside, tau, end.data), -end.gradient, floor)
    least = float(np.exp(floor)) * P.omega_0
    good = judged.passed and judged.bandwidth >= least / KEPT
    made = replace(
        design,
        outcome=SectionsOutcome.CERTIFIED if good else SectionsOutcome.NOT_CERTIFIED,
        words=judged.words,
        kappa=kappa,
        controller=controller,
        bandwidth=judged.bandwidth,
        certificate=judged,
        multipliers=found.named(),
        at_box=found.ends,
        kkt_residual=found.residual,
        short={},
    )
    return made, found
