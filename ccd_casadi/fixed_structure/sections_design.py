"""A controller of fixed structure: the end of a search, judged and put in words."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from time import perf_counter

import numpy as np

from ccd_casadi.fixed_structure.certificate import SetCertificate, certify
from ccd_casadi.fixed_structure.channel_structure import ChannelStructure
from ccd_casadi.fixed_structure.local_search import Point, ascend
from ccd_casadi.fixed_structure.loop_problem import LoopProblem
from ccd_casadi.fixed_structure.optimality import optimality
from ccd_casadi.fixed_structure.race import LocalOptimum, Runner, finished, local_optima
from ccd_casadi.fixed_structure.structure import Kind, Structure
from ccd_casadi.lti.hold import Sampling
from ccd_casadi.lti.state_space import StateSpace
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.notebook import NotebookHtml
from ccd_casadi.support.process_pool import Pool
from ccd_casadi.support.progress import Tell, silent
from ccd_casadi.support.units import HZ, number

MARGIN = 1e-6  # in logarithms: what is designed lies so far within its bounds


class SectionsOutcome(StrEnum):
    """How a synthesis ended; only CERTIFIED designs are to be used."""

    CERTIFIED = "certified"
    NO_STABLE_START = "no start is stable on every plant of the set"
    BOUND_NOT_MET = "no controller was found that meets every bound"
    NOT_CERTIFIED = "the judge does not confirm what the search found"


@dataclass(frozen=True)
class SectionsDesign(NotebookHtml):
    """A controller of fixed structure, and how it was found; SI, frequencies in rad/s.

    Parameters
    ----------
    outcome, words : SectionsOutcome, str
        How it ended, and why.
    structure, kappa : Structure or ChannelStructure, array (p,)
        Sections of K; logarithms of their parameters in rad/s and N/m.
    frequencies : tuple of two floats
        Bounds of K's roots.
    controller : StateSpace or None
        K(s), e to force; of a sampled loop it is discretised by Tustin's rule without prewarping.
    bandwidth, certificate : float, Certificate or None
        ω_b that holds on every plant; what was judged.
    multipliers : dict
        By kind of bound: change of ln ω_b per ln of the bound.
    at_box, kkt_residual : tuple, float
        Parameters at their own bounds; how nearly the design is an optimum.
    short : dict
        Where no controller meets every bound: those that the nearest one misses, with the factor.
    local_optima, starts, evaluations, seed, seconds
        Of the search: where it ended, how often it started, loops, randomness, time.
    found : int or None
        How many of its own starts, apart from each other, led to its best; None: not counted.
    """

    outcome: SectionsOutcome
    words: str
    structure: Structure | ChannelStructure
    kappa: Array
    frequencies: tuple[float, float]
    controller: StateSpace | None
    bandwidth: float
    certificate: SetCertificate | None
    multipliers: dict[str, float]
    at_box: tuple[tuple[str, str, float], ...]
    kkt_residual: float
    short: dict[str, float]
    local_optima: tuple[LocalOptimum, ...]
    starts: int
    evaluations: int
    seed: int
    seconds: float
    found: int | None = None

    @property
    def certified(self) -> bool:
        """Whether the design may be used."""
        return self.outcome is SectionsOutcome.CERTIFIED


def in_problem_units(problem: LoopProblem, kappa: Array) -> Array:
    """SI parameters κ in the units of the problem."""
    P = problem.plants
    return problem.structure.in_units(np.asarray(kappa, float), 1.0 / P.omega_0, 1.0 / P.force)


def span_of(problem: LoopProblem) -> tuple[float, float]:
    """The bounds of frequencies of K's roots in rad/s."""
    index = problem.structure.kinds.index(Kind.FREQUENCY) if len(problem.box[0]) > 1 else 0
    low, high = np.exp(problem.box[:, index]) * problem.plants.omega_0
    return float(low), float(high)


