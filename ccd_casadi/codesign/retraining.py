"""Retraining of a run folder: what it holds, and true samples where they help the optimum most."""

import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from ccd_casadi.cases.case import case_to_toml
from ccd_casadi.cases.run_folder import read_json
from ccd_casadi.cases.tables import Case
from ccd_casadi.codesign.formulations import Direct, formulation_of
from ccd_casadi.codesign.outer import Outer
from ccd_casadi.codesign.outer_problem import (
    FormulationResult,
    KnownSamples,
    RunTerms,
    lifted_bounds,
    outputs_of,
    unmet_constraint,
)
from ccd_casadi.codesign.outer_search import conclude_at
from ccd_casadi.codesign.verified import Solution
from ccd_casadi.inner_problem.problem import CoDesignProblem, box
from ccd_casadi.optim.pieces import Box
from ccd_casadi.sampling.inner_samples import (
    InnerSample,
    QuantitySample,
    quantity_sample,
    spent_entry,
)
from ccd_casadi.sampling.store import Sample, SampleStore
from ccd_casadi.sampling.units import hashes_of, problem_hash
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from surrogates import GaussianProcess, sobol
from surrogates.export import save
from surrogates.files import write_whole


def stored_designs(
    store: SampleStore, problem: CoDesignProblem, rounding: float = 1e-9
) -> list[tuple[Array, Sample]]:
    """Designs with derivatives inside the box as (x, row), x = (θ, ln ω_S, ln ω_T), oldest first.

    Designs that were not certified are among them. A point that went through a surrogate may be
    outside by the `rounding`, a share of the box.
    """
    bounds = lifted_bounds(problem)
    keys = store.keys_with_gradients(hashes_of(problem)[0])
    known, found = store.get(keys), []
    for item in keys:
        row = known.get(item)
        # an index that names a row which the table lacks is damage too
        if (
            row is None
            or len(row.theta) != len(problem.names)
            or len(row.gradients or ()) != (2 + len(problem.inner.bounds)) * len(bounds.lower)
        ):
            raise store.damaged_error()
        x = np.array([*row.theta, np.log(row.omega_S), np.log(row.omega_T)])
        inside = np.clip(x, *bounds)
        if bounds.away(x, inside) <= rounding:
            found.append((inside, row))
    return found


def stored_thetas(store: SampleStore, problem: CoDesignProblem) -> Array:
    """Every θ (n, n_θ) inside the box whose inner problem was solved, oldest first."""
    lower, upper = box(problem)
    thetas = store.thetas(hashes_of(problem)[1])
    if any(len(theta) != len(lower) for theta in thetas):
        raise store.damaged_error()
    X = np.array(thetas, dtype=float).reshape(-1, len(lower))
    return X[((lower <= X) & (upper >= X)).all(axis=1)]


FOLDER, NEWEST = "surrogates", "surrogate.json"
LOCK = "retrain.lock"  # a database that the job keeps locked, of what was spent before the first


@contextmanager
def only_job(run: Path, spent: int) -> Iterator[int]:
    """Hold a run folder, at most until the process ends.

    Parameters
    ----------
    run : Path
        The folder.
    spent : int
        Syntheses in its store, which count as those before the first job.

    Yields
    ------
    int
        Syntheses before the folder's first job.

    Raises
    ------
    UserError
        Another job holds the folder.
    """
    with ExitStack() as stack:
        try:
            connection = sqlite3.connect(run / LOCK, timeout=0.0, isolation_level=None)
            execute = stack.enter_context(closing(connection)).execute
            execute("pragma locking_mode = exclusive")  # beyond the commit
            execute("begin exclusive")
            execute("create table if not exists job (spent integer)")
            execute("insert into job select ? where not exists (select * from job)", [spent])
            (base,) = execute("select spent from job").fetchone()
            execute("commit")
        except sqlite3.DatabaseError as error:
            raise UserError(
                f"{run / LOCK}: {error}; wait for the job that retrains this folder, retrain a "
                "copy (--out), or where no job runs delete that file"
            ) from None
        yield int(base)


