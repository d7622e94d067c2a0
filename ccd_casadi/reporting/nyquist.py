"""The Nyquist plot of L = GK with the disk that S_max keeps it out of: |1 + L| >= 1/S_max."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from ccd_casadi.drawing.content import Area, Curve, Mark, Panel
from ccd_casadi.drawing.lines import BOTTOM, LEFT, RIGHT, TOP
from ccd_casadi.drawing.svg import BLUE, GREEN, GREY, ORANGE, WIDTH

SHOWN = (-3.2, 1.6)  # of the real axis
FAR = 30.0  # |L| beyond which a locus leaves the drawing


def nyquist_panel(
    loci: Sequence[np.ndarray], S_max: float, height: float = 3.0, others: str = GREEN
) -> Panel:
    """Loci (k,) complex, the first the model's; beside one other panel of this height in inches."""
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    circle = np.exp(1j * angle)
    curves = [
        Curve(line.real, line.imag, colour=others if i else BLUE, width=1.0 if i else 1.6)
        for i, line in reversed(list(enumerate(loci)))
    ]
    disk = -1.0 + circle / S_max
    curves.append(Curve(disk.real, disk.imag, f"|S| = S_max = {S_max:g}", ORANGE))
    curves.append(Curve(circle.real, circle.imag, "|L| = 1", GREY, ":", width=0.9))
    wide, tall = 0.5 * WIDTH - LEFT - RIGHT, height - BOTTOM - TOP
    half = 0.5 * (SHOWN[1] - SHOWN[0]) * tall / wide  # a circle is round
    return Panel(
        "Re L (–)", "Im L (–)", tuple(curves), marks=(Mark(-1.0, 0.0, marker="+"),),
        x_range=SHOWN, y_range=(-half, half), legend="lower right",
        forbidden=(Area(disk.real, disk.imag),),
    )  # fmt: skip


def loci_of(L: np.ndarray, far: float = FAR) -> np.ndarray:
    """Eigenvalues of L (k, p, p) as p continuous curves (k, p), NaN where |λ| > `far`."""
    values = np.linalg.eigvals(L)
    if values.shape[1] > 1:
        for i in range(1, len(values)):
            away = np.abs(values[i - 1][:, None] - values[i][None, :])
            values[i] = values[i][linear_sum_assignment(away)[1]]
    return np.where(np.abs(values) <= far, values, np.nan)
