"""What the surrogate promised and what the truth gave, round by round."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ccd_casadi.codesign.formulation import Iterate
from ccd_casadi.drawing.content import Curve, Figure, Level, Lines, Panel, Table
from ccd_casadi.drawing.svg import BLUE, ORANGE
from ccd_casadi.support.arrays import Array
from ccd_casadi.support.units import HZ, number

LEAST_SPAN = 1e-3  # half the least height of a panel, relative
LEAST_ERROR = 1e-16  # an exact agreement still has a place on the logarithmic axis


@dataclass(frozen=True)
class History:
    """Per round, the verified design last: bandwidths in Hz, objectives, relative errors."""

    theta: tuple[tuple[float, ...], ...]
    predicted_hz: Array
    true_hz: Array
    predicted_objective: Array
    objective: Array
    error: Array
    tolerance: float


def history_data(
    iterates: Sequence[Iterate],
    *,
    theta: tuple[float, ...],
    predicted_hz: float,
    true_hz: float,
    objective: float,
    w2: float,
    tolerance: float,
) -> History:
    """The rounds, and the verified design after them (its prediction by the last surrogate)."""
    final = objective + w2 * HZ * (predicted_hz - true_hz)
    return History(
        theta=(*(item.theta for item in iterates), theta),
        predicted_hz=np.array([*(i.predicted / HZ for i in iterates), predicted_hz]),
        true_hz=np.array([*(i.truth / HZ for i in iterates), true_hz]),
        predicted_objective=np.array([*(i.predicted_objective for i in iterates), final]),
        objective=_finite([*(i.objective for i in iterates), objective]),
        error=_finite([*(i.error for i in iterates), abs(predicted_hz / true_hz - 1.0)]),
        tolerance=tolerance,
    )


def _finite(values: list[float]) -> Array:
    array = np.array(values, float)
    return np.where(np.isfinite(array), array, np.nan)


def history_figure(history: History, names: Sequence[str], *, lifted: bool) -> Figure:
    """ω_b and J predicted and true over the rounds, and the error below on a logarithmic axis."""
    table = _table(history, names)
    return Figure(_lines(history), _caption(history, lifted), (table,))


def _lines(history: History) -> Lines:
    rounds = np.arange(1.0, len(history.error) + 1.0)
    span = (0.7, len(rounds) + 0.3)

    def pair(predicted: Array, truth: Array, label: str) -> Panel:
        return Panel(
            "round (–)",
            label,
            (
                Curve(rounds, predicted, "predicted", ORANGE, "--", "s"),
                Curve(rounds, truth, "true", BLUE, "-", "o"),
            ),
            x_range=span,
            y_range=_value_range(predicted, truth),
            whole_x=True,
        )

    error = Panel(
        "round (the last: the verified design) (–)",
        "relative error (–)",
        (Curve(rounds, np.maximum(history.error, LEAST_ERROR), "", BLUE, "-", "o"),),
        levels=(Level(history.tolerance, f"tolerance {history.tolerance:g}"),),
        log_y=True,
        x_range=span,
        y_range=_error_range(history),
        whole_x=True,
    )
    top = (
        pair(history.predicted_hz, history.true_hz, "bandwidth ω_b (Hz)"),
        pair(history.predicted_objective, history.objective, "objective J (–)"),
    )
    title = "Predicted and true bandwidth and objective, and their difference, by round"
    return Lines((top, (error,)), title, (2.6, 2.2))


def _value_range(predicted: Array, truth: Array) -> tuple[float, float]:
    """Around all values; agreement to rounding must not fill the panel."""
    values = np.concatenate([predicted, truth])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    half = max(0.56 * (high - low), LEAST_SPAN * max(abs(low), abs(high)))
    middle = 0.5 * (low + high)
    return middle - half, middle + half


def _error_range(history: History) -> tuple[float, float]:
    known = np.maximum(history.error[np.isfinite(history.error)], LEAST_ERROR)
    return min([*known, history.tolerance]) / 4.0, max([*known, history.tolerance]) * 8.0


def _caption(history: History, lifted: bool) -> str:
    """How the error fell, in numbers."""
    known = history.error[np.isfinite(history.error)]
    rounds = len(history.error) - 1
    met = np.flatnonzero(history.error[:-1] <= history.tolerance)
    words = f"{rounds} round{'' if rounds == 1 else 's'} of fit, IPOPT and truth: the error goes "
    words += f"from {number(float(known[0]), 2)} to {number(float(known[-1]), 2)}"
    if met.size:
        words += f" and is within the tolerance {history.tolerance:g} from round {met[0] + 1} on"
        if not (history.error[met[0] : -1] <= history.tolerance).all():
            words = words.replace("from round", "first in round").removesuffix(" on")
    else:
        words += f", in no round within the tolerance {history.tolerance:g}"
    words += ". "
    lost = int(np.isnan(history.objective).sum())
    if lost:
        words += f"{lost} of the promised θ had no feasible design. "
    if lifted:
        words += (
            "In the rounds the error is the largest of those of ω_b (relative), ln‖S‖∞ and "
            "ln|S(ω_low)|; at the verified design, of ω_b alone. A round may promise a design just "
            "outside S_max, so its true J may lie below the final one."
        )
    return words.strip()


def _table(history: History, names: Sequence[str]) -> Table:
    """One row a round."""
    count = len(history.error)
    head = ("round", *names, "ω_b predicted Hz", "ω_b true Hz", "J predicted", "J true", "error")
    columns = (
        history.predicted_hz, history.true_hz, history.predicted_objective, history.objective,
        history.error,
    )  # fmt: skip
    rows = tuple(
        (
            str(i + 1) if i + 1 < count else "verified",
            *history.theta[i],
            *(float(column[i]) for column in columns),
        )
        for i in range(count)
    )
    return Table(head, rows)
