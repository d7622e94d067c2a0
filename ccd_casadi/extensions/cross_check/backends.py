"""Mixed sensitivity by any back end, every design judged by the same certificate.

A back end answers for the standard plant of H∞ control,

    ẋ = A x + B1 w + B2 u,   z = C1 x + D11 w + D12 u,   y = C2 x + D21 w + D22 u,   u = K y

`riccati` is the package's own, in mixed sensitivity for plants without poles on the axis; `slicot`
(SB10AD) serves any standard plant; `tests/oracles/lmi.py` is a third one.

SLICOT's SB10AD: two Riccati equations (Glover & Doyle 1988). It accepts a γ when its Riccati solver
reports no error and the loop is stable; it tests neither X >= 0 nor the norm. Its γ is therefore
only a search variable: a design counts where the certificate passes. By default it starts at 1e100
and descends in steps of 0.1, which does not end; here it bisects from a finite γ. It is Fortran
that nothing can interrupt: `synthesise_with` takes a process that is killed after a limit.
"""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import slycot

from ccd_casadi.kernels.certified_design import CertifiedDesignOptions
from ccd_casadi.kernels.generalized_plant import generalized_plant
from ccd_casadi.kernels.riccati_synthesis import four_block_plant
from ccd_casadi.lti.state_space import StateSpace, balance_system
from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.worker_process import Overrun, Runner
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import Design, synthesise
from ccd_casadi.synthesis.weights import Weights

BISECT, SUBOPTIMAL = 1, 4  # SB10AD's jobs


@dataclass(frozen=True)
class BackendOptions:
    """Relative tolerances in the comparison of back ends."""

    agree: float = 1e-3  # distance from the least γ that counts as none: of interior-point methods
    below: float = 1e-6  # distance below the lower bound from which a claim is wrong


@dataclass(frozen=True)
class StandardPlant:
    """(A, [B1 B2], [C1; C2], [D11 D12; D21 D22]), partitioned."""

    A: Array
    B1: Array
    B2: Array
    C1: Array
    C2: Array
    D11: Array
    D12: Array
    D21: Array
    D22: Array

    def whole(self) -> StateSpace:
        """The plant as one state space."""
        return StateSpace(
            self.A,
            np.hstack([self.B1, self.B2]),
            np.vstack([self.C1, self.C2]),
            np.block([[self.D11, self.D12], [self.D21, self.D22]]),
        )


def mixed_sensitivity(plant: ScaledPlant, weights: Weights) -> StandardPlant:
    """[W_S S; W_KS KS; W_T T] as r to z, with y = e = r - Gu, in the plant's scaled units.

    With a disturbance d of size `weights.delta` at the plant's input, (r, d) to [W_S e; W_KS u;
    W_T u]: from d to u is T at the input.
    """
    p, m = len(plant.C), plant.B.shape[1]
    given = (plant.A, plant.B, plant.C, weights.scale(plant.omega_0))
    if weights.delta:
        A, B1, B2, C1, C2, D11, D12 = four_block_plant(*given, weights.delta)
        return StandardPlant(A, B1, B2, C1, C2, D11, D12, np.eye(p, p + m), np.zeros((p, m)))
    A, B1, B2, C1, C2, d1, d2 = generalized_plant(*given)
    D11, D12 = np.zeros((2 * p + m, p)), np.zeros((2 * p + m, m))
    D11[:p], D12[p : p + m] = d1 * np.eye(p), d2 * np.eye(m)
    return StandardPlant(A, B1, B2, C1, C2, D11, D12, np.eye(p), np.zeros((p, m)))


def balance(plant: StandardPlant) -> StandardPlant:
    """The same plant in balanced coordinates of its state."""
    whole = plant.whole()
    A, B, C = balance_system(whole.A, whole.B, whole.C)
    w, z = plant.D11.shape[1], len(plant.D11)
    return replace(plant, A=A, B1=B[:, :w], B2=B[:, w:], C1=C[:z], C2=C[z:])


@dataclass(frozen=True)
class Attempt:
    """γ_opt as the back end has it, and its controller from y to u that is to reach `gamma`.

    `controller` is None where there is none; `reason` then says why.
    """

    gamma_opt: float
    gamma: float
    controller: StateSpace | None
    reason: str = ""


Solver = Callable[..., Attempt]  # of (plant, gamma_backoff=): a controller at gamma_backoff γ_opt


def solve_slicot(
    plant: StandardPlant, *, gamma_backoff: float = 1.02, starts: tuple[float, ...] = (1e3, 1e6)
) -> Attempt:
    """Bisection for γ_opt (job 1), then a controller at gamma_backoff·γ_opt (job 4).

    It bisects from the first γ of `starts`; from the next where that is too low.
    """
    whole = balance(plant).whole()
    p, m = plant.C2.shape[0], plant.B2.shape[1]
    size = (len(whole.A), whole.B.shape[1], whole.C.shape[0], m, p)
    parts = (whole.A, whole.B, whole.C, whole.D)
    reason = ""
    for start in starts:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # ill-conditioning is for the certificate to judge
                found = slycot.sb10ad(*size, start, *parts, job=BISECT)
                gamma = gamma_backoff * float(found[0])
                made = slycot.sb10ad(*size, gamma, *parts, job=SUBOPTIMAL)
        except (slycot.exceptions.SlycotError, ValueError) as error:
            reason = " ".join(str(error).split()).rstrip(".")
            continue
        K = StateSpace(*(np.array(part) for part in made[1:5]))
        return Attempt(float(found[0]), gamma, K)
    return Attempt(np.nan, np.nan, None, reason[:1].lower() + reason[1:])


