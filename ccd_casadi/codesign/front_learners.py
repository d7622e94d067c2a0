"""Surrogates that a walk along the trade-off learns from the truth, by kind of controller."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np

from ccd_casadi.codesign.lifted import MARGIN, REFIT, fit_quantities, update_quantities
from ccd_casadi.codesign.nested import fit_bandwidth
from ccd_casadi.codesign.outer_problem import (
    NonlinearProgram,
    lifted_bounds,
    lifted_program,
    nested_program,
)
from ccd_casadi.codesign.stored import stored_thetas
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample, QuantitySample
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from surrogates import GaussianProcess, design, to_casadi


class Learner(ABC):
    """Surrogates of the largest bandwidth at a θ, the first of them of the bandwidth itself."""

    def __init__(self, sampler: Sampler, samples: int = 0, seed: int = 0) -> None:
        """`samples` designs are sampled first; 0: six per variable."""
        self.sampler, self.seed = sampler, seed
        self.samples = samples or 6 * len(self.bounds[0])
        self.processes: tuple[GaussianProcess, ...] = ()

    @property
    @abstractmethod
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of x, which begins with θ."""

    @abstractmethod
    def begin(self, own: Array | None) -> None:
        """Sample and fit; `own` is a design to learn too. Raises UserError where too few of the
        designs are certified."""

    @abstractmethod
    def learn(self, x: Array, inner: Sequence[BandwidthSample]) -> None:
        """Points (k, n) that were predicted wrongly, and the true inner problems there."""

    @abstractmethod
    def program(self) -> NonlinearProgram:
        """The outer problem on the surrogates."""

    @abstractmethod
    def point(self, sample: BandwidthSample) -> Array:
        """x of a true inner problem's design."""

    def predicted(self, x: Array) -> float:
        """The bandwidth at x, rad/s."""
        return float(self.processes[0].predict(x[None, :])[0])

    def _require(self, known: int, of: int) -> None:
        if known <= len(self.bounds[0]):
            words = f"only {known} of {of} designs in the box were certified"
            raise UserError(f"no trade-off can be learnt: {words}; widen the bounds")


class LiftedLearner(Learner):
    """Of ω_b and what is bounded, over (θ, ln ω_S, ln ω_T)."""

    @property
    def bounds(self) -> tuple[Array, Array]:
        return lifted_bounds(self.sampler.problem)

    def begin(self, own: Array | None) -> None:
        points = design("sobol", *self.bounds, self.samples, self.seed)
        found = self.sampler.quantities(points if own is None else np.vstack([points, own]))
        self.known = [sample for sample in found if sample.certified]
        self._require(len(self.known), len(found))
        self._fit()

    def _fit(self) -> None:
        self.processes = fit_quantities(self.sampler.problem, self.known, self.seed)
        self.fitted = len(self.known)

    def learn(self, x: Array, inner: Sequence[BandwidthSample]) -> None:
        new = [sample for sample in self.sampler.quantities(x, "learning") if sample.certified]
        by_point: dict[tuple[float, ...], QuantitySample] = {s.x: s for s in (*self.known, *new)}
        self.known = list(by_point.values())
        if len(self.known) >= REFIT * self.fitted:
            self._fit()
        else:
            self.processes = update_quantities(self.sampler.problem, self.known, self.processes)

    def program(self) -> NonlinearProgram:
        made = to_casadi(self.processes, std=False)
        return lifted_program(self.sampler.problem, made, margin=MARGIN)

    def point(self, sample: BandwidthSample) -> Array:
        return sample.joint


class NestedLearner(Learner):
    """Of ω_b*(θ) with its envelope gradients; what the store holds of the problem is learnt."""

    @property
    def bounds(self) -> tuple[Array, Array]:
        return box(self.sampler.problem)

    def begin(self, own: Array | None) -> None:
        plan = design("sobol", *self.bounds, self.samples, self.seed)
        stored = stored_thetas(self.sampler.store, self.sampler.problem)
        thetas = np.vstack([*([] if own is None else [own[None]]), stored, plan])
        self.known: list[BandwidthSample] = []
        self._add(self.sampler.bandwidths(np.unique(thetas, axis=0)))
        self._require(len(self.known), len(thetas))
        self._fit()

    def _add(self, samples: Sequence[BandwidthSample]) -> None:
        self.known = list({s.theta: s for s in (*self.known, *samples) if s.feasible}.values())

    def _fit(self) -> None:
        fitted = fit_bandwidth(self.sampler.problem, self.known, self.seed, gradients=True)
        self.processes = (fitted,)

    def learn(self, x: Array, inner: Sequence[BandwidthSample]) -> None:
        self._add(inner)
        self._fit()

    def program(self) -> NonlinearProgram:
        return nested_program(self.sampler.problem, to_casadi(self.processes[0], std=False))

    def point(self, sample: BandwidthSample) -> Array:
        return np.array(sample.theta)
