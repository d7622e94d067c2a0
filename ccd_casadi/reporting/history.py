"""What the surrogate promised and what the truth gave, round by round."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ccd_casadi.codesign.formulation import Iterate
from ccd_casadi.drawing.content import Curve, Figure, Level, Lines, Panel, Table
from ccd_casadi.drawing.svg import BLUE, ORANGE
from ccd_casadi.inner_problem.problem import CoDesignProblem
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ, counted, number

LEAST_SPAN = 1e-3  # half the least height of a panel, relative
LEAST_ERROR = 1e-16  # an exact agreement still has a place on the logarithmic axis


def history_figure(
    iterates: Sequence[Iterate], problem: CoDesignProblem, result: Mapping[str, Any],
    theta: tuple[float, ...], tolerance: float, *, lifted: bool,
) -> Figure:  # fmt: skip
    """ω_b and J predicted and true over the rounds, the verified design last, and the error."""
    predicted_hz, true_hz = result["surrogate_bandwidth_hz"], result["bandwidth_hz"]
    J = result["objective"]
    last = replace(
        iterates[-1], theta=theta, predicted=HZ * predicted_hz, truth=HZ * true_hz, objective=J,
        predicted_objective=J + problem.w2 * HZ * (predicted_hz - true_hz),
        error=abs(predicted_hz / true_hz - 1.0),
    )  # fmt: skip
    rows = [
        (i.predicted / HZ, i.truth / HZ, i.predicted_objective, i.objective, i.error)
        for i in (*iterates, last)
    ]
    known = np.array(rows, float)
    known[~np.isfinite(known)] = np.nan
    head = (
        "round", *problem.names, "ω_b predicted Hz", "ω_b true Hz", "J predicted", "J true",
        "error",
    )  # fmt: skip
    names = [*(str(i + 1) for i in range(len(iterates))), "verified"]
    table = Table(head, tuple(
        (name, *item.theta, *row)
        for name, item, row in zip(names, (*iterates, last), known, strict=True)
    ))  # fmt: skip
    *_, objective, error = known.T
    caption = _caption(error, int(np.isnan(objective).sum()), tolerance, lifted)
    return Figure(_lines(known, tolerance), caption, (table,))


def _lines(known: Array, tolerance: float) -> Lines:
    """`known` (rounds, 5): ω_b and J, predicted and true, and the error."""
    promised, true, promised_J, true_J, error = known.T
    rounds = np.arange(1.0, len(known) + 1.0)
    span = (0.7, len(rounds) + 0.3)

    def pair(predicted: Array, truth: Array, label: str) -> Panel:
        curves = (
            Curve(rounds, predicted, "predicted", ORANGE, "--", "s"),
            Curve(rounds, truth, "true", BLUE, "-", "o"),
        )
        return Panel("round (–)", label, curves, x_range=span, whole_x=True,
                     y_range=_value_range(np.array([predicted, truth])))  # fmt: skip

    shown = np.maximum(error, LEAST_ERROR)
    ends = [*shown[np.isfinite(shown)], tolerance]
    below = Panel(
        "round (the last: the verified design) (–)", "relative error (–)",
        (Curve(rounds, shown, "", BLUE, "-", "o"),), log_y=True, x_range=span, whole_x=True,
        levels=(Level(tolerance, f"tolerance {tolerance:g}"),),
        y_range=(min(ends) / 4.0, max(ends) * 8.0),
    )  # fmt: skip
    top = (pair(promised, true, "bandwidth ω_b (Hz)"), pair(promised_J, true_J, "objective J (–)"))
    title = "Predicted and true bandwidth and objective, and their difference, by round"
    return Lines((top, (below,)), title, (2.6, 2.2))


def _value_range(values: Array) -> tuple[float, float]:
    """Around all values; agreement to rounding must not fill the panel."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    half = max(0.56 * (high - low), LEAST_SPAN * max(abs(low), abs(high)))
    middle = 0.5 * (low + high)
    return middle - half, middle + half


def _caption(error: Array, lost: int, tolerance: float, lifted: bool) -> str:
    """How the error fell, in numbers."""
    known = error[np.isfinite(error)]
    met = np.flatnonzero(error[:-1] <= tolerance)
    words = f"{counted(len(error) - 1, 'round')} of fit, IPOPT and truth: the error goes "
    words += f"from {number(float(known[0]), 2)} to {number(float(known[-1]), 2)}"
    if met.size:
        stays = (error[met[0] : -1] <= tolerance).all()
        when = f"from round {met[0] + 1} on" if stays else f"first in round {met[0] + 1}"
        words += f" and is within the tolerance {tolerance:g} {when}"
    else:
        words += f", in no round within the tolerance {tolerance:g}"
    words += ". "
    if lost:
        words += f"{lost} of the promised θ had no feasible design. "
    if lifted:
        words += (
            "In the rounds the error is the largest of those of ω_b (relative), ln‖S‖∞ and "
            "ln|S(ω_low)|; at the verified design, of ω_b alone. A round may promise a design just "
            "outside S_max, so its true J may lie below the final one."
        )
    return words.strip()
