"""A certified controller for any standard plant, or words for why there is none, in given time.

Plants come as other people have them: with poles and zeros on the axis, with controls that cost
nothing or measurements without noise. What no controller can do is said at once. The rest is
tried as it is where a Riccati solver may have it, and with ever larger small disturbances and
costs added where not; each controller is certified on the plant that was given.
"""

import time
from dataclasses import dataclass

from ccd_casadi.plants.scaling import StateSpace
from ccd_casadi.support.deadline import Overrun, Runner
from ccd_casadi.support.optional_packages import MissingPackage
from ccd_casadi.synthesis.backends.registry import GENERAL
from ccd_casadi.synthesis.backends.standard_plant import (
    StandardPlant,
    certify,
    irregularities,
    obstacles,
    regularised,
)
from ccd_casadi.synthesis.synthesis import Certificate

SIZES = (1e-6, 1e-4, 1e-2)  # of what is added, relative


@dataclass(frozen=True)
class StandardDesign:
    """The controller with the least certified norm; `reasons` says what failed on the way.

    `added` is the relative size of the disturbances and costs that its synthesis was given on
    top. Without a controller `certificate` is None and the reasons say why.
    """

    controller: StateSpace | None
    certificate: Certificate | None
    backend: str
    added: float
    gamma_opt: float
    reasons: tuple[str, ...]

    @property
    def certified(self) -> bool:
        """Whether there is a controller; only certified ones are handed out."""
        return self.controller is not None


def synthesise_standard(
    plant: StandardPlant,
    runner: Runner,
    *,
    limit: float = 10.0,
    gamma_backoff: float = 1.02,
) -> StandardDesign:
    """Try every back end that is installed, `limit` seconds in all; the best certified design."""
    reasons = list(obstacles(plant))
    if reasons:
        return StandardDesign(None, None, "", 0.0, float("nan"), tuple(reasons))
    reasons += irregularities(plant)
    sizes = SIZES if reasons else (0.0, *SIZES)
    end = time.monotonic() + limit
    best: StandardDesign | None = None
    for backend in GENERAL:
        try:
            solve = backend.solver()
        except MissingPackage as missing:
            reasons.append(str(missing))
            continue
        for size in sizes:
            left = end - time.monotonic()
            if left <= 0.0:
                reasons.append(f"{backend.name}: no time left")
                break
            given = regularised(plant, size) if size else plant
            try:
                found = runner.call(left, solve, given, gamma_backoff=gamma_backoff)
            except Overrun as overrun:
                reasons.append(f"{backend.name}: {overrun}")
                break
            if found.controller is None:
                reasons.append(f"{backend.name}: {found.reason}")
                continue
            proof = certify(plant, found.controller, found.gamma)
            if not proof.passed:
                what = "is not stable" if not proof.stable else f"has the norm {proof.norm:.4g}"
                reasons.append(f"{backend.name}: its loop {what}, claimed {found.gamma:.4g}")
                continue
            if best is None or best.certificate is None or proof.norm < best.certificate.norm:
                best = StandardDesign(
                    found.controller, proof, backend.name, size, found.gamma_opt, ()
                )
            break
    if best is None:
        return StandardDesign(None, None, "", 0.0, float("nan"), tuple(reasons))
    return StandardDesign(
        best.controller, best.certificate, best.backend, best.added, best.gamma_opt, tuple(reasons)
    )
