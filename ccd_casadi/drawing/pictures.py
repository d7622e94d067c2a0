"""What a plant may show of itself: its surface with the shapes of its modes."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import number


@dataclass(frozen=True, eq=False)
class ModeShape:
    """Displacements (n, 3) of the surface's points in 1/√kg at a frequency in Hz.

    words: its name, if it has one. numbers: its places among the flexible modes, from 1; two where
    it stands for a pair of equal frequency. more: further figures of it, by what they are.
    """

    displacement: Array
    frequency: float
    numbers: tuple[int, ...]
    words: str = ""
    more: Mapping[str, float] = field(default_factory=dict)

    @property
    def places(self) -> str:
        """`4 and 5`."""
        return " and ".join(map(str, self.numbers))

    @property
    def title(self) -> str:
        """`4 and 5: bent tilt, a pair, 950.6 Hz`."""
        pair = ", a pair" if len(self.numbers) > 1 else ""
        words = f": {self.words}" if self.words else ""
        return f"{self.places}{words}{pair}, {number(self.frequency, 4)} Hz"


@dataclass(frozen=True, eq=False)
class ModeShapes:
    """Modes, lowest first, of a surface: points (n, 3) in m, faces (q, 4) of their numbers.

    Faces are counter-clockwise from outside; a triangle names its last corner twice. `view`: from
    where pictures see it.
    """

    points: Array
    faces: np.ndarray
    modes: tuple[ModeShape, ...]
    view: str = ""


def outer_faces(faces: np.ndarray) -> np.ndarray:
    """Of the faces (f, k) of all elements those that no second element has: the surface."""
    _, first, times = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    return faces[first[times == 1]]
