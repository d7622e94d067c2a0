"""The Nyquist plot of L = GK with the disk that S_max keeps it out of: |1 + L| >= 1/S_max."""

from collections.abc import Sequence

import numpy as np
import scipy

from ccd_casadi.drawing.content import Area, Curve, Mark, Panel
from ccd_casadi.drawing.lines import BOTTOM, LEFT, RIGHT, TOP
from ccd_casadi.drawing.svg import GREEN, GREY, ORANGE, WIDTH
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import number

SHOWN = (-3.2, 1.6)  # of the real axis
EVERY, APART = 1.2, 0.3  # of arrows along a locus, and from each other and from the origin
HEAD = 0.13  # length of an arrow head
FAR = 30.0  # |L| beyond which a locus leaves the drawing


def nyquist_panel(
    hz: Array, loci: Sequence[np.ndarray], S_max: float, height: float = 3.0,
    names: tuple[str, str] = ("", ""), others: str = GREEN,
) -> Panel:  # fmt: skip
    """Loci (k,) complex over Hz, the first the model's; beside one other panel of this height in
    inches. `names`: of the first, and of the others. The first has its direction and frequencies.
    """
    circle = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 200))
    curves = [
        Curve(line.real, line.imag, names[1] * (i == 1), others, width=1.0, hz=hz) if i
        else Curve(line.real, line.imag, names[0] * (len(loci) > 1), width=1.6, hz=hz)
        for i, line in reversed(list(enumerate(loci)))
    ]  # fmt: skip
    disk = -1.0 + circle / S_max
    curves.append(Curve(disk.real, disk.imag, colour=ORANGE))
    curves.append(Curve(circle.real, circle.imag, colour=GREY, line=":", width=0.9))
    named = (Mark(-1.0 - 1.0 / S_max, 0.0, f"S_max {S_max:g}", "", ORANGE, (-8.0, 3.0)),
             Mark(0.5**0.5, 0.5**0.5, "|L| = 1", "", GREY, (8.0, 3.0)))  # fmt: skip
    wide, tall = 0.5 * WIDTH - LEFT - RIGHT, height - BOTTOM - TOP
    half = 0.5 * (SHOWN[1] - SHOWN[0]) * tall / wide  # a circle is round
    arrows, marks = _along(hz, loci[0], half)
    return Panel(
        "Re L (–)", "Im L (–)", (*curves, *arrows),
        marks=(Mark(-1.0, 0.0, marker="+"), *marks, *named),
        x_range=SHOWN, y_range=(-half, half),
        forbidden=(Area(disk.real, disk.imag),),
    )  # fmt: skip


def _along(hz: Array, locus: np.ndarray, half: float) -> tuple[list[Curve], list[Mark]]:
    """Arrow heads along a locus as far as it is shown, with their frequencies."""
    arrows: list[Curve] = []
    marks: list[Mark] = []
    x, y = locus.real, locus.imag
    inside = (x > SHOWN[0]) & (x < SHOWN[1]) & (np.abs(y) < half)  # and so known
    steps = np.where(inside[1:] & inside[:-1], np.abs(np.diff(locus)), 0.0)
    along = np.append(0.0, np.cumsum(steps))
    for length in np.arange(0.4 * EVERY, along[-1], EVERY):
        i = int(np.searchsorted(along, length))
        place, way = locus[i], (locus[i] - locus[i - 1]) / abs(locus[i] - locus[i - 1])
        if all(abs(place - other) > APART for other in (0.0, *(complex(m.x, m.y) for m in marks))):
            back = place - HEAD * way * np.exp(np.array([0.4j, -0.4j]))
            head = np.array([back[0], place, back[1]])
            arrows.append(Curve(head.real, head.imag, width=1.6))
            marks.append(Mark(float(x[i]), float(y[i]), f"{number(hz[i], 3)} Hz", "."))
    return arrows, marks


def loci_of(L: np.ndarray, far: float = FAR) -> np.ndarray:
    """Eigenvalues of L (k, p, p) as p continuous curves (k, p), NaN where |λ| > `far`."""
    values = np.linalg.eigvals(L)
    if values.shape[1] > 1:
        for i in range(1, len(values)):
            away = np.abs(values[i - 1][:, None] - values[i][None, :])
            values[i] = values[i][scipy.optimize.linear_sum_assignment(away)[1]]
    return near(values, far)


def near(values: np.ndarray, far: float = FAR) -> np.ndarray:
    """What is drawn of a locus; beyond `far` neither part is known to a reader."""
    return np.where(np.abs(values) <= far, values, complex(np.nan, np.nan))
