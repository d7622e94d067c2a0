"""Mixed sensitivity by any back end, every design judged by the same certificate."""

import time
from dataclasses import dataclass, replace

import numpy as np

from ccd_casadi.plants.scaling import ScaledPlant
from ccd_casadi.support.deadline import Overrun, Runner
from ccd_casadi.support.optional_packages import MissingPackage
from ccd_casadi.synthesis.backends.attempt import Attempt
from ccd_casadi.synthesis.backends.registry import LMI, SLICOT, Backend
from ccd_casadi.synthesis.backends.standard_plant import StandardPlant, mixed_sensitivity
from ccd_casadi.synthesis.closed_loop import measure
from ccd_casadi.synthesis.synthesis import Design, synthesise
from ccd_casadi.synthesis.weights import Weights

RICCATI = "riccati"
TITLES = {RICCATI: "one Riccati (ours)"} | {item.name: item.title for item in (SLICOT, LMI)}
_GENERAL = {item.name: item for item in (SLICOT, LMI)}


@dataclass(frozen=True)
class BackendResult:
    """γ_opt as the back end claims it, and its design, measured; None where it made none.

    `reason` says why there is no design, or how the certificate judged the one there is.
    """

    backend: str
    gamma_opt: float
    design: Design | None
    reason: str
    seconds: float

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
    """One synthesis by "riccati", "slicot" or "lmi", certified; ω_low in rad/s.

    With a `runner` the optional back ends run in its process and are killed after `limit`
    seconds. Raises MissingPackage where a package is not installed.
    """
    began = time.perf_counter()
    if backend == RICCATI:
        design = synthesise(plant, weights, omega_low=omega_low, gamma_backoff=gamma_backoff)
        gamma_opt, reason = design.figures.gamma_opt, design.figures.outcome.value
        return BackendResult(backend, gamma_opt, design, reason, time.perf_counter() - began)
    task = (_GENERAL[backend], mixed_sensitivity(plant, weights), gamma_backoff)
    try:
        attempt, seconds = _timed(*task) if runner is None else runner.call(limit, _timed, *task)
    except Overrun as overrun:
        attempt, seconds = Attempt(np.nan, np.nan, None, str(overrun)), limit
    K = attempt.controller
    if K is None:
        return BackendResult(backend, attempt.gamma_opt, None, attempt.reason, seconds)
    controller = replace(plant.controller_si(K.A, K.B, K.C), D=plant.force * K.D)
    figures = measure(
        plant, controller, weights,
        gamma=attempt.gamma, omega_low=omega_low, gamma_opt=attempt.gamma_opt,
    )  # fmt: skip
    design = Design(figures, weights, controller)
    return BackendResult(backend, attempt.gamma_opt, design, figures.outcome.value, seconds)


def _timed(backend: Backend, plant: StandardPlant, gamma_backoff: float) -> tuple[Attempt, float]:
    """The attempt and the seconds that it took, imports not counted."""
    solve = backend.solver()
    began = time.perf_counter()
    attempt = solve(plant, gamma_backoff=gamma_backoff)
    return attempt, time.perf_counter() - began


def every_backend(
    plant: ScaledPlant,
    weights: Weights,
    *,
    omega_low: float,
    gamma_backoff: float = 1.02,
    limit: float = 60.0,
) -> list[BackendResult]:
    """All back ends on one problem, a missing one as a result that says what is missing."""
    found = []
    with Runner() as runner:
        for backend in TITLES:
            try:
                result = synthesise_with(
                    backend, plant, weights, omega_low=omega_low, gamma_backoff=gamma_backoff,
                    runner=runner, limit=limit,
                )  # fmt: skip
            except MissingPackage as missing:
                result = BackendResult(backend, np.nan, None, str(missing), 0.0)
            found.append(result)
    return found
