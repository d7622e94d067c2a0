"""Retraining of a run folder: true samples where they help the optimum most, then a new fit.

A job fits all that the folder's store knows and goes on with the rounds of the folder's own
formulation: predict the optimum, ask the truth there, fit again, until prediction and truth agree.
What is left to do follows from the samples alone, so that a killed job goes on from what is known
and a repeated one computes nothing. The surrogate that a job ends with is kept as a new version.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.cases.run_folder import read_json
from ccd_casadi.cases.tables import Case
from ccd_casadi.cases.toml_writer import case_to_toml
from ccd_casadi.codesign.formulation import FormulationResult, KnownSamples, Terms, outputs_of
from ccd_casadi.codesign.formulations import Direct, formulation_of
from ccd_casadi.codesign.outer import Outer
from ccd_casadi.codesign.outer_problem import unmet_constraint
from ccd_casadi.codesign.search import conclude_at
from ccd_casadi.codesign.stored import keep_version, stored_designs, stored_thetas
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem.problem import box
from ccd_casadi.optim.box import Box
from ccd_casadi.sampling.rows import problem_hash
from ccd_casadi.sampling.samples import InnerSample, QuantitySample, quantity_sample
from ccd_casadi.sampling.spent import spent_entry
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from surrogates import sobol

PER_INPUT = 3  # samples an input that a first fit is worth
DOUBLINGS = 4  # of the first design, where the truth has no value at most points
NEAR = 1e-4  # of the box: of samples nearer than that the first counts
ROUNDS = 24  # of one job at most
NOTHING_NEW = "nothing new"


@dataclass(frozen=True)
class Outcome:
    """How a job ended; spent: syntheses since the first job on this run folder began."""

    status: str
    reason: str
    rounds: int
    spent: int
    version: str | None


@dataclass(frozen=True)
class Job:
    """One job on a run folder that was solved by `formulation`, or is to be.

    `budget`: syntheses that retraining may add to the folder, over all its jobs; `base`: those
    before the first. `tolerance` (relative): of prediction and truth, by default the case's.
    """

    folder: Path
    case: Case
    outer: Outer
    formulation: str
    base: int
    budget: int = 500
    tolerance: float | None = None
    seed: int = 0

    @property
    def spent(self) -> int:
        """Syntheses in the store, of whatever job."""
        sampler = self.outer.sampler
        return sampler.store.count(sampler.hash)

    @property
    def left(self) -> int:
        """Of the budget."""
        return self.budget - (self.spent - self.base)

    @property
    def over_theta(self) -> bool:
        """Whether x = θ: what is sampled is a whole inner problem."""
        return self.formulation == "nested" or not self.outer.extra_variables

    def run(self, write: Callable[[Solution], object]) -> Outcome:
        """To its end; `write` puts a solution into the folder.

        Raises UserError where the budget is too small for a first fit.
        """
        mark: dict[str, Any] = {
            "case": problem_hash({"text": case_to_toml(self.case)}),
            "tolerance": self.case.outer.tolerance if self.tolerance is None else self.tolerance,
        }
        known = self._ended_before(mark)
        if known is not None:
            return known
        outer, sampler = self.outer, self.outer.sampler
        terms = Terms(self.formulation, mark["tolerance"], self.seed)
        words = unmet_constraint(sampler.problem, self.case.outer.starts, self.seed)
        outcome = FormulationResult(message=words)
        if not words:
            outcome = self._trained(terms.tolerance)
            if outcome.x is None:
                outcome = outer.fallback(outcome, self.seed)
        solution = conclude_at(outer, outcome, terms)
        version = self._kept(outcome)
        reason = "converged" if outcome.agreed else "budget" if self.left <= 0 else "rounds"
        retraining = mark | {"version": version, "samples": self.spent, "reason": reason}
        solution.result.update(spent_entry({"store": self.spent}), retraining=retraining)
        write(solution)
        status, rounds = str(solution.result["status"]), len(outcome.iterates)
        return Outcome(status, reason, rounds, self.spent - self.base, version)

    def _ended_before(self, mark: dict[str, Any]) -> Outcome | None:
        """What an earlier job ended with, where there is nothing left to do."""
        path = self.folder / "result.json"
        if not path.exists() or not (self.folder / "report.html").exists():
            return None
        found = read_json(path)
        before = found.get("retraining")
        if not isinstance(before, dict) or before.get("samples") != self.spent:
            return None
        same = all(before.get(name) == value for name, value in mark.items())
        if not same or (before.get("reason") != "converged" and self.left > 0):
            return None
        return Outcome(str(found.get("status")), NOTHING_NEW, 0, self.spent - self.base,
                       before.get("version"))  # fmt: skip

    def _trained(self, tolerance: float) -> FormulationResult:
        """Rounds of the formulation from what is known, as many as the budget allows."""
        name = "nested" if self.formulation == "nested" else "lifted"  # direct has no surrogates
        given = self._known()
        if given is None:
            words = "too few points where the truth has a value"
            return FormulationResult(message=words)
        sampled = 2 * len(self.outer.problem.names) + 2 if self.over_theta else 1
        rounds = min(int(self.left / (self._cost(len(given)) * sampled)), ROUNDS)
        options = formulation_of(self.case, name)
        assert not isinstance(options, Direct)
        options = replace(options, tolerance=tolerance, max_refinements=max(rounds - 1, 0))
        return self.outer.solve_formulation(options, self.seed, given)

    def _cost(self, samples: int) -> float:
        """Syntheses a sample, as far as is known of whole inner problems."""
        return max(self.spent, 1) / max(samples, 1) if self.over_theta else 1.0

    def _known(self) -> KnownSamples | None:
        """What the store holds within the bounds, a first design added where that is too little.

        None where the truth has no value at most of its points. Raises UserError where the budget
        is too small for it.
        """
        bounds = box(self.outer.problem) if self.over_theta else self.outer.bounds
        n, seen = len(bounds.lower), self._stored()
        least = PER_INPUT * n
        for doubling in range(DOUBLINGS):
            if len(_usable(seen)) >= least:
                break
            X = sobol(*bounds, least << doubling, self.seed)
            new = X[_distances(X, seen, bounds) > NEAR]
            room = max(int(np.ceil(self.left / self._cost(len(seen)))), 0)
            seen += self._truth(new[:room])
        kept: list[Seen] = []
        for sample in _usable(seen):
            if _distances(np.array([sample.x]), kept, bounds)[0] > NEAR:
                kept.append(sample)
        if len(kept) < n + 2:
            if len(seen) >= least:
                return None
            words = f"leaves {len(kept)} samples, too few for a first fit; give a larger one"
            raise UserError(f"--budget {self.budget} {words}")
        return kept

    def _stored(self) -> "list[Seen]":
        """Samples of the store within the bounds, oldest first, failures among them."""
        store, problem = self.outer.sampler.store, self.outer.problem
        if self.over_theta:
            return self._truth(stored_thetas(store, problem))
        designs = stored_designs(store, problem)
        return [quantity_sample(tuple(x), row, problem.inner) for x, row in designs]

    def _truth(self, X: Array) -> "list[Seen]":
        """At X (m, d), what is known already from the store."""
        sampler = self.outer.sampler
        return [*(sampler.values if self.over_theta else sampler.quantities)(X, "retraining")]

    def _kept(self, outcome: FormulationResult) -> str | None:
        """The name of the version that the job's surrogate is kept as."""
        if not outcome.surrogates:
            return None
        units = outputs_of(self.outer.problem.figure)
        outputs = list(units)[: len(outcome.surrogates)]
        pairs = zip(outputs, outcome.surrogates, strict=True)
        last = outcome.iterates[-1] if outcome.iterates else None
        return keep_version(
            self.folder,
            outcome.surrogates,
            {"formulation": "nested" if self.formulation == "nested" else "lifted",
             "outputs": outputs, "units": [units[name] for name in outputs]},
            samples=len(outcome.surrogates[0].X),
            errors={name: asdict(process.loo) for name, process in pairs},
            at_optimum=last.error if last and np.isfinite(last.error) else None,
            objective=last.predicted_objective if last else None,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
        )  # fmt: skip


Seen = InnerSample | QuantitySample


def _usable(samples: list[Seen]) -> list[Seen]:
    """Those with a value."""
    return [s for s in samples if (s.feasible if isinstance(s, InnerSample) else s.certified)]


def _distances(X: Array, others: list[Seen], bounds: Box) -> Array:
    """Of X (m, d) to the nearest of the samples, the largest component in shares of the box."""
    known = np.reshape([sample.x for sample in others], (-1, X.shape[1]))
    return np.asarray(bounds.away(X[:, None], known).min(axis=1, initial=np.inf))