def version_names(run: Path) -> list[str]:
    """Names of all versions, oldest first."""
    found = [p.stem for p in (run / FOLDER).glob("*.json") if p.stem.isdecimal()]
    return sorted(found, key=int)


def keep_version(
    run: Path, surrogates: Sequence[GaussianProcess], extra: dict[str, Any], **facts: Any
) -> str:
    """Keep surrogates as the next version, child of the newest, and return its name.

    For the one job that holds the run folder.
    """
    (run / FOLDER).mkdir(exist_ok=True)
    parent = next(reversed(version_names(run)), None)
    name = f"{int(parent or 0) + 1:04d}"
    record = {"version": name, "parent": parent, **facts}
    save(surrogates, run / FOLDER / f"{name}.json", extra | {"version": record})
    publish(run)
    return name


def publish(run: Path) -> None:
    """Copy the newest version of the surrogates to surrogate.json.

    Parameters
    ----------
    run : Path
        A run folder with one version at least.
    """
    newest = (run / FOLDER / f"{version_names(run)[-1]}.json").read_bytes()
    target = run / NEWEST
    if not target.exists() or target.read_bytes() != newest:
        write_whole(target, newest)


NOTHING_NEW = "nothing new"


@dataclass(frozen=True)
class RetrainingOptions:
    """Numbers of a retraining job."""

    samples_per_input: int = 3  # from which a first fit is made
    doublings: int = 4  # of the first design, where the truth has no value at most points
    same: float = 1e-4  # of the box: of samples nearer than that the first counts
    rounds: int = 24  # of one job at most


@dataclass(frozen=True)
class RetrainingEnd:
    """The end of a job; spent: syntheses since the first job on this run folder began."""

    status: str
    reason: str
    rounds: int
    spent: int
    version: str | None


