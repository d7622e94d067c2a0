"""Which flexible modes the plant keeps: a fixed number of each symmetry, or the lowest of all."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.case_studies.rib_stage.assembly import AS, SA
from ccd_casadi.case_studies.rib_stage.geometry import Geometry, Point, has_square_symmetry
from ccd_casadi.case_studies.rib_stage.stage_modes import (
    Discretisation,
    Group,
    GroupModes,
    StageModeOptions,
    group_modes,
    groups_of,
    spectrum,
)
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.worker_process import side_by_side


@dataclass(frozen=True)
class ModeCount:
    """How many flexible modes of each symmetry are kept; `tilt` counts pairs SA, AS.

    The default are the ten lowest of the stage of 0.59 kg and 110.5 Hz, and the cut leaves a gap
    of a tenth to the next mode of each symmetry; a third A1 mode would meet the fourth there
    (1782 and 1802 Hz). B1 and A2 rest on the diagonals of the square, so that actuators and
    sensors at the corners neither drive nor see them.
    """

    A1: int = 2
    B1: int = 1
    B2: int = 2
    A2: int = 1
    tilt: int = 2

    @property
    def total(self) -> int:
        """Flexible modes in all."""
        return self.A1 + self.B1 + self.B2 + self.A2 + 2 * self.tilt

    def of(self, group: Group) -> int:
        """Modes solved of a group of symmetries."""
        return sum(getattr(self, "tilt" if s in (SA, AS) else s.name) for s in group.solved)


TWENTY = ModeCount(A1=4, B1=2, B2=4, A2=2, tilt=4)  # to see spill-over
# To see what twenty hide: the lightest stages' modes up to 3.4 kHz, with a payload too.
FORTY_FOUR = ModeCount(A1=8, B1=6, B2=8, A2=6, tilt=8)


@dataclass(frozen=True)
class Mode:
    """Where a column of the model comes from: group, place in it, image; frequency in Hz."""

    name: str  # symmetry: z, tip, tilt, A1, B1, B2, A2, SA, AS, or "-" without symmetry
    sector: str  # SS, SA, AS, AA, or "-"
    frequency: float
    group: int = -1
    place: int = -1
    image: int = -1


@dataclass(frozen=True)
class ModeSet:
    """The modes solved at one θ and the flexible ones kept of them, in the model's order."""

    spectra: tuple[GroupModes, ...]
    flexible: tuple[Mode, ...]

    def kept(self, group: int) -> int:
        """How many of the lowest modes of a spectrum are in the model."""
        return 1 + max((m.place for m in self.flexible if m.group == group), default=-1)


def faded(values: Array, slopes: Array, full: int) -> tuple[Array, Array]:
    """What is left of displacements of the modes of a group, and its slopes (θ, k).

    `values` (k + 1,) and `slopes` (θ, k + 1) are λ of k modes that are kept and of the next one, b;
    the first `full` count whole, a being the last of these, the others by

        w = t²(3 - 2t),   t = (λ_b - λ)/(λ_b - λ_a).

    Modes that nearly meet change places: w is one where a does with the next, and zero at b.
    """
    a, b = full - 1, len(values) - 1
    span, slope = values[b] - values[a], (slopes[:, b] - slopes[:, a])[:, None]
    t = np.minimum((values[b] - values[:b]) / span, 1.0)
    dt = np.where(t < 1.0, (slopes[:, b, None] - slopes[:, :b] - t * slope) / span, 0.0)
    return t * t * (3.0 - 2.0 * t), 6.0 * t * (1.0 - t) * dt


def solve_modes(
    disc: Discretisation,
    geometry: Geometry,
    theta: Array,
    count: ModeCount,
    by_frequency: bool,
    fading: int = 0,
    points: Sequence[Point] = (),
) -> ModeSet:
    """Solve every symmetry (or direct sums of them) at θ and choose the modes of the model.

    By symmetry the order is A1, B1, B2, A2, then SA and AS in turns, or the even and the odd ones
    about an axis, lowest first in each: it does not change where frequencies of different
    symmetries cross. So many `fading` ones of every group follow. With `points` they have slopes of
    displacements there, made beside their factorisations: all of these at once are large.
    """
    square = has_square_symmetry(geometry)
    wanted = {}
    for group in groups_of(geometry):
        number = count.of(group)
        if by_frequency:  # no symmetry of the square has more than half of the lowest
            number = max(count.total // 2, 1) if square else count.total
        if number:
            wanted[group] = number
    boxes = disc.assembler.box_matrices(theta, StageModeOptions.shift)

    def solved(group: Group) -> GroupModes:
        keep = wanted[group] + fading
        found = spectrum(disc, geometry, theta, group, keep + StageModeOptions.extra, boxes)
        return group_modes(disc, geometry, found, keep + bool(fading), points)

    largest_first = list(wanted)[::-1]  # the tilts have twice as many displacements as the others
    found = dict(zip(largest_first, side_by_side(solved, largest_first), strict=True))
    spectra = tuple(found[group] for group in wanted)
    flexible = [
        _mode(item, index, place, image)
        for first in (True, False)
        for index, (item, number) in enumerate(zip(spectra, wanted.values(), strict=True))
        for place in (range(number) if first else range(number, number + fading))
        for image in range(len(item.group.images))
    ]
    if by_frequency:
        flexible = sorted(flexible, key=lambda mode: mode.frequency)[: count.total]
    return ModeSet(spectra, tuple(flexible))


def _mode(item: GroupModes, group: int, place: int, image: int) -> Mode:
    symmetries = item.group.images[image]
    known = len(symmetries) == 1
    hertz = float(np.sqrt(item.values[place]) / (2.0 * np.pi))
    name, sector = (symmetries[0].name, symmetries[0].sector) if known else ("-", "-")
    return Mode(name, sector, hertz, group, place, image)