RICCATI, SLICOT = "riccati", "slicot"
SOLVERS: dict[str, Solver] = {SLICOT: solve_slicot}
TITLES = {RICCATI: "one Riccati (ours)", SLICOT: "SB10AD (slycot)"}


@dataclass(frozen=True)
class BackendResult:
    """The claim of a back end, and its design, measured."""

    backend: str
    gamma_opt: float  # as the back end claims it
    design: Design | None  # None where it made none
    words: str  # why there is no design, or the result of the certificate
    seconds: float
    holds: bool | None = None  # claim and design hold (`verdicts`); None: no claim

    @property
    def certified(self) -> bool:
        """Whether the design may be used."""
        return self.design is not None and self.design.figures.certified


def synthesise_with(
    backend: str,
    plant: ScaledPlant,
    weights: Weights,
    *,
    omega_low: float,
    gamma_backoff: float = 1.02,
    runner: Runner | None = None,
    limit: float = 60.0,
) -> BackendResult:
    """Synthesise with one back end and certify the result.

    Parameters
    ----------
    backend : str
        "riccati" or one of `SOLVERS`.
    plant : ScaledPlant
    weights : Weights
        SI.
    omega_low : float
        Frequency of `S_low`, rad/s.
    gamma_backoff : float
        The controller is synthesised at this multiple of γ_opt.
    runner : Runner, optional
        Process for one of `SOLVERS`, killed after `limit`.
    limit : float
        s.

    Returns
    -------
    BackendResult
    """
    began = time.perf_counter()
    if backend == RICCATI:
        design = synthesise(plant, weights, omega_low=omega_low, gamma_backoff=gamma_backoff)
        gamma_opt, words = design.figures.gamma_opt, design.figures.outcome.value
        return BackendResult(backend, gamma_opt, design, words, time.perf_counter() - began)
    # Free bodies are suspended in a synthesis; without that the norm of its loop is a little more.
    task = (SOLVERS[backend], mixed_sensitivity(plant.design_plant, weights), gamma_backoff)
    slack = 1.0 + CertifiedDesignOptions.freed if plant.family else 1.0
    try:
        attempt, seconds = _time(*task) if runner is None else runner.call(limit, _time, *task)
    except Overrun as error:
        attempt, seconds = Attempt(np.nan, np.nan, None, str(error)), time.perf_counter() - began
    K = attempt.controller
    if K is None:
        return BackendResult(backend, attempt.gamma_opt, None, attempt.reason, seconds)
    controller = replace(plant.controller_si(K.A, K.B, K.C), D=plant.force * K.D)
    figures = measure(
        plant, controller, weights,
        gamma=slack * attempt.gamma, omega_low=omega_low, gamma_opt=attempt.gamma_opt,
    )  # fmt: skip
    design = Design(figures, weights, controller)
    return BackendResult(backend, attempt.gamma_opt, design, figures.outcome.value, seconds)


def _time(solve: Solver, plant: StandardPlant, gamma_backoff: float) -> tuple[Attempt, float]:
    """The attempt and the seconds that it took."""
    began = time.perf_counter()
    attempt = solve(plant, gamma_backoff=gamma_backoff)
    return attempt, time.perf_counter() - began


def verdicts(
    results: Sequence[BackendResult], *, options: BackendOptions = BackendOptions()
) -> list[BackendResult]:
    """Check each claim by the certificates and by γ_jω, which no controller is below.

    A claim γ with its design is, the first that applies,

        γ < (1 - below) γ_jω          wrong
        the certificate not passed    not certified
        γ > (1 + agree) γ_least       certified, but above the least
        otherwise                     right

    with γ_jω of the package's own design ("riccati") and γ_least the least certified γ that is not
    wrong. Those without a design are returned as they are.
    """
    ours = next(item for item in results if item.backend == RICCATI)
    bound = math.nan if ours.design is None else ours.design.figures.gamma_lower_bound
    too_low = [item.gamma_opt < bound * (1.0 - options.below) for item in results]
    right = [item.gamma_opt for item, low in zip(results, too_low, strict=True)
             if item.certified and item.gamma_opt > 0.0 and not low]  # fmt: skip
    least = min(right, default=math.nan)
    checked = []
    for item, low in zip(results, too_low, strict=True):
        holds, words = False, "certified"
        if low:
            short = 100.0 * (1.0 - item.gamma_opt / bound)
            words = f"wrong: claims {short:.2g} % less than any controller reaches ({bound:.6g})"
        elif not item.certified:
            words = f"not certified: {item.words}"
        elif item.gamma_opt > least * (1.0 + options.agree):
            over = 100.0 * (item.gamma_opt / least - 1.0)
            words = f"certified, but {over:.2g} % above the least"
        else:
            holds = True
        checked.append(item if item.design is None else replace(item, holds=holds, words=words))
    return checked