@dataclass(frozen=True)
class Job:
    """One retraining job on a run folder.

    Attributes
    ----------
    folder, case : Path, Case
        The run and its case.
    outer : Outer
        Its outer problem, on its store.
    formulation : str
        By which the run was solved, or is to be.
    base : int
        Syntheses before the folder's first job.
    budget : int
        Syntheses that retraining may add to the folder, over all its jobs.
    tolerance : float
        Relative, of prediction and truth; None: the case's.
    seed : int
        Of designs and fits.
    options : RetrainingOptions
        Numbers of the method.
    """

    folder: Path
    case: Case
    outer: Outer
    formulation: str
    base: int
    budget: int = 500
    tolerance: float | None = None
    seed: int = 0
    options: RetrainingOptions = RetrainingOptions()

    @property
    def spent(self) -> int:
        """Syntheses in the store, of whatever job."""
        sampler = self.outer.sampler
        return sampler.store.count(sampler.hash)

    @property
    def left(self) -> int:
        """The rest of the budget."""
        return self.budget - (self.spent - self.base)

    @property
    def over_theta(self) -> bool:
        """Whether x = θ: what is sampled is a whole inner problem."""
        return self.formulation == "nested" or not self.outer.extra_variables

    def run(self, write: Callable[[Solution], object]) -> RetrainingEnd:
        """Run the job to its end; `write` puts a solution into the folder.

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
        terms = RunTerms(self.formulation, mark["tolerance"], self.seed)
        words = unmet_constraint(sampler.problem, self.case.outer.starts, self.seed)
        outcome = FormulationResult(message=words)
        if not words:
            outcome = self._train(terms.tolerance)
            if outcome.x is None:
                outcome = outer.fallback(outcome, self.seed)
        solution = conclude_at(outer, outcome, terms)
        version = self._keep_surrogate(outcome)
        reason = "converged" if outcome.agreed else "budget" if self.left <= 0 else "rounds"
        retraining = mark | {"version": version, "samples": self.spent, "reason": reason}
        solution.result.update(spent_entry({"store": self.spent}), retraining=retraining)
        write(solution)
        status, rounds = str(solution.result["status"]), len(outcome.iterates)
        return RetrainingEnd(status, reason, rounds, self.spent - self.base, version)

    def _ended_before(self, mark: dict[str, Any]) -> RetrainingEnd | None:
        """Return the end of an earlier job, where there is nothing left to do."""
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
        return RetrainingEnd(str(found.get("status")), NOTHING_NEW, 0, self.spent - self.base,
                       before.get("version"))  # fmt: skip

    def _train(self, tolerance: float) -> FormulationResult:
        """Rounds of the formulation from what is known, as many as the budget allows."""
        name = "nested" if self.formulation == "nested" else "lifted"  # direct has no surrogates
        given = self._read_known()
        if given is None:
            words = "too few points where the truth has a value"
            return FormulationResult(message=words)
        sampled = 2 * len(self.outer.problem.names) + 2 if self.over_theta else 1
        rounds = min(int(self.left / (self._cost(len(given)) * sampled)), self.options.rounds)
        options = formulation_of(self.case, name)
        assert not isinstance(options, Direct)
        options = replace(options, tolerance=tolerance, max_refinements=max(rounds - 1, 0))
        return self.outer.solve_formulation(options, self.seed, given)

    def _cost(self, samples: int) -> float:
        """Syntheses a sample, as far as is known of whole inner problems."""
        return max(self.spent, 1) / max(samples, 1) if self.over_theta else 1.0

    def _read_known(self) -> KnownSamples | None:
        """Read what the store holds within the bounds, and add a first design where that is too
        little.

        None where the truth has no value at most of its points. Raises UserError where the budget
        is too small for it.
        """
        bounds = box(self.outer.problem) if self.over_theta else self.outer.bounds
        n, seen = len(bounds.lower), self._read_stored()
        least, same = self.options.samples_per_input * n, self.options.same
        for doubling in range(self.options.doublings):
            if len(_usable(seen)) >= least:
                break
            X = sobol(*bounds, least << doubling, self.seed)
            new = X[_distances(X, seen, bounds) > same]
            room = max(int(np.ceil(self.left / self._cost(len(seen)))), 0)
            seen += self._truth(new[:room])
        kept: list[Seen] = []
        for sample in _usable(seen):
            if _distances(np.array([sample.x]), kept, bounds)[0] > same:
                kept.append(sample)
        if len(kept) < n + 2:
            if len(seen) >= least:
                return None
            words = f"leaves {len(kept)} samples, too few for a first fit; give a larger one"
            raise UserError(f"--budget {self.budget} {words}")
        return kept

    def _read_stored(self) -> "list[Seen]":
        """Samples of the store within the bounds, oldest first, failures among them."""
        store, problem = self.outer.sampler.store, self.outer.problem
        if self.over_theta:
            return self._truth(stored_thetas(store, problem))
        designs = stored_designs(store, problem)
        return [quantity_sample(tuple(x), row, problem.inner) for x, row in designs]

    def _truth(self, X: Array) -> "list[Seen]":
        """Evaluate X (m, d), with what is known already from the store."""
        sampler = self.outer.sampler
        return [*(sampler.values if self.over_theta else sampler.quantities)(X, "retraining")]

    def _keep_surrogate(self, outcome: FormulationResult) -> str | None:
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
    """Select the samples with a value."""
    return [s for s in samples if (s.feasible if isinstance(s, InnerSample) else s.certified)]


def _distances(X: Array, others: list[Seen], bounds: Box) -> Array:
    """Return the distance of X (m, d) from the nearest of the samples: the largest component in
    shares of the box."""
    known = np.reshape([sample.x for sample in others], (-1, X.shape[1]))
    return np.asarray(bounds.away(X[:, None], known).min(axis=1, initial=np.inf))
