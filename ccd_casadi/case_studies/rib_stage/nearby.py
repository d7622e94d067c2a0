"""The stage around one θ by a reduced basis: Rayleigh and Ritz in what the modes span there.

Modes move smoothly with θ, so within a small box their span is little more than that of the modes
at as many θ as a polynomial of degree 2 has coefficients. In this basis V of a symmetry

    Vᵀ K(θ) V = Σ c_q(θ) Vᵀ K_q V,   Vᵀ M(θ) V likewise,

are small and cheap at every θ; what is left out is of third order in the size of the box. Nodes
move with θ, their numbers do not, so vectors of different θ may be combined.
(Noor and Peters 1980; Rozza, Huynh and Patera 2008.)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from ccd_casadi.case_studies.rib_stage.geometry import Point, has_square_symmetry
from ccd_casadi.case_studies.rib_stage.model import (
    RibStage,
    assembled,
    discretisation,
    points_of,
    rigid_part,
)
from ccd_casadi.case_studies.rib_stage.modes import (
    EXTRA,
    SQUARE_GROUPS,
    Discretisation,
    Group,
    functionals,
    sector_of,
    sign_functional,
    spectrum,
)
from ccd_casadi.case_studies.rib_stage.symmetry import Symmetry
from ccd_casadi.plants.plant import Mechanics
from ccd_casadi.support.arrays import Array

SAME = 1e-9  # share of the largest singular value below which a direction is known already


@dataclass(frozen=True)
class _Reduced:
    """A symmetry in its basis (r vectors): forms (boxes, 7, r, r), rigid and kept modes.

    `sign` (r,) is made positive for every mode; `seen` gives u_z at the points (p, r) of each
    image of the symmetry, at θ.
    """

    forms: Array
    rigid: int
    kept: int
    sign: Array
    seen: tuple[Callable[[Array], Array], ...]


def applies(stage: RibStage) -> bool:
    """Whether a stage has the symmetries, and the order of its modes, that this relies on."""
    return has_square_symmetry(stage.geometry) and (
        stage.truncation == "symmetry" and not stage.geometry.point_masses
    )


def places(theta: Sequence[float], reach: float, seed: int = 0) -> list[tuple[float, ...]]:
    """θ of the snapshots within ± reach (relative): the middle, the axes' ends, and at random."""
    middle = np.array(theta, float)
    d = middle.size
    star = np.vstack([np.zeros((1, d)), np.eye(d), -np.eye(d)])
    rest = np.random.default_rng(seed).uniform(-1.0, 1.0, (d * (d - 1) // 2, d))
    return [tuple((middle * (1.0 + reach * x)).tolist()) for x in np.vstack([star, rest])]


def numbered_snapshot(
    task: tuple[int, tuple[RibStage, tuple[float, ...]]],
) -> tuple[int, list[Array]]:
    """A snapshot behind its number: a unit of work."""
    return task[0], snapshot(*task[1])


def snapshot(stage: RibStage, theta: tuple[float, ...]) -> list[Array]:
    """Rigid and flexible modes of every symmetry at one θ, (n, k) each."""
    disc, here = discretisation(stage), np.array(theta)
    found = []
    for group in _groups(stage):
        item = spectrum(disc, stage.geometry, here, group, stage.modes.of(group) + EXTRA)
        found.append(np.hstack([item.rigid, item.vectors]))
    return found


def reduced(
    stage: RibStage, middle: Sequence[float], snapshots: Sequence[list[Array]]
) -> Callable[..., Mechanics]:
    """θ in the stage's order -> Mechanics without derivatives, near where the snapshots are."""
    disc, here = discretisation(stage), np.array(middle, float)
    points = points_of(stage)
    parts = []
    for group, vectors in zip(_groups(stage), zip(*snapshots, strict=True), strict=True):
        kept = stage.modes.of(group)
        rigid = vectors[0].shape[1] - kept - EXTRA
        left, size, _ = np.linalg.svd(np.hstack(vectors), full_matrices=False)
        basis = np.ascontiguousarray(left[:, size > SAME * size[0]])
        forms = disc.assembler.bilinear(sector_of(disc, group.solved[0]), basis, basis)
        sign = sign_functional(disc, group, here) @ basis
        seen = tuple(_seen(disc, image, here, points, basis) for image in group.images)
        parts.append(_Reduced(forms, rigid, kept, sign, seen))

    def evaluate(theta: Sequence[float]) -> Mechanics:
        return _evaluated(stage, tuple(parts), np.array(theta, float))

    return evaluate


def _seen(
    disc: Discretisation,
    image: Sequence[Symmetry],
    middle: Array,
    points: Sequence[Point],
    basis: Array,
) -> Callable[[Array], Array]:
    values, steps = functionals(disc, image, middle, points)
    if np.any(steps):
        return lambda theta: functionals(disc, image, theta, points)[0][:, 2].T @ basis
    fixed = values[:, 2].T @ basis  # corners stay on their nodes
    return lambda theta: fixed


def _groups(stage: RibStage) -> list[Group]:
    return [group for group in SQUARE_GROUPS if stage.modes.of(group)]


def _evaluated(stage: RibStage, parts: tuple[_Reduced, ...], theta: Array) -> Mechanics:
    """As `model.mechanics` puts its modes together: rigid ones first, then symmetry by symmetry."""
    c, _ = discretisation(stage).assembler.coefficients(theta)
    lam, rows = [], [rigid_part(stage, theta)]
    for part in parts:
        K = np.einsum("bq,bqij->ij", c[:, :6], part.forms[:, :6])
        M = np.einsum("b,bij->ij", c[:, 6], part.forms[:, 6])
        values, y = eigh(0.5 * (K + K.T), 0.5 * (M + M.T))
        y = y[:, part.rigid : part.rigid + part.kept]
        y = y * np.where(part.sign @ y < 0.0, -1.0, 1.0)
        images = [seen(theta) @ y for seen in part.seen]
        for place in range(part.kept):
            for image in images:  # a pair of modes of one frequency in turns
                lam.append(values[part.rigid + place])
                rows.append(image[:, place][None])
    return assembled(stage, np.array(lam), np.vstack(rows))
