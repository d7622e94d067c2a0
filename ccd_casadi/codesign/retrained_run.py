"""The truth of a run folder, for a retraining job.

Lifted (and direct): x = (θ, ln ω_S, ln ω_T), y = (ω_b, ln‖S‖∞, ln σ_max(S(jω_low))) with gradients.
Nested: x = θ, y = v(θ), what J counts. A controller of fixed structure: the same, with gradients
where lifted, and by the anchors and the plant set that the run ended with.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np
from threadpoolctl import threadpool_limits

from ccd_casadi.cases.case import load_case
from ccd_casadi.cases.case_problem import problem_of
from ccd_casadi.cases.run_folder import read_json
from ccd_casadi.cases.sections import Case
from ccd_casadi.cases.toml_writer import case_to_toml
from ccd_casadi.codesign.formulation import FormulationResult
from ccd_casadi.codesign.lifted import OUTPUTS
from ccd_casadi.codesign.outer import Outer
from ccd_casadi.codesign.outer_problem import unmet_constraint
from ccd_casadi.codesign.run import outer_of, require_solvable
from ccd_casadi.codesign.run_files import write_run
from ccd_casadi.codesign.search import concluded_at
from ccd_casadi.codesign.solution import Solution
from ccd_casadi.codesign.stored import stored_designs, stored_thetas
from ccd_casadi.codesign.truth import Observations
from ccd_casadi.inner_problem.constraints import constraint_sizes
from ccd_casadi.inner_problem.problem import CoDesignProblem, box, plant_of
from ccd_casadi.sampling.cluster import pool
from ccd_casadi.sampling.keys import problem_hash
from ccd_casadi.sampling.sampler import Sampler
from ccd_casadi.sampling.samples import BandwidthSample, QuantitySample, quantity_sample
from ccd_casadi.sampling.spent import spent_entry
from ccd_casadi.sampling.store import SampleStore
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.errors import UserError
from ccd_casadi.support.process_pool import PATIENCE
from ccd_casadi.support.user_code import permit_user_code
from surrogates import GaussianProcess

PageWriter = Callable[[Path, Case, CoDesignProblem, Solution], object]
CLOSE = 1e-2  # of the box: a verified design so near is where the next verification starts


@contextmanager
def open_run(
    folder: Path,
    *,
    tolerance: float | None,
    workers: int,
    seed: int,
    quiet: bool,
    user_code: bool = True,
    scheduler: str | None = None,
    write_page: PageWriter,
) -> Iterator["CoDesignTruth"]:
    """The truth of a run folder; `write_page` draws its report. Raises UserError."""
    with threadpool_limits(limits=1), permit_user_code(user_code):
        case = load_case(folder / "case.toml")
        problem = problem_of(case)
        require_solvable(problem)
        formulation = _formulation(folder)
        with (
            pool(scheduler, workers, PATIENCE) as evaluators,
            SampleStore(folder / "samples.sqlite") as store,
        ):
            outer = outer_of(Sampler(problem, store, evaluators, quiet=quiet))
            outer = outer.continued(folder, seed)
            yield CoDesignTruth(folder, case, outer, formulation, write_page, tolerance, seed)


class CoDesignTruth:
    """One run's problem behind its store; see `truth.Truth`."""

    def __init__(
        self,
        folder: Path,
        case: Case,
        outer: Outer,
        formulation: str,
        write_page: PageWriter,
        tolerance: float | None = None,
        seed: int = 0,
    ) -> None:
        problem = outer.problem
        self.folder, self.case, self.outer, self.seed = folder, case, outer, seed
        self.sampler = outer.sampler
        self.write_page = write_page
        self.formulation = formulation
        beside = () if formulation == "nested" else outer.beside_theta
        self.over_theta = not beside  # x = θ
        more = () if self.over_theta else OUTPUTS[1 : 1 + len(problem.inner.bounds)]
        self.outputs = (problem.figure.key, *more)
        self.lower, self.upper = box(problem) if self.over_theta else outer.bounds
        self.tolerance = case.outer.tolerance if tolerance is None else tolerance
        self.objective, self.constraints = _functions(problem, len(self.lower), len(self.outputs))
        form = "nested" if formulation == "nested" else "lifted"  # direct has no surrogates
        self.describe = {"formulation": form, "outputs": list(self.outputs)}

    @property
    def spent(self) -> int:
        """Syntheses in the store, of whatever job."""
        return self.sampler.store.count(self.sampler.hash)

    def samples(self) -> Observations:
        """What the store holds inside the box, oldest first."""
        problem = self.sampler.problem
        if self.over_theta:
            known = stored_thetas(self.sampler.store, problem)
            return self._values(self.sampler.bandwidths(known) if len(known) else [])
        designs = stored_designs(self.sampler.store, problem)
        rows = [quantity_sample(tuple(x), row, problem.inner) for x, row in designs]
        return self._quantities(rows)

    def evaluate(self, X: Array) -> Observations:
        """New syntheses, through the store."""
        if self.over_theta:
            return self._values(self.sampler.bandwidths(X, "retraining"))
        return self._quantities(self.sampler.quantities(X, "retraining"))

    def finish(
        self, x: Array | None, surrogates: Sequence[GaussianProcess], version: str | None
    ) -> str:
        """Verify as `solve` does and rewrite the run folder, unless this was done already."""
        began = perf_counter()
        mark = {"case": problem_hash({"text": case_to_toml(self.case)}), "version": version,
                "tolerance": self.tolerance}  # fmt: skip
        before = self._before(mark)
        if before is not None and before["retraining"] == mark | {"x": before["retraining"]["x"]}:
            return str(before["status"])
        start = None if x is None else self._start(x, before)
        processes, outer = tuple(surrogates), self.outer
        outcome = FormulationResult(start, None, (), processes, None, True, "")
        if start is None:
            words = unmet_constraint(self.sampler.problem, self.case.outer.starts, self.seed)
            outcome = replace(outcome, message=words)
            if not words:
                outcome = outer.rescued(outcome, self.seed)
        solution = concluded_at(
            outer, outcome, self.formulation, self.tolerance, self.seed, began
        )
        result = solution.result
        result |= spent_entry({"store": self.spent})
        end = None if solution.verified is None else solution.verified.point
        result["retraining"] = mark | {"x": None if end is None else end.tolist()}
        write_run(self.folder, self.case, solution)
        self.write_page(self.folder, self.case, self.sampler.problem, solution)
        return str(result["status"])

    def _before(self, mark: dict[str, Any]) -> dict[str, Any] | None:
        """The result of an earlier verification of the same case."""
        try:
            found = json.loads((self.folder / "result.json").read_text())
            known = found["retraining"]["case"] == mark["case"]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return found if known and (self.folder / "report.html").exists() else None

    def _start(self, x: Array, before: dict[str, Any] | None) -> Array:
        """Where to verify: a point of the outer problem, or the verified design that is by it."""
        x = self.outer.point_at(x) if self.over_theta else x
        if before is not None and before["retraining"]["x"] is not None:
            old = np.array(before["retraining"]["x"])
            lower, upper = self.outer.bounds
            if np.abs((old - x) / (upper - lower)).max() <= CLOSE:
                return old
        return x

    def _quantities(self, samples: list[QuantitySample]) -> Observations:
        d, k = len(self.lower), len(self.outputs)
        X = np.array([s.x for s in samples]).reshape(-1, d)
        Y = np.array([s.values[:-1] for s in samples]).reshape(-1, k)
        dY = np.array([s.gradients[:-1] for s in samples]).reshape(-1, k, d)
        Y[[not s.certified for s in samples]] = np.nan
        return Observations(X, Y, dY)

    def _values(self, samples: list[BandwidthSample]) -> Observations:
        d = len(self.lower)
        X = np.array([s.theta for s in samples]).reshape(-1, d)
        Y = np.array([[s.value] for s in samples]).reshape(-1, 1)
        if self.formulation == "nested":
            return Observations(X, Y)
        dY = np.array([s.gradient for s in samples]).reshape(-1, 1, d)
        return Observations(X, Y, dY)


def _functions(problem: CoDesignProblem, d: int, k: int) -> tuple[ca.Function, ca.Function]:
    """J(x, y) = w1 f(θ) + w2 v, and g(x, y): ln of the bounds where lifted, and λ(θ)."""
    x, y = ca.MX.sym("x", d), ca.MX.sym("y", k)
    f, lam = plant_of(problem).hardware(x[: len(problem.names)])
    g = lam / ca.DM(constraint_sizes(problem)) if lam.numel() else ca.MX(0, 1)
    if k > 1:
        g = ca.vertcat(y[1:] - problem.inner.levels, g)
    J = ca.Function("objective", [x, y], [problem.w1 * f + problem.w2 * y[0]])
    return J, ca.Function("constraints", [x, y], [g])


def _formulation(folder: Path) -> str:
    """As truth.json says, else lifted."""
    path = folder / "truth.json"
    formulation = read_json(path).get("formulation", "lifted") if path.exists() else "lifted"
    if formulation not in ("nested", "lifted", "direct"):
        words = f"{formulation!r:.60} is unknown; give nested or lifted"
        raise UserError(f"{path}: formulation: {words}")
    return str(formulation)
