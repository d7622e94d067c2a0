"""The kind of inner problem with a controller of fixed structure."""

from collections.abc import Sequence

import numpy as np

from ccd_casadi.analysis.loop_view import Bounded
from ccd_casadi.fixed_structure.bounds import Bounds, ShapeEnd
from ccd_casadi.inner_problem.inner_kind import InnerKind
from ccd_casadi.inner_problem.searched_problem import state_of
from ccd_casadi.inner_problem.structured_bandwidth import structured_value
from ccd_casadi.inner_problem.structured_plant_set import bounds_of, plant_words_of, plants_of
from ccd_casadi.inner_problem.structured_problem import structured_of
from ccd_casadi.inner_problem.structured_robustness import BoxCheckOptions
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.text import HZ
from ccd_casadi.synthesis.weights import Weights


class FixedStructure(InnerKind):
    """Gain, notches, leads and roll-off on a set of plants, sampled or continuous.

    Attributes
    ----------
    problem : CoDesignProblem
        Others as those of `InnerKind`.
    """

    title = "Controller of sections (integrator, lead, notches, roll-off)"
    slack = BoxCheckOptions.looseness
    as_designed = True

    def value(self, theta: Sequence[float]) -> tuple[float, Array]:
        found = structured_value(self.problem, theta)
        return found.value, np.array(found.gradient)

    def describe(self) -> tuple[str, str]:
        sampling = self.problem.sampling
        runs = "in continuous time" if sampling is None else f"at {sampling.rate_hz:.5g} Hz"
        return "of fixed structure", runs

    def require_function(self) -> None:
        if not state_of(self.problem).warm_starts:
            words = "has no anchors yet; take that of a finished run, read_run(folder).problem"
            raise UserError(f"the problem of a fixed structure {words}")

    def plants(self, theta: Sequence[float]) -> list[ScaledPlant]:
        return plants_of(self.problem, theta)

    def plant_words(self, theta: Sequence[float]) -> list[str]:
        return plant_words_of(self.problem, theta)

    def bounds(self) -> Bounds:
        return bounds_of(self.problem)

    def common_shifts(self) -> tuple[float, float]:
        u = structured_of(self.problem).uncertainty
        low, high = ((1.0 + s * u.resonance_shift) * (1.0 + s * u.mode_shift) for s in (-1, 1))
        return low - 1.0, high - 1.0

    def other_factors(self) -> tuple[Sequence[float], Sequence[float]]:
        u = structured_of(self.problem).uncertainty
        return u.damping, (1.0 - u.gain, 1.0, 1.0 + u.gain)

    def gain_bounds(self, weights: Weights, gamma: float, bandwidth_hz: float) -> Bounded:
        """The shape, and weighted_level/|W| of KS (N/m) and T."""
        inner, structured = self.problem.inner, structured_of(self.problem)
        level, bounds = structured.weighted_level or np.nan, bounds_of(self.problem)

        def over(hz: Array) -> Array:
            size = np.abs(self.problem.weights.responses(HZ * hz))
            below = hz <= bandwidth_hz
            x = hz / bandwidth_hz
            room = np.nan if bounds.shape is None else bounds.room(x)
            rising = room * x * 2.0**-0.5
            most = np.where(below, np.fmin(rising, 2.0**-0.5), rising)
            counts = below | (structured.shape_ends is ShapeEnd.S_MAX)
            holds = counts & (most <= inner.S_max)
            return np.array([np.where(holds, most, np.nan), *(level / size[1:])])

        words = ("its shape", "weighted_level/|W_KS|", "weighted_level/|W_T|")
        return Bounded(inner.S_max, inner.S_low, inner.omega_low / HZ, over, words,
                       structured.compliance_max, True)  # fmt: skip
