"""The plants of a set that hold a search over θ and controller."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.codesign.joint_model import JointModel, JointModelOptions, JointPoint
from ccd_casadi.inner_problem.searched_problem import Scenario, state_of, with_state
from ccd_casadi.inner_problem.structured_plant_set import uncertain_plant
from ccd_casadi.inner_problem.structured_robustness import violations
from ccd_casadi.plants.plant import Evaluate
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.support.arrays import Array


@dataclass(frozen=True)
class WorkingSetOptions:
    """Numbers by which plants leave a working set."""

    most_plants: int = 12  # up to which all stay
    near: float = 0.1  # ln: below its bound, where a row counts, and between frequencies of a peak
    equal: float = 1e-6  # ln: rows that differ by rounding, as of rigid bodies alike


@dataclass(frozen=True)
class WorkingSet:
    """The plants of a set that count in a search.

    Attributes
    ----------
    sampler : Sampler
        Of the problem with the plants that count.
    aside : tuple of Scenario
        Plants that were left out, as others hold the controller.
    back : frozenset of Scenario
        Plants that came back from there: they stay.
    """

    sampler: Sampler
    aside: tuple[Scenario, ...] = ()
    back: frozenset[Scenario] = frozenset()

    @property
    def whole(self) -> "WorkingSet":
        """The set with the plants set aside too: at an end plants that bind in turns would bring
        each other back."""
        return WorkingSet(with_scenarios(self.sampler, self.aside)) if self.aside else self

    def reduce(
        self,
        models: Sequence[Evaluate],
        at: JointPoint,
        options: WorkingSetOptions = WorkingSetOptions(),
    ) -> "WorkingSet":
        """Drop the plants that do not hold the controller there, but keep the model."""
        problem = self.sampler.problem
        scenarios = state_of(problem).scenarios
        if len(scenarios) <= options.most_plants:
            return self
        here = JointModel(problem, models, at, 0.0).beginning
        if here is None:
            return self
        loops, peaks = here.data.loops, here.data.found.peaks
        assert peaks is not None
        near = np.flatnonzero(peaks.value > -options.near)
        rows = peaks.only(near[np.argsort(-peaks.value[near], kind="stable")])
        gains = np.column_stack([rows.curve, loops.gains_of(rows)]).tolist()
        kept = holding(
            loops.plants_of(rows), list(map(tuple, gains)), np.log(rows.v), rows.value, options
        )
        # the first is the model, of which results and pages state figures
        kept |= {number for number, one in enumerate(scenarios) if not number or one in self.back}
        counted = tuple(one for number, one in enumerate(scenarios) if number in kept)
        aside = (one for number, one in enumerate(scenarios) if number not in kept)
        changed = with_state(problem, scenarios=counted)
        return WorkingSet(self.sampler.of(changed), (*self.aside, *aside), self.back)

    def on_worse_plants(
        self,
        models: Sequence[Evaluate],
        best: JointPoint,
        seeds: Sequence[int],
        within: float,
        report: Callable[[str], None] | None,
        count: int,
        options: JointModelOptions,
    ) -> tuple["WorkingSet", JointPoint, float]:
        """Add the plants on which the controller exceeds a bound; return the set, the controller
        adapted to it, and J there.

        `seeds`: the numbers of the searches for worse plants, one after the other, each elsewhere
        in the box, from a lattice of `count`; `within`: ln, by how much a plant may exceed."""
        sampler, aside, back, J = self.sampler, self.aside, self.back, np.inf
        for seed in seeds:
            problem, known = sampler.problem, [model(best.theta) for model in models]
            uncertain, kappa = uncertain_plant(problem, best.theta, known), np.array(best.kappa)
            scenarios = violations(
                problem,
                uncertain,
                kappa,
                best.bandwidth,
                seed,
                report,
                within,
                aside,
                count,
                workers=sampler.workers,
            )[1]
            if scenarios:
                sampler = with_scenarios(sampler, scenarios)
                back |= set(aside) & set(scenarios)
                aside = tuple(one for one in aside if one not in scenarios)
            model = JointModel(sampler.problem, models, best, 0.0, options=options)
            best, J = model.adapt()
            if not np.isfinite(J):
                break
        working = self if sampler is self.sampler else WorkingSet(sampler, aside, back)
        return working, best, J


def with_scenarios(sampler: Sampler, scenarios: Sequence[Scenario]) -> Sampler:
    """Add plants to the problem: on these what was found before is worth nothing.

    Parameters
    ----------
    sampler : Sampler
        Of the problem without them; its trace loses its values of J.
    scenarios : sequence of Scenario
        Plants by option and what differs, SI.

    Returns
    -------
    Sampler
        Of the problem that has them.
    """
    trace = sampler.trace
    trace[:] = [replace(item, bandwidth=np.nan, objective=np.nan) for item in trace]
    known = state_of(sampler.problem).scenarios
    return sampler.of(with_state(sampler.problem, scenarios=(*known, *scenarios)))


def holding(
    plants: np.ndarray,
    gains: Sequence[tuple[int, ...]],
    log_v: Array,
    value: Array,
    options: WorkingSetOptions = WorkingSetOptions(),
) -> set[int]:
    """Plants of rows, the largest first, without those whose every row is below one of a plant
    before it: of one gain, at a frequency that is `near`."""
    kept, seen = set[int](), defaultdict[tuple[int, ...], list[int]](list)
    of = [np.flatnonzero(plants == plant) for plant in range(plants.max(initial=-1) + 1)]
    for row, (plant, gain) in enumerate(zip(plants.tolist(), gains, strict=True)):
        above = [i for i in seen[gain] if value[i] >= value[row] - options.equal]
        if plant in kept or (np.abs(log_v[above] - log_v[row]) < options.near).any():
            continue
        kept.add(plant)
        for i in of[plant].tolist():
            seen[gains[i]].append(i)
    return kept