@dataclass(frozen=True)
class DesignSearch:
    """A search for controllers on plants, with the options of `synthesise_sections`, and when it
    `began` (s of `perf_counter`)."""

    problem: LoopProblem
    plants: Sequence[ScaledPlant]
    sampling: Sampling | None
    starts: int = 0
    most_starts: int = 0
    seed: int = 0
    initial: Sequence[Array] = ()
    only_initial: bool = False
    tell: Tell = silent
    workers: Pool | None = None
    began: float = field(default_factory=perf_counter)

    def inside(self, kappas: Sequence[Array]) -> list[Array]:
        """Controllers κ in SI in the units of the problem and in its box."""
        return [np.clip(in_problem_units(self.problem, one), *self.problem.box) for one in kappas]

    def judged(self, inside: Array) -> tuple[Array, StateSpace, SetCertificate]:
        """κ in SI of one in the problem's units, its controller, and what the judge says of it."""
        structure, P = self.problem.structure, self.problem.plants
        kappa = structure.in_units(inside, P.omega_0, P.force)
        K = structure.state_space(kappa)
        return kappa, K, certify(self.plants, K, self.problem.bounds, self.sampling,
                                 integrator=structure.integrator, workers=self.workers)  # fmt: skip

    def designed(
        self, point: Point, optima: tuple[LocalOptimum, ...], starts: int, evaluations: int
    ) -> SectionsDesign:
        """The design at an end: certified where the judge confirms what the search found."""
        problem = self.problem
        kappa, controller, judged = self.judged(point.kappa)
        found = optimality(problem, point)
        bandwidth = float(np.exp(point.tau)) * problem.plants.omega_0
        short: dict[str, float] = {}
        peaks = point.assessment.peaks
        assert peaks is not None
        for name, value in zip(problem.kinds_of(peaks), peaks.value, strict=True):
            if value > 2.0 * MARGIN:
                short[name] = max(short.get(name, 0.0), float(np.exp(value)))
        outcome, words = SectionsOutcome.CERTIFIED, judged.words
        if short:
            outcome = SectionsOutcome.BOUND_NOT_MET
            missed = ", ".join(problem.bounds.missed(name, ratio) for name, ratio in short.items())
            words = f"none found from {starts} starts: the nearest controller misses {missed}"
        elif not judged.passed or abs(judged.bandwidth / bandwidth - 1.0) > 1e-3:
            outcome = SectionsOutcome.NOT_CERTIFIED
            words = f"judged {judged.bandwidth:.6g} rad/s, searched {bandwidth:.6g}: {judged.words}"
        if outcome is SectionsOutcome.CERTIFIED:
            bandwidth = min(bandwidth, judged.bandwidth)
        return SectionsDesign(
            outcome, words, problem.structure, kappa, span_of(problem), controller, bandwidth,
            judged, found.named(), found.ends, found.residual, short, optima, starts, evaluations,
            self.seed, perf_counter() - self.began,
        )  # fmt: skip

    def failed(
        self, outcome: SectionsOutcome = SectionsOutcome.NO_STABLE_START, words: str = ""
    ) -> SectionsDesign:
        """A design without a controller."""
        problem = self.problem
        nothing = np.full(len(problem.box[0]), np.nan)
        return SectionsDesign(
            outcome, words or outcome.value, problem.structure, nothing, span_of(problem), None,
            np.nan, None, {}, (), np.nan, {}, (), 0, 0, self.seed, perf_counter() - self.began,
        )  # fmt: skip

    def concluded(self, runners: Sequence[Runner], starts: int, spent: int = 0) -> SectionsDesign:
        """The best end that the judge confirms, brought within its bounds; `spent`: loops that were
        looked at before."""
        problem, ends = self.problem, finished(runners)
        evaluations = spent + sum(runner.evaluations for runner in runners)
        best: SectionsDesign | None = None
        optima = local_optima(problem, ends)
        for point in (runner.point for runner in ends):
            if point.assessment.violation > MARGIN:
                again = ascend(problem, point, iterations=30, restoring=True, radius=0.02)
                evaluations += again.evaluations
                point = again.point
            last = ascend(problem, point, iterations=25, radius=1e-3, least_radius=1e-10,
                          least_gain=1e-14)  # fmt: skip
            evaluations += last.evaluations
            made = self.designed(last.point, optima, starts, evaluations)
            if best is None or (made.certified and not best.certified):
                best = made
            if best.certified:
                break
        assert best is not None
        self.tell(f"{best.outcome.value}: {number(best.bandwidth / HZ, 4)} Hz")
        return best
