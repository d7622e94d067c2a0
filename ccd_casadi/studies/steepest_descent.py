"""The paper's own method: nested steepest descent on a swept inner problem, the baseline.

The sweep is that of `baselines`. The gradient of J is the paper's equation (10),

    ∂J/∂θ = w1 ∂f/∂θ + w2 ∂ω_b/∂θ,
    ∂ω_b/∂θ = -(∂‖S‖₂/∂θ)/(∂‖S‖₂/∂ω_b)             (11, implicit functions)
    ∂‖S‖₂/∂p = Re(u1* ∂S/∂p v1)                     (12, 13: singular vectors)
    ∂S/∂θ = -(I+GK)⁻¹ (∂G/∂θ) K (I+GK)⁻¹            (14: K held fixed)
    ∂S/∂ω_b = -(I+GK)⁻¹ (G'K + GK') (I+GK)⁻¹        (15)

as `derivatives.Sensitivities.fixed_controller` gives it. The variant "total" has K move with θ.

What the paper leaves open, and what is done here: θ is scaled to the unit box; a step goes along
-∇J/‖∇J‖∞ with length α, projected on the bounds; α is halved when the step does not improve J,
and the descent ends when α falls under `smallest_step` of the box, when the projected gradient
vanishes, or after `max_iterations`. The synthesis, its certificate, S_max and the case are ours.

With a controller of fixed structure nothing is swept: ω_b*(θ) is that of the problem's warm starts,
and its envelope gradient the only one there is.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from time import perf_counter

import numpy as np

from ccd_casadi.inner_problem.objective import hardware_at, objective
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.studies.baselines import AnyDesign, Gradient, baseline_of


class Stop(StrEnum):
    """Why a descent ended."""

    SMALL_STEP = "no step down to the smallest improves J"
    STATIONARY = "the projected gradient vanishes"
    ITERATIONS = "the iteration limit"
    INFEASIBLE = "no design meets the bounds at the start"
    NO_GRADIENT = "the controller there is not optimal enough to have a gradient"


@dataclass(frozen=True)
class DescentIterate:
    """One accepted point: θ, swept optimum (rad/s), J, ∂J/∂θ in the unit box, α, cost so far.

    ω_S and ω_T are NaN where the controller is of fixed structure.
    """

    theta: tuple[float, ...]
    omega_S: float
    omega_T: float
    bandwidth: float
    objective: float
    gradient: tuple[float, ...]
    step: float
    syntheses: int


@dataclass(frozen=True)
class Descent:
    """A whole descent: its history, its last design, and why it ended."""

    gradient: Gradient
    start: tuple[float, ...]
    first_step: float
    iterates: tuple[DescentIterate, ...]
    design: AnyDesign | None
    stop: Stop
    syntheses: int
    seconds: float

    @property
    def objective(self) -> float:
        """J at the end; infinite where no feasible start was found."""
        return self.iterates[-1].objective if self.iterates else np.inf


def steepest_descent(
    problem: CoDesignProblem,
    start: Sequence[float],
    gradient: Gradient = Gradient.FIXED,
    first_step: float = 0.05,
    max_iterations: int = 100,
    smallest_step: float = 1e-3,
) -> Descent:
    """Descend from `start`; steps are shares of the box of θ. Sections have a total gradient."""
    lower, upper = np.array(problem.lower), np.array(problem.upper)
    width = upper - lower
    began, baseline, theta = perf_counter(), baseline_of(problem), np.array(start, float)
    step, history, stop = first_step, list[DescentIterate](), Stop.ITERATIONS
    answer, spent = baseline.answer(theta, gradient, None)
    for _ in range(max_iterations):
        if answer is None:
            stop = Stop.INFEASIBLE
            break
        g = hardware_at(problem, theta).cost_gradient + problem.w2 * answer.slope * width
        J = objective(problem, theta, answer.value)
        places, slope = tuple(theta.tolist()), tuple(g.tolist())
        history.append(
            DescentIterate(places, *answer.frequencies, answer.bandwidth, J, slope, step, spent)
        )
        if not np.isfinite(g).all():
            stop = Stop.NO_GRADIENT
            break
        blocked = ((theta <= lower) & (g > 0.0)) | ((theta >= upper) & (g < 0.0))
        direction = np.where(blocked, 0.0, -g)
        size = float(np.abs(direction).max())
        if size <= 1e-9 * max(float(np.abs(g).max()), 1e-300):
            stop = Stop.STATIONARY
            break
        while step >= smallest_step:
            trial = np.clip(theta + step * direction / size * width, lower, upper)
            found, used = baseline.answer(trial, gradient, answer.frequencies)
            spent += used
            if found is not None and objective(problem, trial, found.value) < J:
                theta, answer = trial, found
                break
            step *= 0.5
        else:
            stop = Stop.SMALL_STEP
            break
    design = None if answer is None else answer.design
    seconds = perf_counter() - began
    return Descent(gradient, tuple(start), first_step, tuple(history), design, stop, spent, seconds)
