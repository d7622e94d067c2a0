"""Robust synthesis without a co-design: the set grows by the worst plants until none is left."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.fixed_structure.bounds import Bounds
from ccd_casadi.fixed_structure.box_proof import Proof, prove
from ccd_casadi.fixed_structure.certificate import SetCertificate, certify
from ccd_casadi.fixed_structure.channel_design import synthesise_sections as synthesise
from ccd_casadi.fixed_structure.design import SectionsDesign
from ccd_casadi.fixed_structure.structure import Structure
from ccd_casadi.fixed_structure.uncertainty import UncertainPlant
from ccd_casadi.fixed_structure.worst_plant import (
    Excess,
    LoopOnBox,
    WorstPlantOptions,
    lattice,
    worst_plants,
)
from ccd_casadi.lti.loop import Sampling
from ccd_casadi.support.arrays import Array

AT_ONCE = 3  # plants added in one round


@dataclass(frozen=True)
class RobustDesign:
    """A design on a set of plants that the search found; the judge's certificate is of a lattice
    and the worst plant, `proof` of the whole box."""

    design: SectionsDesign
    added: tuple[tuple[int, Array], ...]
    certificate: SetCertificate | None
    proof: Proof | None

    @property
    def certified(self) -> bool:
        """On every plant that was looked at."""
        return self.design.certified and self.certificate is not None and self.certificate.passed


def synthesise_robustly(
    uncertain: UncertainPlant,
    structure: Structure,
    bounds: Bounds,
    *,
    sampling: Sampling | None = None,
    starts: int = 12,
    seed: int = 0,
    rounds: int = 8,
    count: int = WorstPlantOptions.lattice,
) -> RobustDesign:
    """max ω_b with every bound on every plant of a box, as far as searches find none that fails.

    The set starts with the models and the corners of the box. Each round designs on the set,
    searches the worst plants from the worst of `count`, and adds those that exceed a bound.
    """
    members, turn = uncertain.corners(), 0
    made = synthesise(
        uncertain.plants(members), structure, bounds, sampling=sampling, starts=starts, seed=seed
    )
    worst = Excess(0, uncertain.nominal, np.nan)
    while made.certified:
        loop = LoopOnBox(uncertain, structure, made.kappa, made.bandwidth, bounds, sampling)
        heads, _ = worst_plants(loop, seed + turn, count)
        worst = heads[0]
        turn += 1
        if worst.value <= WorstPlantOptions.within or turn > rounds:
            break
        members = members + _apart(heads, members, uncertain.box)
        made = synthesise(uncertain.plants(members), structure, bounds, sampling=sampling,
                          seed=seed, initial=[made.kappa], only_initial=True)  # fmt: skip
    judged: SetCertificate | None = None
    proof: Proof | None = None
    if made.certified and made.controller is not None:
        points = [*lattice(uncertain, count, seed + 1000), (worst.option, worst.point)]
        looser = bounds.looser(2.0 * WorstPlantOptions.within)
        judged = certify(uncertain.plants(points), made.controller, looser, sampling,
                         integrator=structure.integrator)  # fmt: skip
        proof = prove(uncertain, structure, made.kappa, made.bandwidth, bounds, sampling)
    return RobustDesign(made, tuple(members), judged, proof)


def _apart(
    heads: Sequence[Excess], members: Sequence[tuple[int, Array]], box: Array
) -> list[tuple[int, Array]]:
    """Of the plants that pass a bound some, each away from the others and from what is there."""
    width = np.maximum(box[1] - box[0], 1e-300)
    found: list[tuple[int, Array]] = []
    for head in heads:
        near = [np.abs((head.point - point) / width).max(initial=0.0) for option, point in
                (*members, *found) if option == head.option]  # fmt: skip
        apart = not near or min(near) > 1e-4
        if head.value > WorstPlantOptions.within and apart and len(found) < AT_ONCE:
            found.append((head.option, head.point))
    return found
